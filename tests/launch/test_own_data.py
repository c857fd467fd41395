"""A user's own folder runs without a scenario file, and the mistakes that people make with one are said."""

import shutil
from pathlib import Path

import pytest
from tests.doc_props import IMAGES, PASSES, write_own_data
from tests.launch.bag_fixtures import walking

from flocc_agent.config import ConfigError
from flocc_agent.runtime.columns import UNITS_S
from flocc_agent.runtime.recording import Recording
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_agent.runtime.trajectory_text import read_tum
from flocc_launch.datasets.commands import convert, info, info_lines, split
from flocc_launch.datasets.detect import detect_format, read_source
from flocc_launch.datasets.source import DatasetError
from flocc_launch.scenarios.expectations import check_measurable
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.scenarios.shipped import read_scenario

COUNT = IMAGES * PASSES


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_own_data(tmp_path_factory.mktemp("own") / "my_data")


@pytest.fixture
def own(pristine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to spoil; generated data goes into the test's own cache."""
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path / "cache"))
    return Path(shutil.copytree(pristine, tmp_path / "my_data"))


def restamp(folder: Path, scale: float, offset_s: float = 0.0) -> None:
    truth = read_tum(folder / "groundtruth.txt")
    write_tum(folder / "groundtruth.txt", Trajectory(truth.stamps_s * scale + offset_s, truth.T_fixed_body))


def rename(folder: Path, name: str) -> None:
    """Name the images by their number, in a form such as `img_{}.jpg`."""
    for k, file in enumerate(sorted((folder / "images").iterdir()), start=1):
        file.rename(folder / "images" / name.format(k))


def test_one_data_set_is_cut_into_robots(own: Path) -> None:
    scenario = read_scenario(str(own), {"seed": 4}, agents=2)
    assert (scenario.name, scenario.names(), scenario.seed) == ("my_data", ["r1", "r2"], 4)
    paths = recordings(scenario)
    assert [len(Recording.open(path).frames) for path in paths.values()] == [COUNT // 2, COUNT // 2]


def test_an_error_can_be_expected_of_a_data_set_with_ground_truth(own: Path) -> None:
    """Whatever its file is called: what counts is the recording that is made of it."""
    asked = {"robots": {"red": {"recording": str(own)}}, "expectations": {"ate_max_m": 1.0}}
    scenario = Scenario.model_validate(asked)
    check_measurable(scenario, recordings(scenario))


def test_keyframes_are_closer_where_robots_move_little(own: Path) -> None:
    told: list[str] = []
    keyframes = read_scenario(str(own), {}, tell=told.append).keyframes
    assert keyframes.distance_m == pytest.approx(PASSES * 3.0 / 3 / 25, abs=0.01)
    assert len(told) == 1
    assert "cut by time into 3 robots; a keyframe every 0.12 m, because" in told[0]
    assert told[0].endswith("odometry is made of ground truth, with seeded drift as of wheeled")


def test_a_folder_of_data_sets_is_a_robot_each(own: Path, tmp_path: Path) -> None:
    team = tmp_path / "team"
    shutil.copytree(own, team / "Robot A")
    walking(True, count=4).write(team / "husky.bag")
    (team / "notes").mkdir()
    scenario = read_scenario(str(team), {})
    assert scenario.names() == ["husky", "robot-a"]
    frames = {name: len(Recording.open(path).frames) for name, path in recordings(scenario).items()}
    assert frames == {"husky": 4, "robot-a": COUNT}


def test_a_folder_around_one_data_set_is_that_data_set(own: Path, tmp_path: Path) -> None:
    around = tmp_path / "download"
    shutil.copytree(own, around / "drive")
    (around / "README.txt").write_text("who recorded it\n", encoding="utf-8")
    told: list[str] = []
    scenario = read_scenario(str(around), {}, agents=2, tell=told.append)
    assert scenario.names() == ["r1", "r2"]
    assert told[0].startswith(f"data: {around / 'drive'}, cut by time into 2 robots")


def test_a_robots_folder_may_hold_its_data_set_and_what_is_left_is_said(own: Path, tmp_path: Path) -> None:
    for place in ("a", "b/monday", "c/monday", "c/tuesday"):
        shutil.copytree(own, tmp_path / "team" / place)
    (tmp_path / "team" / "d").mkdir()
    (tmp_path / "team" / "d" / "walk.mp4").write_bytes(b"")
    (tmp_path / "team" / "notes").mkdir()
    told: list[str] = []
    scenario = read_scenario(str(tmp_path / "team"), {}, tell=told.append)
    assert scenario.names() == ["a", "b", "d"]
    assert "; not taken: c, notes" in told[0]
    assert str(scenario.robots["b"].recording).endswith("b/monday")
    assert str(scenario.robots["d"].recording).endswith("d/walk.mp4")


def test_robots_that_recorded_together_keep_their_distance_in_time(own: Path, tmp_path: Path) -> None:
    team = tmp_path / "team"
    for name in ("early", "late"):
        shutil.copytree(own, team / name)
    for file in sorted((team / "late" / "images").iterdir())[:8]:
        file.unlink()
    starts_s = {name: robot.start_s for name, robot in read_scenario(str(team), {}).robots.items()}
    assert starts_s == {"early": 0.0, "late": 2.0}


def test_recordings_of_different_times_are_played_together_and_it_is_said(own: Path, tmp_path: Path) -> None:
    team = tmp_path / "team"
    for name in ("early", "late"):
        shutil.copytree(own, team / name)
    images = sorted((team / "early" / "images").iterdir())
    for k, file in enumerate(images):
        (team / ("late" if k < len(images) // 2 else "early") / "images" / file.name).unlink()
    told: list[str] = []
    scenario = read_scenario(str(team), {}, tell=told.append)
    assert [robot.start_s for robot in scenario.robots.values()] == [0.0, 0.0]
    assert "; late was recorded 5 s after the first, but they are played as if they began together" in told[0]


def test_a_folder_of_bags_is_a_robot_each(tmp_path: Path) -> None:
    (tmp_path / "bags").mkdir()
    for name in ("husky", "jackal"):
        folder = walking(False, count=3).write(tmp_path / name, "mcap")
        next(folder.glob("*.mcap")).rename(tmp_path / "bags" / f"{name}.mcap")
    assert read_scenario(str(tmp_path / "bags"), {}).names() == ["husky", "jackal"]


def test_a_bag_that_needs_more_said_is_to_be_converted_first(own: Path, tmp_path: Path) -> None:
    scenario = read_scenario(str(walking(True, odometry=None).write(tmp_path / "run.bag")), {})
    with pytest.raises(DatasetError, match=r"has no odometry topic; .* recording with 'flocc dataset convert', and"):
        recordings(scenario)


def test_a_bag_in_several_files_is_one(tmp_path: Path) -> None:
    folder = walking(False, count=3).write(tmp_path / "run", "db3")
    (folder / "metadata.yaml").unlink()
    shutil.copyfile(next(folder.glob("*.db3")), folder / "run_1.db3")
    next(file for file in folder.glob("*.db3") if file.name != "run_1.db3").rename(folder / "run_0.db3")
    assert read_scenario(str(folder), {}).dataset is not None


def test_a_bag_is_cut_into_robots(own: Path, tmp_path: Path) -> None:
    scenario = read_scenario(str(walking(True, count=6).write(tmp_path / "run.bag")), {}, agents=2)
    assert [len(Recording.open(path).frames) for path in recordings(scenario).values()] == [3, 3]


def test_robots_that_are_there_are_not_counted_anew(own: Path, tmp_path: Path) -> None:
    for name in "ab":
        shutil.copytree(own, tmp_path / "team" / name)
    with pytest.raises(DatasetError, match=r"team: holds 2 robots \(a, b\), not 3"):
        read_scenario(str(tmp_path / "team"), {}, agents=3)


def test_two_folders_of_one_name_are_refused(own: Path, tmp_path: Path) -> None:
    for name in ("R1", "r1"):
        shutil.copytree(own, tmp_path / "team" / name)
    with pytest.raises(DatasetError, match=r"r1: its robot would be called r1, as that of .*R1"):
        read_scenario(str(tmp_path / "team"), {})


def test_a_folder_of_nothing_says_what_a_data_set_is(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"none of the known data sets .* a plain one has images/"):
        read_scenario(str(tmp_path), {})
    with pytest.raises(ConfigError, match="neither a file nor a shipped scenario"):
        read_scenario(str(tmp_path / "nothing"), {})


def test_a_folder_beside_does_not_hide_a_shipped_scenario(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(own.parent)
    own.rename("meeting")
    assert read_scenario("meeting", {}).tracks is not None


def test_data_that_was_mended_is_read_anew(own: Path) -> None:
    scenario = read_scenario(str(own), {}, agents=1)
    first = recordings(scenario)["r1"]
    restamp(own, 1.0, 0.125)
    assert recordings(scenario)["r1"] != first


def test_own_odometry_is_taken_where_there_is_ground_truth_too(own: Path, tmp_path: Path) -> None:
    truth = read_tum(own / "groundtruth.txt")
    stretched = truth.T_fixed_body.copy()
    stretched[:, :3, 3] *= 1.1
    write_tum(own / "odometry.tum", Trajectory(truth.stamps_s, stretched))
    first = Recording.open(split(own, tmp_path / "out", 3)[0])
    assert first.truth is not None
    assert read_tum(first.path / "odometry.tum").length_m() == pytest.approx(1.1 * first.truth.length_m(), rel=1e-6)


def test_images_beside_the_trajectory_are_a_plain_folder(own: Path) -> None:
    for file in (own / "images").iterdir():
        file.rename(own / file.name)
    (own / "images").rmdir()
    assert detect_format(own) == "plain"
    assert len(read_source(own).images) == COUNT


def test_numbered_images_are_taken_in_the_order_of_their_numbers(own: Path) -> None:
    rename(own, "My Photo ({}).jpg")
    names = [file.name for _, file in read_source(own).images]
    assert names[:2] == ["My Photo (1).jpg", "My Photo (2).jpg"]
    assert names[-1] == f"My Photo ({COUNT}).jpg"


@pytest.mark.parametrize(
    ("stem", "stamp_s"),
    [
        ("1700000000.25", 1700000000.25),
        ("1700000000", 1700000000.0),
        ("left_1700000000250", 1700000000.25),
        ("1700000000250000", 1700000000.25),
        ("cam0_1700000000250000000", 1700000000.25),
    ],
)
def test_the_unit_of_a_stamp_in_a_name_follows_from_its_digits(own: Path, stem: str, stamp_s: float) -> None:
    first = next(iter(sorted((own / "images").iterdir())))
    for file in (own / "images").iterdir():
        if file != first:
            file.unlink()
    first.rename(own / "images" / f"{stem}.jpg")
    assert [found_s for found_s, _ in read_source(own).images] == [pytest.approx(stamp_s, abs=1e-6)]


def test_two_images_of_one_stamp_are_said(own: Path) -> None:
    shutil.copyfile(own / "images" / "1700000000.000000.jpg", own / "images" / "b_1700000000.000000.jpg")
    with pytest.raises(DatasetError, match=r"b_1700000000.000000.jpg: has the stamp of another image"):
        read_source(own)


@pytest.mark.parametrize(
    ("scale", "offset_s", "sentence"),
    [
        (1.0, -1.6e9, "both must be of one clock"),
        (4.0, -6.8e9, "look like numbers of images, not seconds"),
    ],
)
def test_a_trajectory_of_another_time_is_said(own: Path, scale: float, offset_s: float, sentence: str) -> None:
    restamp(own, scale, offset_s)
    with pytest.raises(DatasetError, match=f"so none of them has a pose; .*{sentence}"):
        read_source(own)


@pytest.mark.parametrize("unit", ["milliseconds", "microseconds", "nanoseconds"])
def test_a_trajectory_in_another_unit_is_read_and_said(own: Path, unit: str) -> None:
    first_s = read_source(own).truth.stamps_s[0]  # type: ignore[union-attr]
    restamp(own, 1 / UNITS_S[unit])
    source = read_source(own)
    assert source.truth is not None
    assert source.truth.stamps_s[0] == pytest.approx(first_s)
    assert f"said to be in seconds, but can only be in {unit}" in source.notes[0]


def test_odometry_beside_the_folder_must_be_of_its_time(own: Path, tmp_path: Path) -> None:
    shutil.copyfile(own / "groundtruth.txt", tmp_path / "vio.tum")
    lines = [line.split(" ", 1)[1] for line in (tmp_path / "vio.tum").read_text().splitlines()[1:]]
    (tmp_path / "vio.tum").write_text("".join(f"{k * 0.25} {line}\n" for k, line in enumerate(lines)))
    with pytest.raises(DatasetError, match=r"vio.tum: the trajectory is from 0.000 s to 10.250 s, but the images"):
        convert(own, tmp_path / "out", odometry=tmp_path / "vio.tum")


def test_one_image_fewer_than_poses_is_no_fault_where_names_are_stamps(own: Path, tmp_path: Path) -> None:
    sorted((own / "images").iterdir())[30].unlink()
    assert len(Recording.open(convert(own, tmp_path / "out")).frames) == COUNT - 1


def test_one_numbered_image_fewer_than_poses_is_said(own: Path, tmp_path: Path) -> None:
    rename(own, "img_{}.jpg")
    (own / "images" / "img_7.jpg").unlink()
    with pytest.raises(DatasetError, match="has 41 images, but the trajectory has 42 poses; name images by their st"):
        convert(own, tmp_path / "out")


def test_what_is_no_image_is_left_out_and_said(own: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (own / "images" / "1700000001.000000.jpg").write_bytes(b"404 not found")
    convert(own, tmp_path / "out")
    assert "1700000001.000000.jpg: the image is damaged or of an unknown format" in caplog.text
    assert "1 of 42 images was left out" in caplog.text
    assert len(Recording.open(tmp_path / "out").frames) == COUNT - 1


@pytest.mark.parametrize(
    ("option", "value", "sentence"),
    [
        ("every", 5, "is a folder, but --every counts for a bag and a video only"),
        ("truth", Path("gt.tum"), "is a folder, but --truth counts for a bag only"),
        ("image_topic", "/camera", "is a folder, but --image-topic counts for a bag only"),
        ("time_offset_s", float("nan"), "--time-offset must be a finite number of seconds, not nan"),
    ],
)
def test_an_option_that_says_nothing_of_a_folder_is_refused(
    own: Path, tmp_path: Path, option: str, value: object, sentence: str
) -> None:
    with pytest.raises(DatasetError, match=sentence):
        convert(own, tmp_path / "out", **{option: value})  # type: ignore[arg-type]


def test_images_of_which_none_can_be_read_say_why(own: Path, tmp_path: Path) -> None:
    for file in (own / "images").iterdir():
        file.write_bytes(b"<html>404 not found</html>")
    with pytest.raises(DatasetError, match=r"no image in it can be read: .*\.(jpg|png): "):
        convert(own, tmp_path / "out")


def test_info_counts_the_images_that_have_a_pose(own: Path) -> None:
    lines = (own / "groundtruth.txt").read_text().splitlines(keepends=True)
    (own / "groundtruth.txt").write_text("".join(lines[:1] + lines[11:]))
    assert dict(info_lines(info(own)))["images"].endswith(f"; {COUNT - 10} of them within the trajectory")


def test_no_trajectory_is_said_with_the_names_that_it_could_have(own: Path, tmp_path: Path) -> None:
    (own / "groundtruth.txt").rename(own / "KeyFrameTrajectory.txt")
    with pytest.raises(
        DatasetError, match=r"neither odometry nor ground truth \(odometry, odom, vio, trajectory, .* looked for"
    ):
        convert(own, tmp_path / "out")


def test_a_data_set_is_never_written_over(own: Path, tmp_path: Path) -> None:
    before = {file: file.read_bytes() for file in own.rglob("*") if file.is_file()}
    with pytest.raises(DatasetError, match="holds something else"):
        convert(own, own)
    assert {file: file.read_bytes() for file in own.rglob("*") if file.is_file()} == before
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "camera.toml").write_text("mine")
    with pytest.raises(DatasetError, match=r"holds something else \(camera\.toml\)"):
        convert(own, tmp_path / "notes")
    assert [entry.name for entry in (tmp_path / "notes").iterdir()] == ["camera.toml"]


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("x.g2o", "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n", "is a pose graph, which has no images: flocc optimise FILE"),
        ("x.tum", "1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n", "is a trajectory; flocc needs the images, too"),
    ],
)
def test_a_file_of_another_kind_is_named_in_place_of_a_scenario(
    tmp_path: Path, name: str, text: str, sentence: str
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=sentence):
        read_scenario(str(tmp_path / name), {})
