"""Every case of ../shared/cases/feed is right: those with a script are replayed, the others have tests by name.

A script writes its input and calls `flocc`; here that call stays in this process. The right values stand below.
"""

import importlib
import json
import re
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flocc_agent.runtime.recording import Recording
from flocc_launch.commands import main as command_line

TESTS = Path(__file__).resolve().parents[1]
ELSEWHERE = {
    "01": ("launch/test_calibrations.py", "test_orbslam_settings_keep_their_distortion_and_their_fisheye"),
    "03": ("launch/test_calibrations.py", "test_lists_of_one_item_a_line_are_read"),
    "04": ("launch/test_calibrations.py", "test_eight_coefficients_without_a_name_are_all_used"),
    "05": ("launch/test_calibrations.py", "test_intrinsics_of_reconstruction_programs_are_read"),
    "06": ("launch/test_calibrations.py", "test_wide_lenses_of_kalibr_are_read"),
    "21": (
        "launch/test_surroundings.py",
        "test_a_user_without_a_home_has_a_cache_in_the_temporary_folder",
        "test_a_home_that_cannot_be_written_is_not_used",
        "test_a_full_disk_ends_a_conversion_with_a_sentence",
        "test_names_with_umlauts_are_read_in_a_c_locale",
        "test_doctor_finds_a_folder_and_a_cache_that_cannot_be_written",
    ),
    "24": (
        "launch/test_surroundings.py",
        "test_an_interface_that_does_not_exist_is_named",
        "test_operators_on_an_interface_that_does_not_exist_hear_of_it",
        "test_a_host_that_does_not_resolve_is_named_once",
        "test_no_network_but_the_machines_own_is_said",
    ),
    "26": ("launch/test_evaluation.py", "evo"),
    "30": ("launch/test_cli.py", "test_a_port_in_use_stops_an_agent_with_one_sentence"),
    "31": ("../pyproject.toml", 'requires-python = ">=3.11', "numpy>=2.0"),
}

READ = (0, r"images +10, from 1700000000\.000 s to 1700000000\.900 s .*odometry +10 poses")
KEPT = (0, r"recording: ")
CUT = (0, r"the image is cut off: 1 of 16 images was left out")
ON_BODY = r"nothing says where the camera \(camera_optical\) sits on the body \(base_link\)"
SOLVED = (0, r"cost +0\.66666.*components +1 .*rejected +0 closures")
MIXED = (2, r"the image is 160x88, but the intrinsics are for 160x120 \(and 9 others\): 10 of 20 images cannot be used")
NO_INDEX = (0, r"images +5, .*/camera \(sensor_msgs/msg/CompressedImage")

SAID: dict[str, tuple[tuple[int, str], ...]] = {
    "07": (KEPT, (0, "can only be in seconds, and were read so.*recording: "), KEPT),
    "08": (
        *[READ] * 8,
        (0, r"odometry +9 poses.*1 of 10 rows were left out, the first at line 6"),
        (2, "odometry.tum:6: time goes backwards.*3 rows of 10 lie before"),
        *[READ] * 2,
    ),
    "09": (*[READ] * 5, (2, "both must be of one clock: flocc dataset clock measures how far they are apart")),
    "11": (KEPT, (0, "use 0 to 4095, which become 0 to 255"), KEPT, (0, "use 0 to 4095, which become 0 to 255")),
    "12": (
        (2, r"there is 10 \.HEIC files, but images are .* convert them to JPEG or PNG"),
        READ,
        *[MIXED] * 2,
        (0, r"the image is cut off: 1 of 12 images was left out"),
        READ,
        KEPT,
        *[READ] * 2,
    ),
    "13": (KEPT,),
    "14": tuple((0, pattern) for pattern in ["images +10, ", "recording: "] * 4),
    "15": tuple((0, pattern) for pattern in ["images +60, .*the robot: ", "recording: "] * 2),
    "17": (
        (0, "stamped by clocks -1699999488.000 s apart; the recorder's time is used for both"),
        (0, "stamps of /camera/image_raw, /odom are zero; the recorder's time is used for all"),
        (0, "stamps of /odom are zero; the recorder's time is used for all"),
        (0, "/camera/image_raw: time goes backwards.*4 of 20 messages were left out.*/odom: time goes backwards"),
        (0, "odometry begins anew at 1700000001.000 s; what follows is in "),
    ),
    "18": (
        *[(0, ON_BODY)] * 2,
        (2, "the image topics hold depth, no pictures: /camera/image_raw"),
        (0, "images of 16 bits use 0 to 4095, which become 0 to 255"),
        (0, ON_BODY),
        *[(2, "the image topics hold depth, no pictures")] * 2,
        (2, "an image compressed as 'h264' cannot be read"),
        (0, ON_BODY),
    ),
    "19": (
        *[NO_INDEX, (2, r"has no odometry topic; it has /camera \(sensor_msgs/msg/CompressedImage")] * 2,
        (0, "images +6, .*/cam/camera_info is of frame camera_optical, but /cam/image of c"),
        (2, "/cam/camera_info is of frame camera_optical, but /cam/image of c; name a camera file with --camera"),
    ),
    "20": (
        *[SOLVED] * 3,
        (0, "components +1 .*1 steps of robot robot-0 are not measured"),
        (0, "components +1 .*rejected +0 closures"),
        (2, "line 7: quaternion .* has no direction"),
        *[(2, "line 7: the information matrix is not positive definite")] * 2,
        (0, SOLVED[1] + ".*1 lines of kind EDGE_SE3_PRIOR are left out"),
        (0, "1 lines of kind EDGE_SE2_XY are left out .*1 lines of kind VERTEX_XY are left out"),
        (2, "has no edges EDGE_SE3:QUAT or EDGE_SE2, but lines 5 of kind EDGE3"),
        *[SOLVED] * 2,
        (0, SOLVED[1] + ".*EDGE_SE3_SWITCHABLE are left out .*VERTEX_SWITCH are left out"),
    ),
    "23": (
        (0, r"kitti-raw .*images +10, from 1317042145\.100 s .*has neither odometry nor ground truth"),
        (0, r"kitti .*images +10, from 0\.000 s to 0\.900 s .*160x120, fx 150 fy 150"),
        (2, r"times.txt:4: time goes backwards or stands still at 0\.200000 s"),
        (0, "euroc .*ground truth +10 poses .*intrinsics are missing"),
        (2, r"data.csv:3: time goes backwards, .*; 2 rows of 6 lie before"),
        (0, "replica .*ground truth +10 poses .*30 a second were assumed"),
        (0, r"odometry +10 poses, poses\.txt"),
        (2, r"transforms\.json: has no frames"),
        (0, "colmap .*ground truth +1 poses .*9 more images have no pose"),
    ),
    "27": (*[CUT] * 6, (0, "1 of 16 messages were left out: an image compressed as 'jpeg' cannot be read")),
}  # fmt: skip
"""Exit code, and what is said, of each call of a case's script that does not start a run."""


def quaternions_are_w_first(work: Path) -> None:
    """Case 07: the motion is a turn of 0.45 rad about z."""
    for name in ("vins", "euroc-header", "euroc-ns"):
        last = np.loadtxt(work / f"rec-{name}" / "odometry.tum")[-1].tolist()
        assert last[1:] == pytest.approx([1.85258977, -0.10203495, 0, 0, 0, 0.22310636, 0.97479411], abs=1e-6)


def levels_are_those_of_8_bits(work: Path) -> None:
    """Case 11."""
    for name in ("bits16", "bits12", "bits16-k3", "bits12-k3"):
        recording = Recording.open(work / f"{name}-rec")
        pixels = recording.load_image(recording.frames[0]).pixels
        assert (pixels.min(), pixels.max()) == pytest.approx((16, 239), abs=1)
        assert pixels.mean() == pytest.approx(125.7, abs=1)


def camera_looks_forward(work: Path) -> None:
    """Case 13."""
    wanted = np.array([[0, 0, 1, 0.2], [-1, 0, 0, 0], [0, -1, 0, 0.3], [0, 0, 0, 1]], float)
    np.testing.assert_allclose(Recording.open(work / "rec-False").T_body_camera, wanted, atol=1e-9)


def lines(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


def all_images_are_there(count: int, *names: str) -> Callable[[Path], None]:
    def check(work: Path) -> None:
        assert {name: lines(work / name / "images.txt") for name in names} == dict.fromkeys(names, count)

    return check


def clocks_cost_what_they_must(work: Path) -> None:
    """Case 17: images and poses of each recording, and of the journey after a reset."""
    counts = {"camera-uptime": (20, 20), "zero-stamps": (20, 20), "zero-odometry-stamps": (20, 20)}
    for name, wanted in {**counts, "ntp-step-back": (16, 16)}.items():
        assert (lines(work / f"rec-{name}/images.txt"), lines(work / f"rec-{name}/odometry.tum")) == wanted
    assert [lines(work / f"rec-odometry-reset{n}/odometry.tum") for n in ("", "-2")] == [10, 10]


def twelve_bits_fill_eight(work: Path) -> None:
    """Case 18."""
    first = min((work / "rec-mono16-12bit" / "images").iterdir())
    pixels = cv2.imread(str(first), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    assert pixels.max() == pytest.approx(239, abs=1)


def closures_are_used(work: Path) -> None:
    """Case 20."""
    for name in ("newer-to-older", "gaps", "crlf", "bom"):
        result = json.loads((work / name / "result.json").read_text())
        assert (result["closures"], result["closures_used"], len(result["components"])) == (1, 1, 1)


WRITTEN: dict[str, Callable[[Path], None]] = {
    "07": quaternions_are_w_first,
    "11": levels_are_those_of_8_bits,
    "13": camera_looks_forward,
    "14": all_images_are_there(10, "rec-file", "rec-message", "rec-mcapfile", "rec-mcapstorage"),
    "15": all_images_are_there(60, "rec", "rec-one"),
    "17": clocks_cost_what_they_must,
    "18": twelve_bits_fill_eight,
    "20": closures_are_used,
    "27": all_images_are_there(15, "rec-3-3", "rec-3-1000", "rec-0-1000", "rec-bag"),
}
"""What must stand in the files that the calls wrote."""


class NoProcesses:
    """In place of a script's `subprocess`: what it would start is looked at here."""

    def run(self, *_: object, **__: object) -> None:
        """Start nothing."""


@pytest.fixture
def feed(shared: Path) -> Path:
    folder = shared / "cases" / "feed"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    return folder


def test_every_case_has_its_right_values(feed: Path) -> None:
    there = {path.name[:2] for path in feed.iterdir() if path.is_dir() and path.name[:2].isdigit()}
    assert there == SAID.keys() | ELSEWHERE.keys()


@pytest.mark.parametrize("number", ELSEWHERE)
def test_a_case_that_is_not_replayed_has_its_tests(number: str) -> None:
    file, *names = ELSEWHERE[number]
    text = (TESTS / file).read_text(encoding="utf-8")
    assert [name for name in names if name not in text] == []


@pytest.mark.parametrize("number", SAID)
def test_a_case_gives_what_is_right(
    number: str,
    feed: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    (script,) = feed.glob(f"{number}-*/run.py")
    monkeypatch.setenv("FLOCC_CASES_OUT", str(tmp_path))
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(str(feed))
    for module in ("common", "bagkit"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    common = importlib.import_module("common")
    calls: list[tuple[int, str]] = []

    def call(*words: Any, **_: Any) -> None:
        if words[0] in ("simulate", "launch"):
            return
        capsys.readouterr()
        caplog.clear()
        monkeypatch.setattr(sys, "argv", ["flocc", *map(str, words)])
        with pytest.raises(SystemExit) as left:
            command_line.main()
        told = capsys.readouterr()
        calls.append(
            (int(left.value.code or 0), " ".join((" ".join(caplog.messages) + " " + told.out + told.err).split()))
        )

    monkeypatch.setattr(common, "flocc", call)
    monkeypatch.setattr(common, "subprocess", NoProcesses())
    try:
        runpy.run_path(str(script), run_name="__main__")
    finally:
        for module in ("common", "bagkit"):
            sys.modules.pop(module, None)
    assert [code for code, _ in calls] == [code for code, _ in SAID[number]]
    for (_, told), (_, pattern) in zip(calls, SAID[number], strict=True):
        assert re.search(pattern, told), f"{pattern!r} is not in {told!r}"
    if number in WRITTEN:
        WRITTEN[number](tmp_path / script.parent.name)
