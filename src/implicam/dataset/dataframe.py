"""Tables of pandas, read as the same table in a file would be."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset.marks import remove_marks
from implicam.dataset.model import Dataset
from implicam.dataset.sheet import Sheet
from implicam.dataset.table_options import TableOptions
from implicam.dataset.tables import Row
from implicam.dataset.wide import make_columns, read_brought
from implicam.errors import UsageError, import_extra

NAME = "DataFrame"


def dataset_from_dataframe(table: Any, options: TableOptions) -> Dataset:
    """`Dataset.from_dataframe`.

    Args:
        table: A pandas.DataFrame; an index with a name is a column.
        options: What the table does not say of itself.

    Raises:
        UsageError: It is no table of pandas, or has headings in several rows.
        DatasetError: There are two ways to read it, or it has a mistake.
    """
    if not (hasattr(table, "columns") and hasattr(table, "itertuples")):
        raise UsageError(
            f"a table of pandas is wanted, and not a {type(table).__name__}.",
            fix="give a pandas.DataFrame; for arrays: Dataset.from_arrays",
        )
    if any(name is not None for name in table.index.names):
        table = table.reset_index()
    if any(isinstance(name, tuple) for name in table.columns):
        raise UsageError(
            "the table has headings in several rows.",
            fix='make one of them: table.columns = ["_".join(map(str, names)) for names in table.columns]',
        )

    def rows() -> Iterator[Row]:
        return ((i, [_text(cell) for cell in row]) for i, row in enumerate(table.itertuples(index=False), start=1))

    sheet = Sheet(NAME, [str(column) for column in table.columns], rows, unit="row", first=0)
    return options.apply(remove_marks(read_brought(sheet, Path(NAME), options.unit)))


def _text(cell: Any) -> str:
    if cell is None or type(cell).__name__ in ("NAType", "NaTType") or (isinstance(cell, float) and math.isnan(cell)):
        return ""
    return repr(float(cell)) if isinstance(cell, float | np.floating) else str(cell)


def dataset_to_dataframe(data: Dataset) -> Any:
    """`Dataset.to_dataframe`.

    Args:
        data: The dataset.

    Raises:
        MissingExtraError: pandas is not installed.
    """
    pandas = import_extra("pandas", "pandas", "a table of pandas")
    columns, _ = make_columns(data)
    return pandas.DataFrame({key: v.astype(object) if v.dtype.kind == "U" else v for key, v in columns.items()})
