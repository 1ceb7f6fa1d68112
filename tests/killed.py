"""Commands in processes that begin with all that they import, so that a kill meets their work."""

from __future__ import annotations

import multiprocessing
import os
import sys
from multiprocessing.context import ForkServerContext
from multiprocessing.process import BaseProcess
from pathlib import Path

from implicam.cli import main


def run(words: list[str], folder: str) -> None:
    """The command in its folder, without a word on the screen."""
    os.chdir(folder)
    sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115  until the process ends
    main(words)


def processes() -> ForkServerContext:
    """Where such processes are forked from."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["killed", "implicam.cli.commands", "plotly.graph_objects"])
    return context


def started(context: ForkServerContext, words: list[str], folder: Path) -> BaseProcess:
    """A command that has just begun."""
    process = context.Process(target=run, args=(words, str(folder)))
    process.start()
    return process
