"""How long each test file takes, from the JUnit files that pytest writes; names the files over their budget.

    .venv/bin/python -m pytest -m "not slow" --junitxml times.xml
    python benchmarks/test_times.py times.xml

Several files may be given: of a file that is in more than one, the times are added. The seconds are those of the
clock, and they are longer on a busy machine; so this is a report and no test.
"""

from __future__ import annotations

import argparse
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

BUDGET_SECONDS = 20.0
"""For the tests of one file that are not slow; a file runs in one process, so the longest bounds `make test`."""

LONGEST_TESTS_SHOWN = 10


def read_times(files: Iterable[Path]) -> dict[str, dict[str, float]]:
    """Test file -> test -> seconds, with its set-up."""
    times: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    for file in files:
        for case in ET.parse(file).iter("testcase"):
            times[case.get("classname", "")][case.get("name", "")] += float(case.get("time", 0))
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description="Seconds of each test file, the longest first")
    parser.add_argument("files", nargs="+", type=Path, help="what pytest --junitxml wrote")
    times = read_times(parser.parse_args().files)
    totals = {name: sum(tests.values()) for name, tests in times.items()}
    for name, seconds in sorted(totals.items(), key=lambda item: -item[1]):
        print(f"{seconds:8.1f} s  {name}{'  OVER ITS BUDGET' if seconds > BUDGET_SECONDS else ''}")
    print(f"{sum(totals.values()):8.1f} s  together")
    tests = [(seconds, f"{name}::{test}") for name, file in times.items() for test, seconds in file.items()]
    print(f"\nThe {LONGEST_TESTS_SHOWN} longest tests:")
    for seconds, test in sorted(tests, reverse=True)[:LONGEST_TESTS_SHOWN]:
        print(f"{seconds:8.1f} s  {test}")


if __name__ == "__main__":
    main()
