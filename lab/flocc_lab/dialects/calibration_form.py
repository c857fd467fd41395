"""What a calibration is written from, and the pieces of text that several forms share."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.lenses import CameraModel, LensKind

Float = NDArray[np.float64]
P, E, F = LensKind.PINHOLE, LensKind.EQUIDISTANT, LensKind.FOV
MEI, D, U = LensKind.OMNIDIRECTIONAL, LensKind.DOUBLE_SPHERE, LensKind.EUCM


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """A camera on a body.

    Attributes:
        model: Intrinsics.
        T_body_camera: (4, 4) mounting, metres.
        time_shift_s: What Kalibr calls `timeshift_cam_imu`.
    """

    model: CameraModel
    T_body_camera: Float
    time_shift_s: float = 0.0


@dataclass(frozen=True, slots=True)
class WriterForm:
    """How one tool writes a calibration.

    Attributes:
        name: The file's name.
        write: Gives the text.
        kinds: Camera models that it can say.
        counts: Numbers of distortion coefficients that it can say of a pinhole.
        mounting: Whether it says `T_body_camera`.
        sized: Whether it says the size of the images.
        sizes: Those that it can say; none means any.
        shift: Whether it says the offset of the camera's clock.
    """

    name: str
    write: Callable[[Rig], str]
    kinds: tuple[LensKind, ...] = (P,)
    counts: tuple[int, ...] = (0, 4)
    mounting: bool = False
    sized: bool = True
    sizes: tuple[tuple[int, int], ...] = ()
    shift: bool = False


def number_list(values: Sequence[float] | Float) -> str:
    """Numbers in brackets, as YAML and JSON take them."""
    return "[" + ", ".join(repr(float(value)) for value in np.asarray(values).ravel()) + "]"


def matrix_rows(T: Float, indent: str = "  ") -> str:
    """Rows of a matrix, one below the other in YAML."""
    return "".join(f"{indent}- {number_list(row)}\n" for row in T)


def yaml_block(values: Sequence[float] | Float, indent: str = "") -> str:
    """Numbers one below the other in YAML."""
    return "".join(f"{indent}- {float(value)!r}\n" for value in np.asarray(values).ravel())


def opencv_matrix(key: str, M: Float, tag: bool = True, indent: str = "") -> str:
    """A matrix as OpenCV's FileStorage writes it, with or without its YAML tag."""
    rows, columns = M.shape
    mark = " !!opencv-matrix" if tag else ""
    kind = f"{indent}   dt: d\n" if tag else ""
    return (
        f"{indent}{key}:{mark}\n{indent}   rows: {rows}\n{indent}   cols: {columns}\n{kind}"
        f"{indent}   data: {number_list(M)}\n"
    )


def focal_of(m: CameraModel) -> tuple[float, float, float, float]:
    """Focal lengths and principal point, pixels."""
    return m.fx, m.fy, m.cx, m.cy


def radtan_of(m: CameraModel, count: int) -> tuple[float, ...]:
    """Distortion with zeros up to a count."""
    return (*m.distortion, *[0.0] * (count - len(m.distortion)))


def kalibr_names(m: CameraModel) -> tuple[str, str]:
    """Kalibr's names of the camera and the distortion model."""
    return {
        P: ("pinhole", "radtan" if m.distortion else "none"),
        E: ("pinhole", "equidistant"),
        F: ("pinhole", "fov"),
        MEI: ("omni", "radtan" if m.distortion else "none"),
        D: ("ds", "none"),
        U: ("eucm", "none"),
    }[m.kind]


def ros_name(m: CameraModel) -> str:
    """What ROS calls the distortion model."""
    return "equidistant" if m.kind is E else "rational_polynomial" if len(m.distortion) > 5 else "plumb_bob"
