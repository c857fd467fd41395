"""Numbers for people: three significant digits, counts, durations, sizes."""

import math
import re

UNIT = re.compile(r"(\d) (m|s|min|h|%|[kMG]?B)\b")


def number(value: float | None, unit: str = "") -> str:
    """Three significant digits, or a dash where the value is not known."""
    if value is None:
        return "–"
    digits = 0 if value == 0 else max(0, 2 - math.floor(math.log10(abs(value))))
    text = f"{value:,.{min(digits, 6)}f}".replace(",", " ")
    return f"{text} {unit}" if unit else text


def plain(value: float | str | None) -> str:
    """A whole number or a name as such, any other number with three significant digits."""
    if isinstance(value, str):
        return value
    return count_of(int(value)) if value is not None and value == int(value) else number(value)


def count_of(value: int | None) -> str:
    """A count with thin spaces between thousands."""
    return "–" if value is None else f"{value:,}".replace(",", " ")


def seconds(value: float | None) -> str:
    """A duration for people."""
    if value is None:
        return "–"
    if value < 120:
        return f"{value:.1f} s"
    minutes, rest = divmod(round(value), 60)
    return f"{minutes} min {rest} s" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def duration(value_s: float) -> str:
    """A duration in whole seconds, minutes or hours, for lines that come again and again."""
    return f"{value_s:.0f} s" if value_s < 120 else seconds(value_s)


def size_of(count: float | None) -> str:
    """Bytes for people, powers of ten."""
    if count is None:
        return "–"
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return number(count / scale, unit)
    return f"{count:.0f} B"


def unbroken(text: str) -> str:
    """A sentence whose numbers stay on one line with their units."""
    return UNIT.sub("\\1\u00a0\\2", text)
