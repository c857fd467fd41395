"""The demo in small: shorter routes and smaller pictures, for a first look within a minute."""

import hashlib
from collections.abc import Callable

from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.scenarios.shipped import FOLDER
from flocc_launch.setup.cache import cache_folder

ROUTE_M = 63.0
SIZE_PX = (400, 300)
RATE = 4.0
SETTLE_S = 4.0
CLOSURES_MIN = 8.0


def small_demo(robots: int, seed: int, progress: Callable[[int, int], None] | None = None) -> Scenario:
    """Render a smaller world, unless it is there already, and give the scenario that plays it.

    Args:
        robots: How many walk through it.
        seed: Another seed is another world.
        progress: Called with (done, all) pictures.
    """
    from flocc_launch.world.generate import generate
    from flocc_launch.world.spec import WorldSpec

    spec = WorldSpec(robots=robots, seed=seed, route_m=ROUTE_M, width=SIZE_PX[0], height=SIZE_PX[1])
    key = hashlib.sha256(spec.model_dump_json().encode()).hexdigest()[:12]
    paths = generate(spec, cache_folder() / "worlds" / key, progress=progress)
    fields = {
        "name": "demo-small",
        "seed": 1,
        "rate": RATE,
        "settle_s": SETTLE_S,
        "robots": {f"r{k}": {"recording": str(path)} for k, path in enumerate(paths, start=1)},
        "expectations": {"frames_max": 1, "closures_min": CLOSURES_MIN},
    }
    return Scenario.of(fields, {}, FOLDER)
