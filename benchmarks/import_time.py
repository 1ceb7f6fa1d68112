"""What an import costs, in seconds of CPU: the median of several new Python processes, bytecode compiled before.

python benchmarks/import_time.py
"""

from __future__ import annotations

import statistics
import subprocess
import sys

RUNS = 5
LIMIT_SECONDS = 0.35
"""Wanted of `import implicam`."""

STATEMENTS = {
    "import implicam": "import implicam",
    "... and read a dataset": "import implicam as ic; ic.read_dataset",
    "... and one method": "import implicam as ic; ic.ForwardGP",
    "... and everything public": "from implicam import *",
    "numpy and scipy.linalg, to compare": "import numpy, scipy.linalg",
}


def cpu_seconds(statement: str) -> float:
    """User and system time of one process from the statement's beginning to its end."""
    code = f"import time; start = time.process_time()\n{statement}\nprint(time.process_time() - start)"
    return float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)


def main() -> None:
    """Print a row of a table for each statement."""
    print(
        f"| import (limit of the first: {LIMIT_SECONDS} s) | CPU seconds, median of {RUNS} | largest |\n|---|---|---|"
    )
    for name, statement in STATEMENTS.items():
        cpu_seconds(statement)
        taken = [cpu_seconds(statement) for _ in range(RUNS)]
        print(f"| {name} | {statistics.median(taken):.3f} | {max(taken):.3f} |", flush=True)


if __name__ == "__main__":
    main()
