"""The command line: thin. Each command reads, calls the library, prints.

Exit codes: 0 fine, 1 failed, 2 wrong usage, 130 interrupted. Errors are three lines (what, why, fix). Anywhere on the
line, `--debug` adds the traceback, and `--verbose` or `-v` shows what a command does as it goes.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import nullcontext
from typing import NoReturn

INTERRUPTED = 130
"""As a shell has it: 128 and the number of SIGINT."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run `implicam ...` and exit."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in given
    try:
        _run(given, debug)
    except KeyboardInterrupt:  # while modules load
        _interrupted(debug)
    except SystemExit as end:
        if _by_ctrl_c(end):
            _interrupted(debug)
        raise


def _run(given: list[str], debug: bool) -> None:
    # all of it is imported late: `import implicam.cli` stays cheap, and Ctrl-C is heard while it is loaded
    from implicam.cli.commands import app
    from implicam.cli.options import load_options, only_command
    from implicam.errors import ImplicamError, UsageError
    from implicam.logs import log_to_stream

    verbose = not {"--verbose", "-v"}.isdisjoint(given)
    given = [word for word in given if word not in ("--debug", "--verbose", "-v")]
    try:
        with log_to_stream(sys.stderr) if verbose else nullcontext():
            load_options(app, given or _words_to_complete())
            only_command(app, given)(given, prog_name="implicam")
    except ImplicamError as error:
        _fail(str(error), 2 if isinstance(error, UsageError) else 1, debug)
    except Exception as error:
        _fail(str(_unexpected(error)), 1, debug)


def _by_ctrl_c(end: SystemExit) -> bool:
    """Whether Typer made this of Ctrl-C, of which it says nothing; a command that has said something says so by `from
    None`."""
    return end.__context__ is not None and isinstance(end.__context__.__cause__, KeyboardInterrupt)


def _interrupted(debug: bool) -> NoReturn:
    """One line, for which nothing more is loaded."""
    if debug:
        traceback.print_exc()
    print("interrupted", file=sys.stderr)
    sys.exit(INTERRUPTED)


def _words_to_complete() -> list[str]:
    """The words of the line that a shell wants completed; none where it does not. Typer's scripts hand them over so:
    all of them in one variable, bash in another."""
    if "_IMPLICAM_COMPLETE" not in os.environ:
        return []
    return os.environ.get("_TYPER_COMPLETE_ARGS", os.environ.get("COMP_WORDS", "")).split()[1:]


def _fail(text: str, code: int, debug: bool) -> NoReturn:
    """Say what is wrong, with the traceback of the exception being handled under `--debug`, and exit."""
    from implicam.cli.show import error_lines

    if debug:
        traceback.print_exc()
    error_lines(text)
    sys.exit(code)


def _unexpected(error: Exception) -> Exception:
    from implicam.errors import ImplicamError

    if isinstance(error, OSError):
        return ImplicamError(f"{error.filename or 'a file'}: {error.strerror or error}.", fix="check the file")
    return ImplicamError(
        f"an unexpected {type(error).__name__}: {' '.join(str(error).split())}",
        why="probably a mistake in implicam itself",
        fix="run the command again with --debug and report what it prints",
    )


if __name__ == "__main__":
    main()
