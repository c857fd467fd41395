"""Medians and spreads over repetitions, and rows grouped by what they have in common."""

from collections.abc import Iterable, Sequence
from statistics import median
from typing import Any

from flocc_lab.experiments.experiment import Row


def grouped(rows: Iterable[Row], *columns: str) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by their values in some columns, in the order in which the values first come."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[column] for column in columns), []).append(row)
    return groups


def values(rows: Iterable[Row], column: str) -> list[float]:
    """What is known of a column."""
    return [row[column] for row in rows if row.get(column) is not None]


def middle(rows: Iterable[Row], column: str) -> float | None:
    """Median of what is known of a column, None where nothing is."""
    known = values(rows, column)
    return float(median(known)) if known else None


def with_spread(rows: Sequence[Row], column: str) -> Row:
    """Median, minimum and maximum of a column, as columns of a table."""
    known = values(rows, column)
    return {
        column: middle(rows, column),
        f"{column}_min": min(known) if known else None,
        f"{column}_max": max(known) if known else None,
    }
