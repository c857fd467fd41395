"""Trajectories in text, in the forms that other tools write.

What the columns are is said by the file, in this order: a form that the user names; a line that names the columns;
the suffix `.tum`; numbers that can be one form only (a rotation matrix in 12, EuRoC's 17 columns). The order of a
quaternion that nothing says is tried on the motion (`quaternion_order`), and refused where both are possible. A damaged
row costs itself.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import is_rigid, nearest_rotation, pose
from flocc_agent.runtime.columns import (
    UNITS_S,
    Columns,
    HeaderError,
    begins_with_stamp,
    columns_of,
    contradiction,
)
from flocc_agent.runtime.dated_rows import dated
from flocc_agent.runtime.pose_limits import oddity
from flocc_agent.runtime.quaternion_order import clear_order, rotations
from flocc_agent.runtime.row_order import DAMAGED_RATIO_MAX, Poses, in_order
from flocc_agent.runtime.spare_columns import comment_notes, spare_notes
from flocc_agent.runtime.stamp_units import are_counted, plausible_units, since_1970
from flocc_agent.runtime.text_tables import RecordingError, Table, is_number, read_table
from flocc_agent.runtime.trajectory import QUATERNION_NORM_TOLERANCE, Trajectory

logger = logging.getLogger(__name__)

Float = NDArray[np.float64]

FORMS = {
    "tum": "timestamp(s) tx ty tz qx qy qz qw",
    "tum-wxyz": "timestamp(s) tx ty tz qw qx qy qz",
    "euroc": "timestamp[ns] tx ty tz qw qx qy qz",
    "ns-xyzw": "timestamp[ns] tx ty tz qx qy qz qw",
    "rpg": "id timestamp(s) tx ty tz qx qy qz qw",
    "rtabmap": "timestamp(s) tx ty tz qx qy qz qw id",
}
"""Names for `--trajectory-format`; any other value is itself a line that names the columns."""
MATRIX_FORM = "kitti"
POSITION_MAX_M = 1e8
NUMBER_MAX = 1e20
"""More than nanoseconds since 1970."""
ROWS_TRIED_MAX = 2000
SAID_STEP_MAX_S = 600.0
"""Stamps whose steps would be longer are not in the unit that is said."""
WAY_OUT = "name the columns in a first line such as '# timestamp tx ty tz qx qy qz qw', or with --trajectory-format"


def read_trajectory(
    path: Path, form: str | None = None, stamps_s: Sequence[float] | None = None, otherwise: str | None = None
) -> tuple[Trajectory, tuple[str, ...]]:
    """Read a trajectory, and say what was left out of it.

    Args:
        path: The file.
        form: One of `FORMS`, "kitti", or a line that names the columns; None finds out.
        stamps_s: Of the poses of a form without stamps, as many as there are poses.
        otherwise: The form of a data set's own files, for those that do not name their columns.

    Raises:
        RecordingError: Unreadable, of no known form or of more than one, or too much of it is damaged.
    """
    poses = read_poses(path, form, otherwise)
    odd = oddity(poses.T_fixed_body[:, :3, 3], poses.T_fixed_body[:, :3, :3])
    if odd is not None:
        poses = replace(poses, notes=(*poses.notes, f"{path}: {odd}"))
    if poses.stamps_s is None:
        if stamps_s is None:
            raise RecordingError(
                f"{path}: holds {len(poses.lines)} matrices without stamps (KITTI's form), and nothing says when they "
                "were: there must be as many images as poses, with stamps of their own"
            )
        if len(stamps_s) != len(poses.lines):
            raise RecordingError(
                f"{path}: has {len(poses.lines)} poses without stamps, but there are {len(stamps_s)} images"
            )
        poses = replace(poses, stamps_s=np.array(stamps_s, dtype=float))
    return in_order(poses, path)


def read_tum(path: Path) -> Trajectory:
    """Read a recording's trajectory; what was left out is logged.

    Raises:
        RecordingError: As `read_trajectory`.
    """
    trajectory, notes = read_trajectory(path)
    for note in notes:
        logger.warning("%s", note)
    return trajectory


def read_poses(path: Path, form: str | None = None, otherwise: str | None = None) -> Poses:
    """Read poses in the order of the file.

    Raises:
        RecordingError: As `read_trajectory`.
    """
    table = dated(read_table(path))
    if not table.rows:
        first = f"; it begins with {table.headers[0][1][:60]!r}" if table.headers else ""
        raise RecordingError(f"{path}: holds no pose{first}")
    columns = _columns(table, form, otherwise)
    if columns is None:
        return _matrices(table)
    _refuse_second_header(table, columns)
    values, lines, notes = _values(table, columns)
    notes = (*notes, *comment_notes(table))
    values[:, 1:4] *= columns.metres
    q = values[:, 4:8] / np.linalg.norm(values[:, 4:8], axis=1, keepdims=True)
    T = np.tile(np.eye(4), (len(q), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = rotations(q[:, [3, 0, 1, 2]]), values[:, 1:4]
    unit, unit_notes = _unit(values[:, 0], columns, form, path)
    return Poses(values[:, 0] * UNITS_S[unit], T, lines, (*notes, *unit_notes))


def _columns(table: Table, form: str | None, otherwise: str | None) -> Columns | None:
    """Columns of a table, or None where it holds matrices."""
    count = _usual_count(table)
    if form == MATRIX_FORM:
        return None
    if form is not None:
        return _named_form(form, table.path)
    for line, header in (*table.headers, *table.remarks):
        if (fault := contradiction(header)) is not None:
            raise RecordingError(f"{table.path}:{line}: {fault}; {WAY_OUT}")
    for line, header in reversed(table.headers):
        try:
            found = columns_of(header, count)
        except HeaderError as error:
            raise RecordingError(f"{table.path}:{line}: {error}; {WAY_OUT}") from None
        if found is not None:
            return found
        words = header.split(",") if "," in header else header.split()
        words = words if "," in header or (len(words) == count and begins_with_stamp(header)) else []
        if len(words) >= 7 and not any(is_number(word.strip()) for word in words):
            raise RecordingError(f"{table.path}:{line}: the header is not understood ({header[:80]}); {WAY_OUT}")
    return _by_numbers(table, count) if otherwise is None else _named_form(otherwise, table.path)


def _refuse_second_header(table: Table, columns: Columns) -> None:
    """Refuse a table whose columns are named anew between its rows, and otherwise.

    Raises:
        RecordingError: A line between rows, or a comment there, names other columns than those that are read.
    """
    worded = (
        (line, ",".join(fields)) for line, fields in table.rows if fields and not any(is_number(f) for f in fields)
    )
    for line, header in (*worded, *table.remarks):
        try:
            found = columns_of(header)
        except HeaderError:
            continue
        if found is not None and (found.stamp, found.pose, found.unit) != (columns.stamp, columns.pose, columns.unit):
            raise RecordingError(
                f"{table.path}:{line}: names other columns than those of the rows before it ({header[:60]}): the file "
                "holds several tables; cut it, and convert the parts apart"
            )


def _usual_count(table: Table) -> int:
    counts = [len(fields) for _, fields in table.rows[:200]]
    return max(set(counts), key=lambda count: (counts.count(count), count))


def _named_form(form: str, path: Path) -> Columns:
    try:
        found = columns_of(FORMS.get(form, form))
    except HeaderError as error:
        raise RecordingError(f"--trajectory-format {form!r}: {error}") from None
    if found is None:
        names = ", ".join([*FORMS, MATRIX_FORM])
        raise RecordingError(
            f"--trajectory-format {form!r} is not known; there are {names}, and lines that name the columns ({path})"
        )
    return found


def _by_numbers(table: Table, count: int) -> Columns | None:
    some = table.rows[:: max(1, len(table.rows) // ROWS_TRIED_MAX)]
    rows = np.array([row for row in (_numbers(fields) for _, fields in some) if len(row) == count])
    rows = rows[np.all(np.abs(rows) < NUMBER_MAX, axis=1)] if rows.size else rows
    if len(rows) == 0:
        raise _of_first_row(table, count)
    if (count in (12, 16) and _are_matrices(rows)) or (count in (13, 17) and _are_matrices(rows[:, 1:])):
        return None
    if count in (16, 17) and _are_matrices(rows[:, -16:].reshape(-1, 4, 4).swapaxes(1, 2).reshape(-1, 16)):
        raise RecordingError(
            f"{table.path}:{table.rows[0][0]}: the matrices stand column by column (Eigen, MATLAB, OpenGL); "
            "write them row by row, the last row 0 0 0 1"
        )
    if table.path.suffix == ".tum":
        return _declared_tum(table, rows, count)
    if count == 17 and _units_at(rows, 4):
        return _checked_order(table, rows, Columns(0, (1, 2, 3, 5, 6, 7, 4)), "EuRoC's 17 columns")
    if table.trailing_separator and count in (8, 11) and since_1970(float(rows[0, 0])) == "nanoseconds":
        return _checked_order(table, rows, Columns(0, (1, 2, 3, 5, 6, 7, 4)), "VINS' columns")
    first = _first_of_pose(rows, count)
    if first is None:
        raise _of_count(table, count)
    stamp, start = first
    order = clear_order(rows[:, start : start + 3], _unit_rows(rows[:, start + 3 : start + 7]))
    if order is None:
        raise _of_order(table, rows, start)
    wxyz = order == "wxyz"
    q = (start + 4, start + 5, start + 6, start + 3) if wxyz else (start + 3, start + 4, start + 5, start + 6)
    return Columns(stamp, (start, start + 1, start + 2, *q))


def _numbers(fields: list[str]) -> list[float]:
    return [float(field) if is_number(field) else float("nan") for field in fields]


def _are_matrices(rows: Float) -> bool:
    found = [is_rigid(_matrix(row), tolerance=1e-2) for row in rows[:50]]
    return sum(found) > 0.5 * len(found)


def _matrix(row: Float) -> Float:
    return np.vstack([row[:12].reshape(3, 4), row[12:16] if len(row) == 16 else [0, 0, 0, 1]])


def _units_at(rows: Float, first: int) -> bool:
    """Whether four columns are quaternions of unit length."""
    norms = np.linalg.norm(rows[:, first : first + 4], axis=1)
    return bool(np.mean(np.abs(norms - 1.0) <= QUATERNION_NORM_TOLERANCE) > 0.5)


def _unit_rows(q: Float) -> Float:
    norms = np.linalg.norm(q, axis=1, keepdims=True)
    return np.asarray(q / np.where(norms > 0, norms, 1.0))


def _first_of_pose(rows: Float, count: int) -> tuple[int, int] | None:
    """Columns of the stamp and of the position, for 8 numbers and for 9 with a running number first or last."""
    if count == 8 and _units_at(rows, 4):
        return 0, 1
    if count == 9 and _units_at(rows, 5) and _runs(rows[:, 0]) and not _runs(rows[:, 1]):
        return 1, 2
    if count == 9 and _units_at(rows, 4) and _runs(rows[:, 8]):
        return 0, 1
    return None


def _runs(column: Float) -> bool:
    return bool(np.all(column == np.round(column)) and np.all(np.diff(column) >= 1) and np.max(np.abs(column)) < 1e8)


def _declared_tum(table: Table, rows: Float, count: int) -> Columns:
    """TUM's columns, as the file's suffix says, unless its numbers say that they are not."""
    if count != 8:
        raise _of_count(table, count)
    return _checked_order(table, rows, Columns(0, (1, 2, 3, 4, 5, 6, 7), "seconds"), "the suffix .tum")


def _checked_order(table: Table, rows: Float, columns: Columns, why: str) -> Columns:
    said = "wxyz" if columns.pose[6] == 4 else "xyzw"
    found = clear_order(rows[:, 1:4], _unit_rows(rows[:, 4:8])) if len(rows) > 2 or said == "wxyz" else None
    if found is not None and found != said:
        raise RecordingError(
            f"{table.path}: the quaternions should be {' '.join(said)} ({why}), but only {' '.join(found)} fits "
            f"the motion; {WAY_OUT}"
        )
    return columns


def _of_order(table: Table, rows: Float, start: int) -> RecordingError:
    """Say both readings."""
    first = _unit_rows(rows[:1, start + 3 : start + 7])[0]
    angles = [np.degrees(2 * np.arccos(min(1.0, abs(float(w))))) for w in (first[3], first[0])]
    line = table.rows[0][0]
    return RecordingError(
        f"{table.path}:{line}: nothing says whether the quaternion is x y z w (then the first pose is turned "
        f"by {angles[0]:.0f} degrees) or w x y z (by {angles[1]:.0f} degrees), and both are possible; {WAY_OUT} tum or "
        "tum-wxyz"
    )


def _of_count(table: Table, count: int) -> RecordingError:
    """Say what so many columns probably are."""
    line, fields = table.rows[0]
    what = {
        3: "positions without stamps",
        4: "stamped positions without rotations",
        6: "a position and angles, whose order and axes differ",
        7: "poses without stamps, or positions and angles",
    }.get(count)
    if what is None and count == 8:
        norm = float(np.linalg.norm(np.array(_numbers(fields)[4:8])))
        what = f"the last four are no quaternion: the pose is not rigid (its quaternion has length {norm:.4g}, not 1)"
    blocks = count == 4 and len(table.rows) % 4 == 0 and all(f == ["0", "0", "0", "1"] for _, f in table.rows[3::4])
    found = "matrices in blocks of four rows" if blocks else what or "of no known form"
    return RecordingError(
        f"{table.path}:{line}: has {count} columns ({found}); "
        f"flocc reads 'timestamp tx ty tz qx qy qz qw' (TUM), EuRoC, KITTI and what a first line names; {WAY_OUT}"
    )


def _of_first_row(table: Table, count: int) -> RecordingError:
    """Say what is wrong with the first row where no row can be used."""
    columns = Columns(0, (1, 2, 3, 4, 5, 6, 7)) if count >= 8 or table.path.suffix == ".tum" else None
    line, fields = table.rows[0]
    why = _damage(fields, columns) if columns else f"has {count} columns, and no line names them"
    return RecordingError(f"{table.path}:{line}: {why}")


def _wanted(columns: Columns) -> list[int]:
    stamp = [] if columns.stamp is None else [columns.stamp]
    split = [] if columns.nanoseconds is None else [columns.nanoseconds]
    return [*stamp, *columns.pose, *split]


def _values(table: Table, columns: Columns) -> tuple[Float, NDArray[np.int64], tuple[str, ...]]:
    """Stamp and pose of each row that is whole, its line, and what was left out."""
    spare = spare_notes(table, columns.spare)
    wanted = _wanted(columns)
    good, lines, damaged = [], [], []
    count = max(_usual_count(table), max(wanted) + 1)
    for line, fields in table.rows:
        glued = f"has {len(fields)} columns, other rows have {count}" if len(fields) > count else None
        why = glued or _damage(fields, columns)
        if why is None:
            good.append([float(fields[index]) for index in wanted])
            lines.append(line)
        else:
            damaged.append((line, why))
    if len(damaged) > DAMAGED_RATIO_MAX * len(table.rows):
        (line, why), others = damaged[0], len(damaged) - 1
        more = f" (and {others} other rows of {len(table.rows)} cannot be used)" if others else ""
        raise RecordingError(f"{table.path}:{line}: {why}{more}")
    values = np.array(good)
    if columns.nanoseconds is not None:
        values[:, 0] += values[:, -1] * 1e-9
    note = f"{table.path}: {len(damaged)} of {len(table.rows)} rows were left out, the first at line "
    told = (f"{note}{damaged[0][0]}: {damaged[0][1]}",) if damaged else ()
    return values, np.array(lines), (*told, *_moved(table, columns), *spare)


def _moved(table: Table, columns: Columns) -> tuple[str, ...]:
    """Which frame the poses move, where a column says it: the camera's mounting must be on that."""
    index = next((index for name, index in columns.spare if "child_frame" in name), None)
    moved = {fields[index] for _, fields in table.rows[:200] if index is not None and len(fields) > index} - {""}
    return (
        (f"{table.path}: poses are of {min(moved)}: the camera's mounting (T_body_camera) is on that",) if moved else ()
    )


def _damage(fields: list[str], columns: Columns) -> str | None:
    """Why a row cannot be used, or None."""
    wanted = _wanted(columns)
    if len(fields) <= max(wanted):
        return f"{max(wanted) + 1} numbers are needed, {len(fields)} were found"
    try:
        numbers = [float(fields[index]) for index in wanted]
    except ValueError:
        word = next(fields[index] for index in wanted if not is_number(fields[index]))
        return f"{word!r} is not a number"
    if not np.isfinite(numbers[0]):
        return "the stamp is not finite"
    norm = float(np.linalg.norm(numbers[4:8]))
    if not (np.all(np.isfinite(numbers[1:4])) and np.isfinite(norm)):
        return "the pose has a number that is not finite"
    if max(map(abs, numbers[1:4])) > POSITION_MAX_M / columns.metres:
        return f"the position {max(numbers[1:4], key=abs):g} is nowhere on Earth"
    if abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE:
        return f"the pose is not rigid (its quaternion has length {norm:.4g}, not 1)"
    return None


def _matrices(table: Table) -> Poses:
    """Poses of 12 or 16 numbers row by row, with a stamp before them where there is one more."""
    count = _usual_count(table)
    poses, stamps, lines, damaged = [], [], [], []
    for line, fields in table.rows:
        numbers = np.array(_numbers(fields))
        T = (
            _matrix(numbers[count % 4 :])
            if len(numbers) == count and count in (12, 13, 16, 17)
            else np.full((4, 4), np.nan)
        )
        if is_rigid(T, tolerance=1e-2) and np.max(np.abs(T[:3, 3])) <= POSITION_MAX_M and np.isfinite(numbers[0]):
            poses.append(pose(nearest_rotation(T[:3, :3]), T[:3, 3]))
            stamps.append(float(numbers[0]))
            lines.append(line)
        else:
            damaged.append(line)
    fault = f"{len(damaged)} of {len(table.rows)} rows are no rigid poses of {count} numbers, the first at line "
    if damaged and (count in (12, 16) or len(damaged) > DAMAGED_RATIO_MAX * len(table.rows)):
        alone = ", and poses without stamps cannot be left out" if count in (12, 16) else ""
        raise RecordingError(f"{table.path}:{damaged[0]}: {fault}{damaged[0]}{alone}")
    if count in (12, 16):
        return Poses(None, np.array(poses), np.array(lines), comment_notes(table))
    unit, notes = _unit(np.array(stamps), Columns(0, ()), None, table.path)
    told = (f"{table.path}: {fault}{damaged[0]}; they were left out",) if damaged else ()
    told = (*told, *notes, *comment_notes(table))
    return Poses(np.array(stamps) * UNITS_S[unit], np.array(poses), np.array(lines), told)


def _unit(stamps: Float, columns: Columns, form: str | None, path: Path) -> tuple[str, tuple[str, ...]]:
    """The unit of stamps: what the file says, unless that cannot be; else what their size says."""
    possible = plausible_units(stamps)
    said = columns.unit
    if said is not None and (form is not None or said in possible or not possible):
        return said, ()
    if said is not None:
        is_far = float(np.median(np.abs(np.diff(stamps)))) * UNITS_S[said] > SAID_STEP_MAX_S
        if len(possible) == 1 and (is_far or possible[0] == since_1970(float(np.median(stamps)))):
            note = f"{path}: stamps are said to be in {said}, but can only be in {possible[0]}, and were read so"
            return possible[0], (note,)
        if not is_far:
            return said, ()
    if len(possible) < 2:
        return (possible or ["seconds"])[0], ()
    readings = " or ".join(f"{unit} ({_duration_s(stamps) * UNITS_S[unit]:.3g} s in all)" for unit in possible)
    readings += ", or be numbers of images" if are_counted(stamps) else ""
    raise RecordingError(f"{path}: stamps can be in {readings}; {WAY_OUT}, with the unit: timestamp[ms]")


def _duration_s(stamps: Float) -> float:
    return float(np.max(stamps) - np.min(stamps))
