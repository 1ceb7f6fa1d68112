"""Tables and numbers as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from implicam import formatting


def table(head: Sequence[str], body: Iterable[Sequence[str]], *, left: int = 1) -> str:
    """A table.

    Args:
        head: The names of the columns.
        body: The rows.
        left: How many columns are words; the others are numbers.
    """
    rule = [":--" if i < left else "--:" for i in range(len(head))]
    lines = [head, rule, *body]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def number(value: float | None, digits: int = 3, *, sign: bool = False) -> str:
    """As `formatting.number`, with the minus of print.

    Args:
        value: None or not finite for none.
        digits: Significant digits.
        sign: Whether to write a plus before numbers above zero.
    """
    return formatting.number(value, digits, sign=sign, minus="−")


def quartiles(values: Sequence[float | None]) -> str:
    """Median and, where the runs differ, the middle half.

    Args:
        values: The three quartiles.
    """
    low, middle, high = values
    if low == high:
        return number(middle)
    return f"{number(middle)} [{number(low, 2)}, {number(high, 2)}]"


def span(values: Sequence[float | None]) -> str:
    """Median and, where they differ, lowest and highest.

    Args:
        values: Lowest, median, highest.
    """
    low, middle, high = values
    return f"{number(middle)} ({number(low, 2)} to {number(high, 2)})" if low != high else number(middle)


def spread(values: Sequence[float | None] | None) -> str:
    """Mean / standard deviation.

    Args:
        values: Both; None or empty for nothing.
    """
    return "" if not values else f"{number(values[0])} / {number(values[1], 2)}"
