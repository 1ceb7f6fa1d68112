"""Formats that are several text files in a folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from implicam.files import refuse_other_files, replacing_folder


def write_folder(path: Path, texts: Mapping[str, str], what: str) -> None:
    """Write a folder of text files, whole or not at all; files of the same names are replaced.

    Args:
        path: The folder.
        texts: Name in the folder, with slashes -> content.
        what: What the folder is, for the error.

    Raises:
        DatasetError: The folder holds something else.
        ImplicamError: It cannot be written.
    """
    refuse_other_files(path, texts.__contains__, what)
    with replacing_folder(path, overwrite=True) as folder:
        for name, text in texts.items():
            file = folder / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8", newline="")
