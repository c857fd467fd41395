"""What camera models are called by those who write calibrations, and how many coefficients each name goes with."""

from collections.abc import Sequence

from flocc_agent.lenses.models import CameraModel, LensKind

RADTAN = frozenset(
    {"plumb_bob", "plumbbob", "radtan", "radialtangential", "radial_tangential", "brown_conrady", "brown", "opencv",
     "pinhole"}
)  # fmt: skip
RATIONAL = frozenset({"rational_polynomial", "rational", "radtan8", "pinhole_radtan8", "full_opencv"})
EQUIDISTANT = frozenset(
    {"equidistant", "equi", "fisheye", "kannala_brandt", "kannala_brandt4", "kannalabrandt", "kannalabrandt8",
     "kannala_brandt8", "kb", "kb4", "kb8", "opencv_fisheye", "pinhole_equi", "pinhole_equidistant", "fisheye4"}
)  # fmt: skip
FOV = frozenset({"fov", "atan", "pinhole_fov"})
NONE = frozenset({"", "none", "no_distortion", "perspective", "rectified", "null"})
ZEROED = frozenset({"inverse_brown_conrady", "modified_brown_conrady"})
"""What RealSense writes with zeros for images without distortion; with other numbers these are other models."""
OMNIDIRECTIONAL = frozenset({"omni", "omni_radtan", "omnidirectional", "mei", "unified", "ucm_mei"})
DOUBLE_SPHERE = frozenset({"ds", "ds_none", "double_sphere", "doublesphere"})
EUCM = frozenset({"eucm", "eucm_none", "extended_unified"})

READ = "plumb_bob (radtan), rational_polynomial, equidistant (Kannala-Brandt), fov, omni (Mei), ds and eucm"

Coefficients = Sequence[float]


def plain_name(name: str) -> str:
    """A model's name without the differences of capitals, dashes and spaces, and without RealSense's prefix."""
    return name.strip().lower().replace("-", "_").replace(" ", "_").removeprefix("distortion.")


def kind_of(name: str) -> LensKind | None:
    """The family that a name of a camera or distortion model says; None where it is not known."""
    plain = plain_name(name)
    families = {
        LensKind.PINHOLE: RADTAN | RATIONAL | NONE | ZEROED,
        LensKind.EQUIDISTANT: EQUIDISTANT,
        LensKind.FOV: FOV,
        LensKind.OMNIDIRECTIONAL: OMNIDIRECTIONAL,
        LensKind.DOUBLE_SPHERE: DOUBLE_SPHERE,
        LensKind.EUCM: EUCM,
    }
    return next((kind for kind, names in families.items() if plain in names), None)


def with_distortion(
    name: str | None, coefficients: Coefficients, size: tuple[int, int], focal: tuple[float, float, float, float]
) -> CameraModel:
    """The model of a focal matrix with a named distortion, as ROS, Kalibr and OpenCV write it.

    Args:
        name: Of the distortion model; None where the file names none: OpenCV's order is taken.
        coefficients: In the order of the name.
        size: Width and height of the pictures.
        focal: fx fy cx cy.

    Raises:
        ValueError: The name is not known, or goes with another number of coefficients.
    """
    plain = None if name is None else plain_name(name)
    kind = LensKind.PINHOLE if plain is None else kind_of(plain)
    if kind not in (LensKind.PINHOLE, LensKind.EQUIDISTANT, LensKind.FOV):
        raise ValueError(f"the distortion model is {name!r}; flocc reads {READ}")
    if kind is LensKind.FOV:
        return CameraModel(*size, *focal, kind=kind, shape=_counted(name, coefficients, (1,)))
    if kind is LensKind.EQUIDISTANT:
        return CameraModel(*size, *focal, _counted(name, coefficients, (4,)), kind)
    if plain in ZEROED and any(coefficients):
        raise ValueError(f"the distortion model is {name!r} with other numbers than zeros; flocc reads {READ}")
    counts: tuple[int, ...] = (0, 4, 5, 8, 12, 14)
    if plain in NONE and plain:
        counts = (0,)
    elif plain in RADTAN:
        counts = (0, 4, 5)
    elif plain in RATIONAL:
        counts = (8, 12, 14)
    return CameraModel(*size, *focal, _counted(name, coefficients, counts))


def _counted(name: str | None, coefficients: Coefficients, counts: tuple[int, ...]) -> tuple[float, ...]:
    """Coefficients of which there are as many as the name says; zeros behind them are left out."""
    given = tuple(coefficients)
    if len(given) in counts:
        return given
    fitting = [count for count in counts if count < len(given) and not any(given[count:])]
    if fitting:
        return given[: max(fitting)]
    told = f"the distortion model {name!r} has" if name else "distortion has"
    raise ValueError(f"{told} {' or '.join(map(str, counts))} coefficients, but there are {len(given)}: {list(given)}")
