"""Stamps that are dates of ISO 8601, `2023-11-14T22:13:20.5Z` or with a space, brought to seconds since 1970."""

import re
from dataclasses import replace
from datetime import UTC, datetime

from flocc_agent.runtime.text_tables import Table

_DATE = re.compile(r"\d{4}-\d\d-\d\d")
_TIME = re.compile(r"\d\d:\d\d:\d\d.*")


def dated(table: Table) -> Table:
    """The table with dates in its first column as seconds; without a zone they are read as UTC."""
    if not table.rows or not _DATE.match(table.rows[0][1][0]):
        return table
    return replace(table, rows=[(line, _in_seconds(fields)) for line, fields in table.rows])


def _in_seconds(fields: list[str]) -> list[str]:
    """A row whose date is a number; one that is no date stays, and its reader says so."""
    text, rest = fields[0], fields[1:]
    if _DATE.fullmatch(text) and rest and _TIME.fullmatch(rest[0]):
        text, rest = f"{text}T{rest[0]}", rest[1:]
    whole, _, fraction = text.partition(".")
    digits = re.match(r"\d*", fraction)
    part = digits[0] if digits else ""
    try:
        moment = datetime.fromisoformat(whole + fraction[len(part) :])
    except ValueError:
        return fields
    moment = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
    return [f"{round(moment.timestamp())}.{part or 0}", *rest]
