"""What a trajectory's table says beside stamps and poses: told where it changes nothing, refused where it may.

Nobody knows the names of all columns, but what stands in them tells what they are. One of words or of two numbers that
changes from row to row says something of each row: which body it is of, or whether it counts (`tracking_state`,
`valid`, `is_lost`, `mission-id`). One that stands still says something of all rows, such as the frame or the scale. The
rest are measurements of something else. A reader that left them all out without a word would believe lost poses.
"""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from flocc_agent.runtime.columns import contradiction, names_columns
from flocc_agent.runtime.text_tables import RecordingError, Table, is_number

Name = tuple[str, int]

LABEL = re.compile(
    r"(.*[._/])?(child_frame(_id)?|frame_id|(device|vehicle|sensor|marker|tag|body|object|track|map|mission|session)"
    r"(?:[_-]?(id|name|uid))?|robot(_id|_name)?|id|.*graph_uid)"
)
"""Columns that say what a row's pose is of; a number of its own in each row says nothing."""
_WORTH = re.compile(r"valid|lost|status|state|confid|quality|fix|track|mode|flag|keyframe|ok$|good|bad|reliab|success")
"""Columns that say what a row is worth."""
_SCALE = re.compile(r"(^|[._/ ])(scale|unit_?scale|scale_?factor)$")
_ELSE = re.compile(
    r"cov|vel|twist|acc|gyr|bias|sigma|std|err|imu|mag|temp|gravity|seq|stamp|time|secs?$|count|index|idx|num|frame$|dist"
    r"|^[vwabgp]_?(x|y|z)|^[bp][agrt]_?[xyz\d]|^p[rt]?\d\d|speed|rate|lin|ang"
)
"""Columns of other measurements, which may have two values by chance."""
AIRFRAMES = ({"pose_frame"}, {"vehiclename", "imagefile"})
"""Columns by which PX4's logs and AirSim's recordings are known."""
AIRFRAME_TOLD = (
    "poses are of the airframe, whose x is forward, y right and z down (PX4, AirSim): T_body_camera must say how the "
    "camera sits on it"
)
WORDS_MAX = 8
COMMENTS_MAX, COMMENT_LETTERS_MAX = 3, 60
SHOWN_MAX = 12


def spare_notes(table: Table, spare: Sequence[Name]) -> tuple[str, ...]:
    """What the columns that no pose needs say.

    Args:
        table: Rows as text.
        spare: Names and columns of those that are not read.

    Raises:
        RecordingError: One says that rows are of several things or count differently, or that positions are scaled.
    """
    told: dict[str, None] = {}
    for name, index in spare:
        found = Counter(fields[index] for _, fields in table.rows if len(fields) > index and fields[index])
        _refuse_several(table, name, found)
        _refuse_scaled(table.path, name, found)
        constant = next(iter(found)) if len(found) == 1 else ""
        if constant and not is_number(constant) and (fault := contradiction(constant)) is not None:
            raise RecordingError(f"{table.path}: the column {name!r} says {constant[:40]!r}: {fault}")
        if name:
            is_word = constant and (constant.isdecimal() or not is_number(constant))
            told[f"{name} ({constant[:40]} in all rows)" if is_word else name] = None
    more = f" and {len(told) - SHOWN_MAX} more" if len(told) > SHOWN_MAX else ""
    left = (f"{table.path}: columns that were not used: {', '.join([*told][:SHOWN_MAX])}{more}",) if told else ()
    of_airframe = any(names <= {name for name, _ in spare} for names in AIRFRAMES)
    return (*left, f"{table.path}: {AIRFRAME_TOLD}") if of_airframe else left


OWN_COMMENT = "made by flocc"
"""How a comment begins that flocc wrote itself."""


def comment_notes(table: Table) -> tuple[str, ...]:
    """What stands in comments and names no columns, in at most one sentence: nobody has read it."""
    said = [
        text
        for _, text in (*table.headers, *table.remarks)
        if re.search(r"[^\W\d_]{2}", text) and not names_columns(text) and not text.startswith(OWN_COMMENT)
    ]
    told = "; ".join(repr(text[:COMMENT_LETTERS_MAX]) for text in said[:COMMENTS_MAX])
    more = f" and {len(said) - COMMENTS_MAX} more" if len(said) > COMMENTS_MAX else ""
    return (f"{table.path}: comments that were not used: {told}{more}",) if said else ()


def _refuse_several(table: Table, name: str, found: Counter[str]) -> None:
    """Refuse a table whose rows are of several bodies, or count differently.

    Raises:
        RecordingError: A column says several things, each of many rows or as a word of few.
    """
    if not 1 < len(found) <= len(table.rows) / 2:
        return
    if LABEL.fullmatch(name):
        bodies = ", ".join(sorted(found)[:4])
        raise RecordingError(
            f"{table.path}: holds poses of {len(found)} different {name} ({bodies}); keep the rows of one of them"
        )
    several = ", ".join(f"{value[:24]!r} of {count}" for value, count in found.most_common(4))
    if len(found) <= WORDS_MAX and _is_of_rows(name, found):
        raise RecordingError(
            f"{table.path}: the column {name!r} says {several} rows, and flocc does not know what that "
            "means for their poses: keep the rows that count, and take the column out"
        )


def _is_of_rows(name: str, found: Counter[str]) -> bool:
    """Whether a column that changes says something of each row, and not of what was measured."""
    if _WORTH.search(name):
        return True
    words = not all(is_number(value) for value in found)
    return words or (len(found) == 2 and not _ELSE.search(name))


def _refuse_scaled(path: Path, name: str, found: Counter[str]) -> None:
    """Refuse positions that have yet to be multiplied.

    Raises:
        RecordingError: A column called scale is not 1 everywhere.
    """
    if not _SCALE.search(name):
        return
    other = next((value for value in found if is_number(value) and float(value) != 1.0), None)
    if other is not None:
        raise RecordingError(
            f"{path}: the column {name!r} says {other}: multiply the positions by it, if they are not, and take it out"
        )
