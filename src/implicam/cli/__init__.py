"""The command line: thin. Each command reads, calls the library, prints.

Exit codes: 0 fine, 1 failed, 2 wrong usage. Errors are three lines (what, why, fix); `--debug` adds the traceback.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from implicam.errors import ImplicamError, UsageError


def main(arguments: Sequence[str] | None = None) -> None:
    """Run `implicam ...` and exit."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in given
    given = [word for word in given if word != "--debug"]
    from implicam.cli.commands import app  # late, so that a broken installation still prints a clear error

    try:
        app(given, prog_name="implicam")
    except ImplicamError as error:
        if debug:
            raise
        from implicam.cli.show import error_lines

        error_lines(str(error))
        sys.exit(2 if isinstance(error, UsageError) else 1)


if __name__ == "__main__":
    main()
