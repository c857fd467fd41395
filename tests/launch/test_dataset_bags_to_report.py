"""From bags in S3E's and GrAco's published layout through `flocc launch` to a report."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.launch.bag_fixtures import ZERO_NS, BagScript

from flocc_agent.runtime.recording import Recording, write_camera
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_agent.runtime.trajectory_text import read_tum
from flocc_launch.datasets.presets import Team, convert_graco, convert_s3e
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.swarm.launching import launch
from flocc_launch.world.generate import generate
from flocc_launch.world.spec import WorldSpec

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow, pytest.mark.timeout(600)]

ROBOTS = 3


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """One walk, of which each robot saw every third image."""
    spec = WorldSpec(width=320, height=240, route_m=15.0, robots=1, image_rate_hz=4.0)
    return Recording.open(generate(spec, tmp_path_factory.mktemp("world"), processes=2)[0])


def team_of(walk: Recording, names: tuple[str, ...], folder: Path) -> Team:
    """Odometry, ground truth and cameras beside the bags, in the bags' time."""
    cameras = {}
    for name in names:
        for kind, file in (("odometry", f"{name}.tum"), ("groundtruth", f"{name}_gt.txt")):
            (folder / kind).mkdir(exist_ok=True)
            own = read_tum(walk.path / f"{kind}.tum")
            write_tum(folder / kind / file, Trajectory(own.stamps_s + ZERO_NS * 1e-9, own.T_fixed_body))
        cameras[name] = folder / f"{name}.toml"
        write_camera(cameras[name], walk.camera, walk.T_body_camera)
    return Team(folder / "odometry", folder / "groundtruth", cameras)


def add_images(script: BagScript, walk: Recording, robot: int, topic: str, raw: bool) -> None:
    for frame in walk.frames[robot::ROBOTS]:
        stamp_ns = ZERO_NS + round(frame.stamp_s * 1e9)
        if raw:
            grey = cv2.cvtColor(walk.load_image(frame).pixels, cv2.COLOR_RGB2GRAY)
            script.raw(topic, stamp_ns, np.asarray(grey), "mono8")
        else:
            script.jpeg(topic, stamp_ns, frame.image_path.read_bytes())


def launched(recordings: list[Path], out: Path) -> None:
    """Run the recordings as a swarm, which ends in one map."""
    robots = {path.name: {"recording": str(path)} for path in recordings}
    report = launch(Scenario.model_validate({"name": "bags", "rate": 2.0, "robots": robots}), out)
    assert sorted(report.robots) == sorted(robots)
    assert report.closures.accepted_inter_robot >= 2
    assert len(report.map_frames) == 1
    assert report.ate_joint_m is not None
    assert (out / "report.html").stat().st_size > 1000


def test_an_s3e_bag_runs_to_a_report(walk: Recording, tmp_path: Path) -> None:
    script = BagScript(False)
    for robot, name in enumerate(("Alpha", "Bob", "Carol")):
        add_images(script, walk, robot, f"/{name}/left_camera/compressed", raw=False)
    script.messages.sort(key=lambda message: message[2])
    bag = script.write(tmp_path / "S3E_Square_1", "db3")
    team = team_of(walk, ("alpha", "bob", "carol"), tmp_path)
    launched(convert_s3e(bag, tmp_path / "recordings", team), tmp_path / "run")


def test_graco_bags_run_to_a_report(walk: Recording, tmp_path: Path) -> None:
    names = ("ground-01", "ground-02", "ground-03")
    (tmp_path / "bags").mkdir()
    for robot, name in enumerate(names):
        script = BagScript(True)
        add_images(script, walk, robot, "/camera_left/image_raw", raw=True)
        script.write(tmp_path / "bags" / f"{name}.bag")
    team = team_of(walk, names, tmp_path)
    launched(convert_graco(tmp_path / "bags", tmp_path / "recordings", team), tmp_path / "run")
