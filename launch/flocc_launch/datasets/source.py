"""A data set as its reader found it, before it is written as recordings."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.lenses import CameraModel
from flocc_agent.runtime.pictures import FULL, Levels
from flocc_agent.runtime.trajectory import Trajectory
from flocc_protocol.errors import FloccError

Float = NDArray[np.float64]


class DatasetError(FloccError):
    """A data set that cannot be used; the message names the file or topic, and what was found instead."""


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """A camera with its mounting; images are remapped when they are written where an agent's camera cannot say it.

    Attributes:
        camera: Intrinsics.
        T_body_camera: (4, 4) pose of the camera in the body, metres.
        view_rad: Horizontal field of view of a wide lens's remapped images; None takes as much as there is.
        time_shift_s: What is added to the stamps of its pictures for those of the body's clock.
        notes: What its file says that is not used, one sentence each.
    """

    camera: CameraModel
    T_body_camera: Float = field(default_factory=lambda: np.eye(4))
    view_rad: float | None = None
    notes: tuple[str, ...] = ()
    time_shift_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """One robot's images and trajectories on disk.

    Attributes:
        path: The folder.
        format: Which reader read it.
        images: Stamps in seconds and files, in order of time.
        lens: Intrinsics, or None where the folder has none.
        odometry: `T_odom_body`, or None where the data set brings none.
        truth: `T_world_body`, or None.
        up_world: (3,) direction against gravity in the truth's world.
        faults: What is wrong with the rest, one sentence each; what is above is good.
        notes: What was left out, or concluded where nothing said it; one sentence each.
        levels: How images of 16 bits are brought to 8.
        is_posed_by_image: Whether each image has a pose of its own, and stamps are only numbers of both.
        calibrations: Files of the folder that describe its camera; the first of them is taken.
    """

    path: Path
    format: str
    images: tuple[tuple[float, Path], ...]
    lens: Lens | None
    odometry: Trajectory | None = None
    truth: Trajectory | None = None
    up_world: Float = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    faults: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    levels: Levels = FULL
    is_posed_by_image: bool = False
    calibrations: tuple[Path, ...] = ()
