"""A table of results in the form that the ending of its name says: CSV, Excel, Parquet."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.dataset.excel import write_excel
from implicam.dataset.folder import csv_text, format_cells
from implicam.errors import UsageError, import_extra
from implicam.files import replacing, write_text

TABLE_ENDINGS = (".csv", ".xlsx", ".parquet")


def check_table_name(path: Path) -> None:
    """Refuse a name that cannot be written, before the work.

    Args:
        path: The table.

    Raises:
        UsageError: Its ending is none of `TABLE_ENDINGS`.
        MissingExtraError: What writes it is not installed.
    """
    ending = path.suffix.lower()
    if ending not in TABLE_ENDINGS:
        raise UsageError(
            f"{path}: no table is written as {ending or 'a file without an ending'}.",
            fix=f"end the name in {', '.join(TABLE_ENDINGS[:-1])} or {TABLE_ENDINGS[-1]}",
        )
    if ending == ".xlsx":
        import_extra("openpyxl", "excel", "writing Excel workbooks")
    if ending == ".parquet":
        import_extra("pyarrow.parquet", "parquet", "writing Parquet")


def write_table(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write a table, whole or not at all; a number that is not there is an empty cell.

    Args:
        path: The file; its ending is one of `TABLE_ENDINGS`.
        columns: Heading -> numbers or text, (n,) each.

    Raises:
        UsageError: Its ending is another.
        DatasetError: A workbook cannot hold a text.
        MissingExtraError: What writes it is not installed.
        ImplicamError: It cannot be written.
    """
    check_table_name(path)
    ending = path.suffix.lower()
    if ending == ".csv":
        cells = [format_cells(v) if v.dtype.kind == "f" else v.astype(np.str_).tolist() for v in columns.values()]
        write_text(path, csv_text(list(columns), zip(*cells, strict=True)))
        return
    values = {name: [None if value != value else value for value in v.tolist()] for name, v in columns.items()}
    if ending == ".xlsx":
        write_excel(path, list(values.items()))
        return
    pyarrow = import_extra("pyarrow", "parquet", "writing Parquet")
    parquet = import_extra("pyarrow.parquet", "parquet", "writing Parquet")
    types = {"f": pyarrow.float64(), "i": pyarrow.int64(), "U": pyarrow.string()}
    table = {name: pyarrow.array(cells, types[columns[name].dtype.kind]) for name, cells in values.items()}
    with replacing(path) as temporary:
        parquet.write_table(pyarrow.table(table), temporary)
