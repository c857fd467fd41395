"""Which perception back-ends there are: flocc's own, and those that installed packages bring.

A back-end has a name, `perception.method`, and a builder. A package brings one by an entry point of the group
`flocc.perception`; flocc's own names cannot be taken. Nothing heavy is imported before a back-end is built.
"""

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points

from flocc_agent.config import PerceptionConfig
from flocc_agent.core.interfaces import Perception
from flocc_protocol.errors import FloccError

GROUP = "flocc.perception"
"""Group of entry points that name a `Builder`."""

RAISED_BY_STRANGERS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    ImportError,
    LookupError,
    NameError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
)
"""What importing and building a stranger's back-end may raise; an exception of its own is its own affair."""

Builder = Callable[[PerceptionConfig, int], Perception]
"""Makes a back-end of its configuration and the run's seed; what belongs to a stranger's stands in `options`."""


class PerceptionError(FloccError):
    """A perception back-end that is not there, or cannot be built; one sentence says which are."""


def build_perception(config: PerceptionConfig, seed: int = 0) -> Perception:
    """Make the configured perception back-end.

    Raises:
        PerceptionError: No back-end has this name, or an installed one cannot be imported or built.
        FloccError: A checkpoint or an extra is missing.
    """
    own = OWN.get(config.method)
    return own(config, seed) if own is not None else _installed(config, seed)


def check_perception(config: PerceptionConfig) -> None:
    """Say what can be chosen where the configured back-end is not there; nothing is imported or built.

    Raises:
        PerceptionError: No back-end has this name.
    """
    if config.method not in OWN:
        _entry_point(config.method)


def methods() -> dict[str, str]:
    """Name of every back-end that can be chosen -> the package that brings it."""
    brought = {name: _package(point) for name, point in sorted(_entry_points().items())}
    return {**brought, **dict.fromkeys(OWN, "flocc")}


def _installed(config: PerceptionConfig, seed: int) -> Perception:
    """Build what another package brings; what goes wrong in its code is told in one sentence."""
    point = _entry_point(config.method)
    whose = f"perception {config.method!r} of {_package(point)} ({point.value})"
    try:
        built = point.load()(config, seed)
    except RAISED_BY_STRANGERS as error:
        raise PerceptionError(f"{whose} cannot be built: {str(error) or type(error).__name__}") from error
    if not isinstance(built, Perception):
        raise PerceptionError(f"{whose} gives a {type(built).__name__}, not a flocc_agent.core.interfaces.Perception")
    return built


def _entry_point(method: str) -> EntryPoint:
    point = _entry_points().get(method)
    if point is None:
        raise PerceptionError(f"perception.method {method!r} is unknown; {_known()}")
    return point


def _known() -> str:
    """What can be chosen, as half a sentence."""
    brought = ", ".join(f"{name} (of {package})" for name, package in methods().items() if name not in OWN)
    return f"flocc's own are {', '.join(OWN)}; installed packages bring {brought or 'none'}"


def _entry_points() -> dict[str, EntryPoint]:
    """Installed back-ends by name; of one name the first on the path counts."""
    found: dict[str, EntryPoint] = {}
    for point in entry_points(group=GROUP):
        found.setdefault(point.name, point)
    return found


def _package(point: EntryPoint) -> str:
    return "an unnamed package" if point.dist is None else f"{point.dist.name} {point.dist.version}"


def _classical(config: PerceptionConfig, seed: int) -> Perception:  # noqa: ARG001
    from flocc_agent.perception.classical import ClassicalDescriber, ClassicalEncoder, classical_registrar

    given = config.classical
    return Perception(ClassicalDescriber(given), ClassicalEncoder(given), classical_registrar(given))


def _synthetic(config: PerceptionConfig, seed: int) -> Perception:
    from flocc_agent.perception.synthetic import SyntheticPerception

    synthetic = SyntheticPerception(config.synthetic, seed)
    return Perception(synthetic, synthetic, synthetic)


def _recorded(config: PerceptionConfig, seed: int) -> Perception:  # noqa: ARG001
    from flocc_agent.perception.recorded import RecordedPerception

    recorded = RecordedPerception(config.recorded)
    return Perception(recorded, recorded, recorded)


def _mast3r(config: PerceptionConfig, seed: int) -> Perception:  # noqa: ARG001
    from flocc_agent.perception.mast3r import build

    return Perception(*build(config.mast3r))


def _learned(config: PerceptionConfig, seed: int) -> Perception:  # noqa: ARG001
    from flocc_agent.perception.learned import build

    return Perception(*build(config.learned))


OWN: dict[str, Builder] = {
    "classical": _classical,
    "learned": _learned,
    "synthetic": _synthetic,
    "recorded": _recorded,
    "mast3r": _mast3r,
}
"""flocc's own back-ends by name."""
