"""Stamps in the names of images, as cameras and exporters write them.

All names of a folder are read together: what is the same in every name (a camera's number) says nothing, and the unit
of a number follows from its size where it counts from 1970, else from its steps. What has two readings is refused with
both.
"""

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import pairwise

import numpy as np

from flocc_agent.runtime.columns import UNITS_S
from flocc_agent.runtime.stamp_units import plausible_units, since_1970
from flocc_launch.datasets.source import DatasetError

DIGITS_MIN = 9
"""Shorter numbers only count images."""
DIGITS_MAX, LENGTH_MAX = 19, 40
"""Longer ones are no stamps."""
FRACTIONS_S = {3: 1e-3, 6: 1e-6, 9: 1e-9}
WAY_OUT = "list the images in images.txt with lines 'stamp_s relative/path'"

_DATE = re.compile(
    r"(?<!\d)((?:19|20)\d\d)[-_.]?(0[1-9]|1[0-2])[-_.]?(0[1-9]|[12]\d|3[01])(?:[-_.T ]{0,3}| at )"
    r"([01]\d|2[0-3])[-_.:h]?([0-5]\d)[-_.:m]?([0-5]\d|60)(?:([-_.,s]?)(\d{1,9}))?(?!\d)"
)
_CAMERA = re.compile(
    r"(?<![a-z])(?:left|right|cam(?:era)?[-_]?\d{1,2}|rgb|ir|nir|infra[12]?|thermal|depth|colou?r)(?![a-z\d])"
)
"""What tells one camera of several in a name."""
_AFTER_DATE = re.compile(r"\s*(?:(Z)\b|([+-])(\d\d):?(\d\d)(?!\d)|([AaPp])\.?[Mm]\b)")
"""What may follow a date: its zone, or the half of the day."""


def stamps_of_names(stems: Sequence[str], folder: object) -> tuple[list[float] | None, str]:
    """Seconds that names say, in the order of `stems`, and how they were read; None where names only count.

    Args:
        stems: Names without suffix.
        folder: Named in a sentence.

    Raises:
        DatasetError: Names have two readings.
    """
    _see_one_camera(stems, folder)
    stems = _without_common_date(stems)
    dates = _dates_s(stems, folder)
    if dates is not None:
        return dates, "dates, read as UTC"
    split = [[word for word in re.findall(r"\d+\.\d+|\d+", stem) if len(word) <= LENGTH_MAX] for stem in stems]
    if len({len(numbers) for numbers in split}) != 1 or not split[0]:
        return _single_long(split, stems, folder)
    columns = list(zip(*split, strict=True))
    pair = _seconds_and_fraction(columns, stems, folder)
    if pair is not None:
        return pair
    return _one_number(columns, stems, folder)


def _without_common_date(stems: Sequence[str]) -> Sequence[str]:
    """Names without the date of the recording, where it is the same in all and something else differs."""
    dates = {None if (found := _DATE.search(stem)) is None else found[0] for stem in stems}
    return (
        [_DATE.sub("", stem) for stem in stems] if len(stems) > 1 and len(dates) == 1 and None not in dates else stems
    )


def _see_one_camera(stems: Sequence[str], folder: object) -> None:
    """See that all images are of one camera, by names such as `..._left` and `..._right`.

    Raises:
        DatasetError: They are of several.
    """
    cameras = sorted({"_".join(_CAMERA.findall(stem.lower())) for stem in stems})
    if all(cameras) and 1 < len(cameras) < len(stems):
        raise DatasetError(
            f"{folder}: names are of several cameras ({', '.join(cameras[:6])}); a folder holds the images of one: "
            f"move the others elsewhere, or {WAY_OUT}"
        )


def _dates_s(stems: Sequence[str], folder: object) -> list[float] | None:
    """Seconds since 1970 of names that all hold a date; None where one does not.

    A number behind the seconds is their fraction after a point, or where it has 3, 6 or 9 digits that do not count the
    images; of 4, 5, 7 or 8 digits it counts.

    Raises:
        DatasetError: It can be either.
    """
    found = [_DATE.search(stem) for stem in stems]
    apart = [each[8] for each in found if each is not None and each[7] in ("-", "_")]
    counts = bool(apart) and {len(digits) for digits in apart} in ({4}, {5}, {7}, {8})
    dates = [date_s(stem, fraction=not counts) for stem in stems]
    if not all(date is not None for date in dates):
        return None
    steps = {int(b) - int(a) for a, b in pairwise(apart)}
    if not counts and apart and (len(apart) < len(stems) or not _are_fractions(apart) or steps == {1}):
        raise DatasetError(
            f"{folder}: names such as {stems[-1]} have a number behind the seconds, which can be their fraction or "
            f"count images; {WAY_OUT}"
        )
    return [date for date in dates if date is not None]


def _are_fractions(words: Sequence[str]) -> bool:
    widths = {len(word) for word in words}
    return len(widths) == 1 and widths <= set(FRACTIONS_S)


def date_s(stem: str, fraction: bool = True) -> float | None:
    """Seconds since 1970 of a date in a text, in the zone that it names, else read as UTC; or None.

    Args:
        stem: The text.
        fraction: Whether a number behind the seconds is their fraction.
    """
    found = _DATE.search(stem)
    if found is None:
        return None
    year, month, day, hour, minute, second = (int(found[k]) for k in range(1, 7))
    try:
        moment = datetime(year, month, day, hour, minute, min(second, 59), tzinfo=UTC)
    except ValueError:
        return None
    part_s = float(f"0.{found[8]}") if found[8] and fraction else 0.0
    return moment.timestamp() + part_s + (second == 60) + _shift_s(_AFTER_DATE.match(stem, found.end()), hour)


def _shift_s(after: re.Match[str] | None, hour: int) -> float:
    """Seconds to add for a zone or a half of the day behind a date."""
    if after is None:
        return 0.0
    if after[2]:
        ahead_s = 3600.0 * int(after[3]) + 60.0 * int(after[4])
        return -ahead_s if after[2] == "+" else ahead_s
    if after[5] and 1 <= hour <= 12:
        return 3600.0 * (12 * (after[5] in "Pp") - 12 * (hour == 12))
    return 0.0


def _varies(column: Sequence[str]) -> bool:
    return len(set(column)) > 1 or len(column) == 1


def _seconds_and_fraction(
    columns: list[tuple[str, ...]], stems: Sequence[str], folder: object
) -> tuple[list[float], str] | None:
    """Stamps of two neighbouring numbers: seconds since 1970, and their fraction in one unit."""
    for first, second in pairwise(columns):
        if not all(word.isdigit() and since_1970(float(word)) == "seconds" for word in first):
            continue
        widths = {len(word) for word in second}
        if not all(word.isdigit() for word in second) or not _varies(second) or max(widths) > 9:
            continue
        if widths == {max(widths)} and max(widths) in FRACTIONS_S:
            unit_s = FRACTIONS_S[max(widths)]
        elif max(widths) == 9:
            unit_s = 1e-9
        elif max(widths) > 4:
            raise DatasetError(
                f"{folder}: names such as {stems[0]} end in {second[0]}, which can be a fraction of a second or a "
                f"number of its own; {WAY_OUT}"
            )
        else:
            continue
        return [int(a) + int(b) * unit_s for a, b in zip(first, second, strict=True)], "seconds and their fraction"
    return None


def _one_number(columns: list[tuple[str, ...]], stems: Sequence[str], folder: object) -> tuple[list[float] | None, str]:
    decimal = [column for column in columns if _are_decimal(column) and _varies(column)]
    if len(decimal) == 1:
        _check_padding(decimal[0], folder)
        _check_minutes(columns, decimal[0], stems, folder)
        _check_clock(decimal[0], folder)
        unit = since_1970(float(decimal[0][0])) or "seconds"
        return [float(word) / round(1 / UNITS_S[unit]) for word in decimal[0]], unit
    if len(decimal) > 1:
        raise DatasetError(
            f"{folder}: names such as {stems[0]} hold {len(decimal)} numbers with a point, {decimal[0][0]} and "
            f"{decimal[1][0]}, and either can be the stamp; {WAY_OUT}"
        )
    long = [c for c in columns if all(word.isdigit() and _is_long(word) for word in c) and _varies(c)]
    if not long:
        return None, "numbers of images"
    readings = [_in_unit(column, folder) for column in long]
    if len(readings) > 1:
        raise DatasetError(
            f"{folder}: names such as {stems[0]} hold {len(readings)} stamps, {long[0][0]} and {long[1][0]}; {WAY_OUT}"
        )
    return readings[0]


def _are_decimal(column: Sequence[str]) -> bool:
    """Whether numbers have points, or are seconds since 1970 of which some were written without."""
    pointed = ["." in word for word in column]
    return all(pointed) or (any(pointed) and all(since_1970(float(word)) == "seconds" for word in column))


def _single_long(split: list[list[str]], stems: Sequence[str], folder: object) -> tuple[list[float] | None, str]:
    """Stamps of names that are not alike, where each holds one number that is long enough."""
    found = [[word for word in numbers if "." in word or _is_long(word)] for numbers in split]
    if not all(len(words) == 1 for words in found):
        return None, "numbers of images"
    return _one_number([tuple(words[0] for words in found)], stems, folder)


def _is_long(word: str) -> bool:
    digits = len(word.lstrip("0"))
    return DIGITS_MIN <= digits <= DIGITS_MAX or since_1970(float(word)) is not None


def _in_unit(column: Sequence[str], folder: object) -> tuple[list[float], str]:
    values = np.array([float(word) for word in column])
    units = plausible_units(np.sort(values))
    if len(units) != 1:
        readings = " or ".join(units) or "no unit of time"
        raise DatasetError(f"{folder}: numbers in names such as {column[0]} can be {readings}; {WAY_OUT}")
    unit_s = round(1 / UNITS_S[units[0]])
    return [int(word) / unit_s for word in column], units[0]


def _check_minutes(
    columns: list[tuple[str, ...]], seconds: tuple[str, ...], stems: Sequence[str], folder: object
) -> None:
    """Refuse seconds below a minute behind a number that changes now and then: it can be minutes, or a camera's."""
    before = columns[: columns.index(seconds)]
    if not before or not _varies(before[-1]) or any(float(word) >= 60 for word in (*seconds, *before[-1])):
        return
    if len(set(before[-1])) < len(stems):
        raise DatasetError(
            f"{folder}: names such as {stems[-1]} have {before[-1][-1]} before the seconds, which can be minutes or "
            f"count cameras; {WAY_OUT}"
        )


def _check_clock(words: Sequence[str], folder: object) -> None:
    """Refuse what looks like seconds, and like hours, minutes and seconds without anything between them.

    Raises:
        DatasetError: All numbers do.
    """
    if all(re.fullmatch(r"(?:[01]\d|2[0-3])(?:[0-5]\d){2}\.\d+", word) for word in words):
        raise DatasetError(
            f"{folder}: names such as {words[-1]} can be seconds, or hours, minutes and seconds; {WAY_OUT}"
        )


def _check_padding(words: Sequence[str], folder: object) -> None:
    """Refuse what looks like seconds and nanoseconds with a point between them, without leading zeros."""
    fractions = [word.partition(".")[2] for word in words]
    widths = {len(fraction) for fraction in fractions}
    if len(widths) > 1 and max(widths) >= 8:
        digits = f"{min(widths)} to {max(widths)} digits after the point"
        raise DatasetError(
            f"{folder}: names such as {words[0]} have {digits}, which can be a fraction of a second, or nanoseconds "
            f"without leading zeros; {WAY_OUT}"
        )
