"""One simulated run as an experiment's cell: nothing of it stays but its report."""

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from flocc_launch.report.model import Report
from flocc_launch.scenario import Scenario
from flocc_launch.simulation.simulate import simulate


def simulated(
    scenario: Scenario, seed: int, recordings: Mapping[str, Path] | None = None, cache: Path | None = None
) -> Report:
    """Run a scenario on virtual time; as `simulate`."""
    with TemporaryDirectory(prefix="flocc-experiment-") as folder:
        return simulate(scenario, Path(folder) / "run", seed, recordings, cache)
