"""What long work says of itself as it goes: on stderr with --verbose, and in a file beside its results.

Modules log by `logging.getLogger(__name__)`; nothing is shown or written until a command asks for it here.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import TextIO

from implicam.addresses import replacing_secrets, secrets_of, without_secrets_in
from implicam.errors import UsageError

LOG = "implicam.log"
"""The file in which a long command tells what it does, in the folder that it writes to."""

MAX_BYTES = 10_000_000
"""A log file that is larger is put aside as FILE.1, and another is begun."""

_LOG = logging.getLogger("implicam")


class _Formatter(logging.Formatter):
    """Lines of a log file, tracebacks too, without the passwords that were typed or stand in addresses."""

    def format(self, record: logging.LogRecord) -> str:
        """The line, or lines, of one record.

        Args:
            record: What was logged.
        """
        typed = {secret for word in sys.argv[1:] for secret in secrets_of(word, whole=True)}
        return without_secrets_in(replacing_secrets(typed)(super().format(record)))


_FORMAT = _Formatter("%(asctime)s %(levelname)-7s %(name)s: %(message)s")


@contextmanager
def log_to_stream(stream: TextIO) -> Iterator[None]:
    """Show what is logged, without times, while the block runs.

    Args:
        stream: Where to.
    """
    handler = logging.StreamHandler(stream)
    handler.setFormatter(logging.Formatter("%(name)s: %(message)s"))
    with _handling(handler):
        yield


@contextmanager
def log_to_file(path: Path, begin: str) -> Iterator[None]:
    """Append what is logged to a file while the block runs; an error that ends the block goes there with its traceback.

    Args:
        path: The file; its folder is made.
        begin: The first line, such as the command.

    Raises:
        UsageError: The file is a link: where to is not for a folder from elsewhere to say.
    """
    if path.is_symlink():
        raise UsageError(
            f"{path} is a link to another file.",
            why="the log would be written there",
            fix="remove the link; look where the folder comes from",
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    handler = RotatingFileHandler(path, maxBytes=MAX_BYTES, backupCount=1, encoding="utf-8", delay=True)
    handler.setFormatter(_FORMAT)
    with _handling(handler):
        _LOG.info("%s", begin)
        try:
            yield
        except BaseException as error:
            ended = f"ended by {type(error).__name__}"
            handler.handle(_LOG.makeRecord(_LOG.name, logging.ERROR, "", 0, ended, (), sys.exc_info()))
            raise
        _LOG.info("done")


@contextmanager
def _handling(handler: logging.Handler) -> Iterator[None]:
    level = _LOG.level
    _LOG.addHandler(handler)
    _LOG.setLevel(logging.INFO)
    try:
        yield
    finally:
        _LOG.removeHandler(handler)
        _LOG.setLevel(level)
        handler.close()
