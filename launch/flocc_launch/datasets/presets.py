"""The paper's data sets by their published topics: S3E (one ROS 2 bag, three robots) and GrAco (a ROS 1 bag each).

Neither holds odometry: users bring a TUM trajectory per robot. Only what is published stands here; the cameras that are
not (S3E's Bob and Carol, GrAco's aerial robots) need a camera file each.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from flocc_agent.lenses import CameraModel
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_launch.datasets.bag_convert import BagOptions, convert_bag
from flocc_launch.datasets.source import DatasetError, Lens
from flocc_launch.datasets.writer import Progress

S3E_ALPHA = Lens(
    CameraModel(
        1224, 1024, 1172.771733, 1172.364006, 617.941546, 507.672727,
        (-0.0526283898, 0.1008326896, 0.0003951125, 0.0003620605),
    ),
    np.array(
        [
            [0.00671209, -0.00971447, 0.99993029, 0.14118513],
            [-0.99993865, -0.00887635, 0.00662591, 0.1552482],
            [0.00881136, -0.99991342, -0.00977345, 0.01917531],
            [0.0, 0.0, 0.0, 1.0],
        ]
    ),
)  # fmt: skip
GRACO_GROUND = Lens(
    CameraModel(
        1600, 1100, 940.862826, 938.554924, 799.162698, 559.295407,
        (-0.10085041, 0.08905707, 0.00075170, -0.00119584),
    )
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Team:
    """What stands beside the bags of a team.

    Attributes:
        odometry: Folder with one TUM file per robot, `ROBOT.tum` or `ROBOT.txt`.
        truth: Folder with ground truth per robot, `ROBOT.tum`, `ROBOT.txt` or `ROBOT_gt.txt`; None has none.
        cameras: Camera files by robot, in place of the published ones.
        every: Keeps one image of so many.
    """

    odometry: Path
    truth: Path | None = None
    cameras: Mapping[str, Path] = field(default_factory=dict)
    every: int = 1


def convert_team(
    preset: str,
    source: Path,
    out: Path,
    odometry: Path,
    truth: Path | None,
    cameras: Sequence[str],
    every: int = 1,
    progress: Progress | None = None,
) -> list[Path]:
    """Convert a published data set by the name of its preset; cameras are given as `ROBOT=FILE`.

    Raises:
        DatasetError: The preset or a camera's form is not known, or the conversion fails.
    """
    converters = {"s3e": convert_s3e, "graco": convert_graco}
    if preset not in converters:
        raise DatasetError(f"the preset {preset!r} is not known; there are {', '.join(converters)}")
    files: dict[str, Path] = {}
    for pair in cameras:
        robot, separator, file = pair.partition("=")
        if not separator:
            raise DatasetError(f"--camera {pair!r} must be ROBOT=FILE")
        files[robot] = Path(file)
    return converters[preset](source, out, Team(odometry, truth, files, every), progress)


def convert_s3e(bag: Path, out: Path, team: Team, progress: Progress | None = None) -> list[Path]:
    """Convert one S3E sequence: Alpha, Bob and Carol become alpha, bob and carol.

    Raises:
        DatasetError: A camera, an odometry file or a topic is missing, or the bag is damaged.
    """
    folders = []
    for name in ("Alpha", "Bob", "Carol"):
        robot = name.lower()
        lens = S3E_ALPHA if robot == "alpha" else None
        topic = f"/{name}/left_camera/compressed"
        options = _options(team, robot, topic, lens, f"S3E publishes no calibration of {name}'s camera here")
        folders.append(convert_bag(bag, out / robot, options, progress))
    return folders


def convert_graco(folder: Path, out: Path, team: Team, progress: Progress | None = None) -> list[Path]:
    """Convert a folder of GrAco bags (`ground-01.bag`, `aerial-01.bag`), to be run as if they were concurrent.

    Stamps are counted from each bag's first image, and positions of ground truth from the first robot's first.

    Raises:
        DatasetError: A camera, an odometry file or a topic is missing, or a bag is damaged.
    """
    bags = sorted(folder.glob("*.bag"))
    if not bags:
        raise DatasetError(f"{folder}: has no bag")
    origin: tuple[float, float, float] | None = None
    folders = []
    for bag in bags:
        lens = GRACO_GROUND if bag.stem.startswith("ground") else None
        options = _options(team, bag.stem, "/camera_left/image_raw", lens, "GrAco's aerial cameras are not known here")
        if options.truth is not None and origin is None:
            x, y, z = read_trajectory(options.truth, otherwise="tum")[0].T_fixed_body[0, :3, 3]
            origin = (float(x), float(y), float(z))
        options = _concurrent(options, origin)
        folders.append(convert_bag(bag, out / bag.stem, options, progress))
    return folders


def _concurrent(options: BagOptions, origin: tuple[float, float, float] | None) -> BagOptions:
    return replace(options, from_zero=True, origin_m=origin or (0.0, 0.0, 0.0))


def _options(team: Team, robot: str, topic: str, lens: Lens | None, why_not: str) -> BagOptions:
    camera = team.cameras.get(robot, lens)
    if camera is None:
        raise DatasetError(f"{robot}: intrinsics are missing: {why_not}; name a camera file with --camera {robot}=FILE")
    odometry = _file(team.odometry, [f"{robot}.tum", f"{robot}.txt"])
    if odometry is None:
        raise DatasetError(f"{team.odometry}: has no odometry of {robot} ({robot}.tum or {robot}.txt)")
    truth = None
    if team.truth is not None:
        truth = _file(team.truth, [f"{robot}.tum", f"{robot}.txt", f"{robot}_gt.txt"])
    return BagOptions(
        image_topic=topic, camera=camera, odometry=odometry, truth=truth, every=team.every, published_form="tum"
    )


def _file(folder: Path, names: list[str]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_file()), None)
