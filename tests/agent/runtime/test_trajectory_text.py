"""Trajectories in the forms that other tools write are one trajectory, or refused by name."""

import math
from pathlib import Path

import numpy as np
import pytest

from flocc_agent.runtime.text_tables import RecordingError
from flocc_agent.runtime.trajectory_text import read_trajectory

ZERO_S = 1_700_000_000
Pose = tuple[float, tuple[float, float, float], tuple[float, float, float, float]]


def rows(count: int = 10, zero_s: float = ZERO_S) -> list[Pose]:
    """Along a line, turning about z: stamp, position, x y z w."""
    angles_rad = [0.05 * k + 0.3 for k in range(count)]
    return [
        (zero_s + 0.1 * k, (0.2 * k, 0.05 * k, 0.0), (0.0, 0.0, math.sin(a / 2), math.cos(a / 2)))
        for k, a in enumerate(angles_rad)
    ]


def row(*values: float, separator: str = ",") -> str:
    """One line; whole numbers stay whole."""
    return separator.join(str(value) if isinstance(value, int) else f"{value:.9f}" for value in values) + "\n"


def tum(poses: list[Pose]) -> str:
    return "".join(row(s, *t, *q, separator=" ") for s, t, q in poses)


def ns(stamp_s: float) -> int:
    return round(stamp_s * 1e9)


def w_first(poses: list[Pose], end: tuple[float, ...] = (), in_ns: bool = True) -> str:
    return "".join(row(ns(s) if in_ns else s, *t, q[3], *q[:3], *end) for s, t, q in poses)


GOOD = tum(rows())
EUROC = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n"
OKVIS = "timestamp, p_WS_W_x, p_WS_W_y, p_WS_W_z, q_WS_x, q_WS_y, q_WS_z, q_WS_w, v_WS_W_x\n"
ROS_CSV = "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.pose.position.x,field.pose.position.y,"
ROS_CSV += "field.pose.position.z," + ",".join(f"field.pose.orientation.{axis}" for axis in "xyzw") + "\n"
STAMP_FORM = "# id timestamp tx ty tz qx qy qz qw\n"

READ: dict[str, bytes] = {
    "plain.tum": GOOD.encode(),
    "bom.tum": b"\xef\xbb\xbf" + GOOD.encode(),
    "bom_comment.tum": b"\xef\xbb\xbf# timestamp tx ty tz qx qy qz qw\n" + GOOD.encode(),
    "utf16.tum": GOOD.encode("utf-16"),
    "utf16_no_bom.tum": GOOD.encode("utf-16-be"),
    "crlf.tum": GOOD.replace("\n", "\r\n").encode(),
    "mac.tum": GOOD.replace("\n", "\r").encode(),
    "latin1_comment.tum": "# überall\n".encode("latin-1") + GOOD.encode(),
    "tabs.tum": GOOD.replace(" ", "\t").encode(),
    "decimal_commas.tum": GOOD.replace(".", ",").encode(),
    "semicolons.tum": GOOD.replace(" ", ";").encode(),
    "semicolons_decimal_commas.tum": GOOD.replace(" ", " ; ").replace(".", ",").encode(),
    "comment_at_the_end_of_lines.tum": GOOD.replace("\n", " # good\n").encode(),
    "commas_and_spaces.tum": GOOD.replace(" ", ", ").encode(),
    "header.csv": ("timestamp,tx,ty,tz,qx,qy,qz,qw\n" + GOOD.replace(" ", ",")).encode(),
    "unit_in_header.txt": (
        "time_ms x y z q_x q_y q_z q_w\n" + "".join(row(s * 1e3, *t, *q, separator=" ") for s, t, q in rows())
    ).encode(),
    "rpg_id.txt": (STAMP_FORM + "".join(f"{k} {row}\n" for k, row in enumerate(GOOD.splitlines()))).encode(),
    "id_without_header.txt": "".join(f"{k} {row}\n" for k, row in enumerate(GOOD.splitlines())).encode(),
    "rtabmap.txt": (
        "#timestamp x y z qx qy qz qw id\n" + "".join(f"{row} {k}\n" for k, row in enumerate(GOOD.splitlines()))
    ).encode(),
    "euroc.csv": (EUROC + w_first(rows())).encode(),
    "euroc_in_seconds.csv": (EUROC + w_first(rows(), in_ns=False)).encode(),
    "euroc_17.csv": w_first(rows(), end=(0,) * 9).encode(),
    "okvis.csv": (OKVIS + "".join(row(ns(s), *t, *q, 0.5) for s, t, q in rows())).encode(),
    "vins_mono.csv": w_first(rows()).replace("\n", ",\n").encode(),
    "vins_fusion.csv": w_first(rows(), end=(0.1, 0.2, 0.3)).replace("\n", ",\n").encode(),
    "w_first_seen_in_the_motion.txt": w_first(rows()).replace(",", " ").encode(),
    "ros_topic_echo.csv": (
        ROS_CSV + "".join(f"{ns(s) + 5},{k},{ns(s)},odom,{row(*t, *q)}" for k, (s, t, q) in enumerate(rows()))
    ).encode(),
    "seconds_and_nanoseconds.csv": (
        "sec,nanosec,x,y,z,qw,qx,qy,qz\n"
        + "".join(row(ZERO_S, k * 10**8, *t, q[3], *q[:3]) for k, (_, t, q) in enumerate(rows()))
    ).encode(),
    "pose_in_a_group.csv": (
        "timestamp,pose.x,pose.y,pose.z,pose.qx,pose.qy,pose.qz,pose.qw\n" + GOOD.replace(" ", ",")
    ).encode(),
    "millimetres.csv": (
        "timestamp,x [mm],y [mm],z [mm],qx,qy,qz,qw\n"
        + "".join(row(s, *(1000 * value for value in t), *q) for s, t, q in rows())
    ).encode(),
    "printed_lists.txt": "".join(
        f"{s:.6f} [{t[0]:.9f}, {t[1]:.9f}, {t[2]:.9f}] ({q[0]:.9f}, {q[1]:.9f}, {q[2]:.9f}, {q[3]:.9f})\n"
        for s, t, q in rows()
    ).encode(),
    "quoted.csv": (
        '"timestamp","tx","ty","tz","qx","qy","qz","qw"\n'
        + "".join('"' + '","'.join(line.split()) + '"\n' for line in GOOD.splitlines())
    ).encode(),
    "utf32.csv": GOOD.encode("utf-32"),
    "words_before.csv": ("exported by a tool\nversion two\ntime,x,y,z,qx,qy,qz,qw\n" + GOOD.replace(" ", ",")).encode(),
    "power_failed.tum": GOOD.encode() + bytes(300),
    "reversed.tum": tum(rows()[::-1]).encode(),
    "repeated.tum": "".join(line + "\n" + line + "\n" for line in GOOD.splitlines()).encode(),
}


def write(folder: Path, name: str, content: bytes) -> Path:
    (folder / name).write_bytes(content)
    return folder / name


@pytest.mark.parametrize("name", READ)
def test_what_other_tools_write_is_the_same_trajectory(tmp_path: Path, name: str) -> None:
    expected, _ = read_trajectory(write(tmp_path, "expected.tum", GOOD.encode()))
    found, _ = read_trajectory(write(tmp_path, name, READ[name]))
    np.testing.assert_allclose(found.stamps_s, expected.stamps_s, atol=1e-6)
    np.testing.assert_allclose(found.T_fixed_body, expected.T_fixed_body, atol=2e-6)


HALF = "0.5 0.5 0.5 0.5"
REFUSED = {
    "order.txt": (
        f"0.0 1 2 3 {HALF}\n0.1 2 2 3 {HALF}\n",
        r"order.txt:1: nothing says whether .* x y z w .* or w x y z",
    ),
    "declared.tum": (
        w_first(rows()).replace(",", " "),
        r"declared.tum: the quaternions should be x y z w \(the suffix .tum\), but only w x y z fits the motion",
    ),
    "positions.txt": (
        "0.0 1 2 3\n0.1 1 2 4\n",
        r"positions.txt:1: has 4 columns \(stamped positions without rotations",
    ),
    "angles.csv": ("t,x,y,z,roll,pitch,yaw\n0,1,2,3,0,0,0\n", "angles.csv:1: the header names no qx, .* angles"),
    "half.csv": ("timestamp,x,y,z,qx,qy,qz\n0,1,2,3,0,0,0\n", "half.csv:1: the header names no qw"),
    "twice.csv": ("t,x,y,z,x,qx,qy,qz,qw\n0,1,2,3,0,0,0,0,1\n", "twice.csv:1: the header names 'x' twice"),
    "places.csv": (
        "timestamp,latitude,longitude,altitude,qx,qy,qz,qw\n" + GOOD.replace(" ", ","),
        "places.csv:1: the header names no x, y, z",
    ),
    "ned.csv": (
        "# timestamp,north,east,down,qx,qy,qz,qw\n" + GOOD.replace(" ", ","),
        "ned.csv:1: the header names no x, y, z",
    ),
    "feet.csv": (
        "timestamp,x [ft],y [ft],z [ft],qx,qy,qz,qw\n" + GOOD.replace(" ", ","),
        "feet.csv:1: the header gives positions in 'ft', not in metres",
    ),
    "estimates.csv": (
        "time,est_x,est_y,est_z,est_a,est_b,est_c,est_d\n" + GOOD.replace(" ", ","),
        "estimates.csv:1: the header is not understood",
    ),
    "units.txt": (
        "".join(f"{2 * k} {k} 0 0 0 0 0 1\n" for k in range(5)),
        r"units.txt: stamps can be in seconds \(8 s in all\) or milliseconds \(0.008 s in all\)",
    ),
    "numbers.txt": (
        "".join(f"{k} {k} 0 0 0 0 0 1\n" for k in range(5)),
        "numbers.txt: stamps can be in seconds .* or be numbers of images",
    ),
    "damaged.tum": (GOOD + "1 2\n" * 5, r"damaged.tum:11: 8 numbers are needed, 2 were found \(and 4 other rows of 15"),
    "clock.tum": (tum(rows()[5:] + rows()[:5]), r"clock.tum:6: time goes backwards, .* 5 rows of 10 lie before"),
    "kitti.txt": ("1 0 0 1 0 1 0 2 0 0 1 3\n" * 3, "kitti.txt: holds 3 matrices without stamps"),
    "eigen.txt": (
        "".join(
            row(s, math.cos(a), math.sin(a), 0, 0, -math.sin(a), math.cos(a), 0, 0, 0, 0, 1, 0, *t, 1, separator=" ")
            for a, (s, t, _) in zip((0.05 * k + 0.3 for k in range(10)), rows(), strict=True)
        ),
        "eigen.txt:1: the matrices stand column by column",
    ),
    "redwood.log": (
        "1 0 0 5\n0 1 0 5\n0 0 1 5\n0 0 0 1\n" * 2,
        r"redwood.log:1: has 4 columns \(matrices in blocks of four rows\)",
    ),
    "empty.tum": ("", "empty.tum: holds no pose"),
    "turned.tum": (
        "# T_body_world: timestamp tx ty tz qx qy qz qw\n" + GOOD,
        "turned.tum:1: .*in the body.*t_body_world",
    ),
    "global.tum": (
        "# frame_T_global: timestamp tx ty tz qx qy qz qw\n" + GOOD,
        "global.tum:1: .*in the body or camera .frame_t_global",
    ),
    "anew.csv": (
        "time,x,y,z,qx,qy,qz,qw\n"
        + GOOD.replace(" ", ",")
        + "time,x,y,z,qw,qx,qy,qz\n"
        + GOOD.replace(" ", ",").replace("\n1", "\n2"),
        "anew.csv:12: names other columns than those of the rows before it .*cut it",
    ),
    "anew.txt": (
        "# time x y z qx qy qz qw\n" + GOOD + "# time x y z qw qx qy qz\n" + GOOD.splitlines()[-1] + "\n",
        "anew.txt:12: names other columns than those of the rows before it",
    ),
    "w2c.tum": ("# poses are world-to-camera\n" + GOOD, "w2c.tum:1: .*in the body or camera .world_to_camera"),
    "jpl.tum": ("# timestamp tx ty tz qx qy qz qw (JPL)\n" + GOOD, "jpl.tum:1: the quaternions are said to be JPL's"),
    "w2c_above.tum": (
        "# world-to-camera extrinsics\n# timestamp tx ty tz qx qy qz qw\n" + GOOD,
        "w2c_above.tum:1: .*in the body or camera .world_to_camera",
    ),
    "cw.txt": (
        "# timestamp tx_cw ty_cw tz_cw qx_cw qy_cw qz_cw qw_cw\n" + GOOD,
        "cw.txt:1: the header is not understood",
    ),
    "unity.tum": ("# left-handed, as Unity has it\n" + GOOD, "unity.tum:1: the axes are said to be left-handed"),
    "steps.tum": (
        "# relative poses between frames\n" + GOOD,
        "steps.tum:1: the poses are said to be from one to the next",
    ),
    "gl.tum": (
        "# camera poses, OpenGL convention\n" + GOOD,
        "gl.tum:1: the axes are said to be OpenGL's .*T_body_camera",
    ),
    "tags.csv": (
        "tag_id,timestamp,x,y,z,qx,qy,qz,qw\n"
        + "".join(f"{k % 3},{line.replace(' ', ',')}\n" for k, line in enumerate(GOOD.splitlines())),
        r"tags.csv: holds poses of 3 different tag_id \(0, 1, 2\)",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_known_is_refused_with_its_line(tmp_path: Path, name: str) -> None:
    text, sentence = REFUSED[name]
    with pytest.raises(RecordingError, match=sentence):
        read_trajectory(write(tmp_path, name, text.encode()))


def test_a_binary_file_is_no_text(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"x.tum: is no text"):
        read_trajectory(write(tmp_path, "x.tum", bytes(range(256)) * 20))


@pytest.mark.parametrize(
    ("spoilt", "note"),
    [
        ("nan nan nan nan nan nan nan", "1 of 10 rows were left out, the first at line 6: the pose has a number that"),
        ("1 2", "1 of 10 rows were left out, the first at line 6: 8 numbers are needed, 3 were found"),
        ("1 2 3 zero 0 0 1", "1 of 10 rows were left out, the first at line 6: 'zero' is not a number"),
        ("1 2 3 0 0 0 0", "1 of 10 rows were left out, the first at line 6: the pose is not rigid"),
    ],
)
def test_a_damaged_row_costs_itself(tmp_path: Path, spoilt: str, note: str) -> None:
    lines = GOOD.splitlines()
    lines[5] = f"{lines[5].split()[0]} {spoilt}"
    found, notes = read_trajectory(write(tmp_path, "d.tum", "\n".join(lines).encode()))
    assert len(found) == 9
    assert len(notes) == 1
    assert note in notes[0]


def test_a_step_back_of_the_clock_costs_the_rows_that_lie_before(tmp_path: Path) -> None:
    poses = rows(40)
    stepped = [(s - (0.35 if k >= 20 else 0.0), t, q) for k, (s, t, q) in enumerate(poses)]
    found, notes = read_trajectory(write(tmp_path, "back.tum", tum(stepped).encode()))
    assert len(found) == 37
    assert "back.tum:21: time goes backwards" in notes[0]
    assert notes[0].endswith("3 rows were left out")


@pytest.mark.parametrize("later_s", [-50.0, -0.45])
def test_trajectories_one_behind_the_other_are_said_to_be_that(tmp_path: Path, later_s: float) -> None:
    file = tmp_path / "joined.tum"
    file.write_text(tum(rows()) + tum(rows(zero_s=ZERO_S + later_s)))
    with pytest.raises(RecordingError, match=r"joined.tum:11: .* 2 trajectories .*\(lines 1 to 10, 11 to 20\)"):
        read_trajectory(file)


@pytest.mark.parametrize("form", ["tum-wxyz", "time[s] x y z qw qx qy qz"])
def test_a_form_that_is_named_settles_it(tmp_path: Path, form: str) -> None:
    text = w_first(rows(), in_ns=False).replace(",", " ")
    expected, _ = read_trajectory(write(tmp_path, "expected.tum", GOOD.encode()))
    found, _ = read_trajectory(write(tmp_path, "x.txt", text.encode()), form)
    np.testing.assert_allclose(found.T_fixed_body, expected.T_fixed_body, atol=2e-6)


def test_matrices_may_have_stamps(tmp_path: Path) -> None:
    text = "".join(row(s, 1, 0, 0, t[0], 0, 1, 0, t[1], 0, 0, 1, t[2]) for s, t, _ in rows())
    found, _ = read_trajectory(write(tmp_path, "m.csv", text.encode()))
    assert found.stamps_s.tolist() == pytest.approx([s for s, _, _ in rows()])
    assert found.T_fixed_body[:, 0, 3].tolist() == pytest.approx([t[0] for _, t, _ in rows()])


def test_a_declared_unit_that_cannot_be_is_not_taken(tmp_path: Path) -> None:
    text = "".join(row(k * 10**8, *t, *q, separator=" ") for k, (_, t, q) in enumerate(rows()))
    found, notes = read_trajectory(write(tmp_path, "n.tum", text.encode()))
    assert found.stamps_s.tolist() == pytest.approx([0.1 * k for k in range(10)])
    assert "said to be in seconds, but can only be in nanoseconds" in notes[0]


def test_an_unknown_form_is_refused_with_those_that_there_are(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"--trajectory-format 'tmu' is not known; there are tum, tum-wxyz, euroc"):
        read_trajectory(write(tmp_path, "x.txt", GOOD.encode()), "tmu")


def test_matrices_take_the_stamps_that_they_are_given(tmp_path: Path) -> None:
    path = write(tmp_path, "kitti.txt", b"".join(b"1 0 0 %d 0 1 0 2 0 0 1 3\n" % k for k in range(3)))
    found, _ = read_trajectory(path, stamps_s=[5.0, 6.0, 7.0])
    assert found.stamps_s.tolist() == [5.0, 6.0, 7.0]
    assert found.T_fixed_body[:, 0, 3].tolist() == [0.0, 1.0, 2.0]
    with pytest.raises(RecordingError, match="has 3 poses without stamps, but there are 2 images"):
        read_trajectory(path, stamps_s=[5.0, 6.0])


def test_a_stamp_in_the_future_costs_its_row(tmp_path: Path) -> None:
    poses = rows(40)
    poses[20] = (4e9, *poses[20][1:])
    found, notes = read_trajectory(write(tmp_path, "f.tum", tum(poses).encode()))
    assert len(found) == 39
    assert "f.tum:21: 1 rows with a stamp far ahead of those around them were left out" in notes[0]


@pytest.mark.parametrize("glue", ["\x0b", "\x85", "\u2028", " "])
def test_rows_that_became_one_are_left_out_and_counted(tmp_path: Path, glue: str) -> None:
    """A line end that is none, or got lost: of two poses in a line, one was read, and nothing said."""
    lines = GOOD.splitlines(keepends=True)
    path = tmp_path / "odometry.tum"
    path.write_text("".join(lines[:4]) + lines[4].strip() + glue + "".join(lines[5:]), encoding="utf-8")
    trajectory, notes = read_trajectory(path)
    assert len(trajectory) == 8
    assert "1 of 9 rows were left out, the first at line 5: has 16 columns, other rows have 8" in notes[0]


@pytest.mark.parametrize("form", ["{:g}", "{:.6e}", "0"])
def test_stamps_that_lost_their_digits_are_refused(tmp_path: Path, form: str) -> None:
    path = tmp_path / "odometry.tum"
    text = [f"{form.format(s)} {' '.join(map(str, (*t, *q)))}\n" for s, t, q in rows()]
    path.write_text("".join(text))
    with pytest.raises(
        RecordingError, match=r"tum:2: 9 of 10 rows have the stamp of the row before, .* all their digits"
    ):
        read_trajectory(path)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("position", ["1e300", "-1e12"])
@pytest.mark.parametrize("name", ["odometry.tum", "KeyFrameTrajectory.txt"])
def test_a_position_that_is_nowhere_is_left_out(tmp_path: Path, position: str, name: str) -> None:
    lines = tum([(s, t, q) for s, t, q in rows(12)]).splitlines(keepends=True)
    words = lines[5].split()
    lines[5] = " ".join([words[0], position, *words[2:]]) + "\n"
    header = "" if name.endswith(".tum") else "# timestamp tx ty tz qx qy qz qw\n"
    (tmp_path / name).write_text(header + "".join(lines))
    trajectory, notes = read_trajectory(tmp_path / name)
    assert len(trajectory) == 11
    assert "is nowhere on Earth" in notes[0]


def test_plotjugglers_header_is_read(tmp_path: Path) -> None:
    names = [f"/odom/pose/pose/{group}" for group in ("position/x", "position/y", "position/z")]
    names += [f"/odom/pose/pose/orientation/{axis}" for axis in "xyzw"] + ["/odom/twist/twist/linear/x"]
    path = tmp_path / "odom.csv"
    path.write_text(",".join(["__time", *names]) + "\n" + "".join(row(s, *t, *q, 9.0) for s, t, q in rows()))
    trajectory, _ = read_trajectory(path)
    np.testing.assert_allclose(trajectory.T_fixed_body[:, :3, 3], [t for _, t, _ in rows()], atol=1e-6)


def test_what_is_no_trajectory_is_shown_and_what_is_no_file_is_not_opened(tmp_path: Path) -> None:
    (tmp_path / "odometry.txt").write_text("<!DOCTYPE html>\n<body>404</body>\n")
    with pytest.raises(RecordingError, match="holds no pose; it begins with '<!DOCTYPE html>'"):
        read_trajectory(tmp_path / "odometry.txt")
    (tmp_path / "endless.tum").symlink_to("/dev/zero")
    with pytest.raises(RecordingError, match="is not a file"):
        read_trajectory(tmp_path / "endless.tum")


DATES = {
    "T": lambda s: f"2023-11-14T22:13:{20 + s:04.1f}",
    "zone": lambda s: f"2023-11-15T00:13:{20 + s:04.1f}+02:00",
    "Z": lambda s: f"2023-11-14T22:13:{20 + s:06.3f}Z",
    "space": lambda s: f"2023-11-14 22:13:{20 + s:04.1f}",
}


@pytest.mark.parametrize("name", DATES)
@pytest.mark.parametrize("header", ["", "# timestamp tx ty tz qx qy qz qw\n"])
def test_dates_are_stamps(tmp_path: Path, name: str, header: str) -> None:
    """1 700 000 000 s is 2023-11-14 22:13:20 UTC."""
    lines = [row(*t, *q, separator=" ") for _, t, q in rows()]
    text = header + "".join(f"{DATES[name](0.1 * k)} {line}" for k, line in enumerate(lines))
    trajectory, notes = read_trajectory(write(tmp_path, "odometry.txt", text.encode()))
    assert trajectory.stamps_s == pytest.approx([ZERO_S + 0.1 * k for k in range(10)], abs=1e-6)
    assert notes == ()


def test_a_date_that_is_none_is_refused_with_its_line(tmp_path: Path) -> None:
    path = write(tmp_path, "odometry.txt", b"2023-13-45T22:13:20 1 2 3 0 0 0 1\n2023-13-45T22:13:21 1 2 3 0 0 0 1\n")
    with pytest.raises(RecordingError, match=r"odometry\.txt:1: '2023-13-45T22:13:20' is not a number"):
        read_trajectory(path)
