"""Short missions on virtual time, of which tests make maps."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from flocc_launch.maps.opening import MapUse
from flocc_launch.report.model import RunReport
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation import simulate as driver
from flocc_launch.simulation.simulate import simulate

NO_LIVES: Mapping[str, int] = MappingProxyType({})
BLOCK = {"r1": [[0, 0], [12, 0], [12, 8], [0, 8], [0, 0]], "r2": [[12, 8], [0, 8], [0, 0], [12, 0], [12, 8]]}
AGAIN = {"r1": [[6, 0], [12, 0], [12, 8], [6, 8]]}
FAR = {"r1": [[100, 50], [112, 50], [112, 58], [100, 58]], "r2": [[112, 58], [100, 58], [100, 50], [112, 50]]}


def scenario(routes: Mapping[str, object], name: str = "block", **changes: object) -> Scenario:
    """Robots that walk these ways, with synthetic perception."""
    fields = {
        "name": name,
        "tracks": {"robots": len(routes), "seed": 3, "routes_m": dict(routes)},
        "keyframes": {"distance_m": 0.75},
        "perception": {"method": "synthetic"},
    }
    return Scenario.model_validate(fields | changes)


def mission(
    out: Path, routes: Mapping[str, object], use: MapUse | None = None, lives: Mapping[str, int] = NO_LIVES
) -> RunReport:
    """Walk; robots begin with the incarnations of `lives`, as teams of other names would have other logs."""
    if not lives:
        return simulate(scenario(routes), out, use=use)
    plain = driver.swarm_of

    def with_lives(*arguments: object) -> object:
        given = list(arguments)
        given[5] = lives
        return plain(*given)  # type: ignore[arg-type]

    driver.swarm_of = with_lives  # type: ignore[assignment]
    try:
        return simulate(scenario(routes), out, use=use)
    finally:
        driver.swarm_of = plain
