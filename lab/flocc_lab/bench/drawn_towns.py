"""Teams in towns that nobody has seen: houses, camera, light and odometry are drawn; do they keep wrong closures?

Every second town is terraced: its blocks are alike, house by house, so that places are told apart by what stands in the
streets only. A wrong map that nobody is warned of is the worst that can happen: a row says what the doctor's first
sentence says of it.

    python -m flocc_lab.bench.drawn_towns OUT --first 1700 --towns 4
"""

import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

from flocc_agent.config import PerceptionConfig
from flocc_lab.bench.watched_drives import drawn_town
from flocc_launch.doctor.diagnose import diagnose_loaded
from flocc_launch.runs.loaded_run import load
from flocc_launch.runs.right_closures import verdicts
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.setup.cache import cache_folder
from flocc_launch.simulation.simulate import simulate
from flocc_launch.world.generate import generate
from flocc_launch.world.spec import WorldSpec

ROUTE_M = 30.0
ROBOTS = 3
HEADS = ("town", "closures", "wrong", "wrong ones used", "maps", "joint ATE, m", "odometry, m", "the doctor")


def drawn_team(seed: int) -> tuple[WorldSpec, float, str]:
    """A town for a team, the distance between its keyframes, and both in words."""
    spec, keyframes, words = drawn_town(seed)
    terraced = seed % 2 == 1
    spec = spec.model_copy(update={"robots": ROBOTS, "route_m": ROUTE_M, "terraced": terraced})
    light = f"light {spec.light_change:.1f}"
    return spec, keyframes.distance_m, f"{seed}: {words}, {light}{', terraced' if terraced else ''}"


def row(seed: int, folder: Path, front_end: PerceptionConfig) -> str:
    """Render a town, let its team walk on virtual time, and judge the run by the truth."""
    spec, distance_m, words = drawn_team(seed)
    paths = generate(spec, folder / f"town-{seed}", processes=1)
    scenario = Scenario.of(
        {
            "name": f"town-{seed}",
            "rate": 2.0,
            "settle_s": 8.0,
            "robots": {path.name: {"recording": str(path)} for path in paths},
            "perception": front_end.model_dump(),
            "keyframes": {"distance_m": distance_m},
        },
        {},
        folder,
    )
    run = RunFolder(folder / f"run-{seed}-{front_end.method}")
    report = simulate(scenario, run.path, 1, cache=cache_folder() / "perception")
    loaded = load(run)
    found = verdicts(loaded)
    used = {(pair.query, pair.match): pair.used is not False for pair in loaded.pairs}
    wrong = [ends for ends, right in found.items() if not right]
    first = diagnose_loaded(loaded)[0]
    cells = (
        words,
        len(found),
        len(wrong),
        sum(used[ends] for ends in wrong),
        len(report.map_frames),
        _rounded(report.ate_joint_m),
        _rounded(report.ate_joint_odometry_m),
        f"{first.severity.value}: {first.sentence}",
    )
    return "| " + " | ".join(map(str, cells)) + " |"


def _rounded(value_m: float | None) -> str:
    return "" if value_m is None else f"{value_m:.3f}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row for each town."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--first", type=int, default=1700)
    parser.add_argument("--towns", type=int, default=4)
    parser.add_argument("--model", help="of the learned front end; the classical one without")
    given = parser.parse_args(arguments)
    chosen = {} if given.model is None else {"method": "learned", "learned": {"model": given.model}}
    front_end = PerceptionConfig.model_validate(chosen)
    sys.stdout.write(f"| {' | '.join(HEADS)} |\n{'| --- ' * len(HEADS)}|\n")
    for seed in range(given.first, given.first + given.towns):
        sys.stdout.write(f"{row(seed, given.out, front_end)}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
