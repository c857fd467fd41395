"""What a table says beside stamps and poses is told, or refused where it may change what the poses are."""

from collections.abc import Callable
from pathlib import Path

import pytest

from flocc_agent.runtime.text_tables import RecordingError
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_launch.runs.ground_truth import MADE

COUNT = 10
POSE = "timestamp,x,y,z,qx,qy,qz,qw"


def table(name: str, value: Callable[[int], object]) -> str:
    """A trajectory along a line with one more column."""
    rows = (f"{1_700_000_000 + 0.1 * k:.1f},{0.2 * k},0,0,0,0,0,1,{value(k)}" for k in range(COUNT))
    return "\n".join([f"{POSE},{name}", *rows]) + "\n"


def read(path: Path, text: str) -> tuple[str, ...]:
    file = path / "odometry.csv"
    file.write_text(text)
    trajectory, notes = read_trajectory(file)
    assert len(trajectory) == COUNT
    return notes


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("tracking_state", lambda k: "OK" if k < 6 else "SEARCHING", "'OK' of 6, 'SEARCHING' of 4 rows"),
        ("Okay?", lambda k: k < 6, "'True' of 6, 'False' of 4 rows"),
        ("valid", lambda k: int(k < 6), "'1' of 6, '0' of 4 rows"),
        ("tracker_confidence", lambda k: (3, 2, 0)[k // 4], "'3' of 4, '2' of 4, '0' of 2 rows"),
        ("zustand", lambda k: int(k % 3 == 0), "'0' of 6, '1' of 4 rows"),
        ("mission-id", lambda k: "ab12" if k < 5 else "cd34", "2 different mission-id"),
        ("scale", lambda _: 2.5, "'scale' says 2.5: multiply"),
        ("CoordinateSystem", lambda _: "LeftHanded", "'LeftHanded': the axes are said to be left-handed"),
    ],
)
def test_a_column_that_may_change_what_poses_are_is_refused(
    tmp_path: Path, name: str, value: Callable[[int], object], said: str
) -> None:
    with pytest.raises(RecordingError) as error:
        read(tmp_path, table(name, value))
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("vx", lambda k: k % 2, "vx"),
        ("scale", lambda _: 1.0, "scale"),
        ("status", lambda _: "VALID", "status (VALID in all rows)"),
        ("quality_score", lambda k: 0.9 + 0.001 * k, "quality_score"),
        ("seq", lambda k: k, "seq"),
    ],
)
def test_a_column_that_changes_nothing_is_told(
    tmp_path: Path, name: str, value: Callable[[int], object], told: str
) -> None:
    (note,) = read(tmp_path, table(name, value))
    assert note.endswith(f"columns that were not used: {told}")


def test_a_comment_that_nobody_reads_is_told_and_one_that_names_columns_is_not(tmp_path: Path) -> None:
    text = table("vx", lambda _: 0).replace(POSE + ",vx", f"# frame: NED, body FRD\n# {POSE},vx")
    assert any(note.endswith("comments that were not used: 'frame: NED, body FRD'") for note in read(tmp_path, text))
    assert len(read(tmp_path, text)) == 2
    own = text.replace("frame: NED, body FRD", MADE.strip("# \n"))
    assert not any("comments" in note for note in read(tmp_path, own)), "flocc knows what it wrote itself"


@pytest.mark.parametrize("said", ["# positions in millimetres", "# kapture format: 1.1"])
def test_a_comment_by_which_poses_are_something_else_is_refused(tmp_path: Path, said: str) -> None:
    with pytest.raises(RecordingError, match=":1: "):
        read(tmp_path, f"{said}\n{table('vx', lambda _: 0)}")


def test_a_comment_behind_the_rows_counts_as_one_before_them(tmp_path: Path) -> None:
    assert "'made by hand'" in read(tmp_path, table("vx", lambda _: 0) + "# made by hand\n")[-1]
    with pytest.raises(RecordingError, match=":12: positions are said to be in another unit"):
        read(tmp_path, table("vx", lambda _: 0) + "# units: centimetres\n")


def test_poses_of_an_airframe_are_told_as_such(tmp_path: Path) -> None:
    assert any("x is forward, y right and z down" in note for note in read(tmp_path, table("pose_frame", lambda _: 1)))
