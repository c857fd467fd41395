"""pytest plugin: scenarios in a user's own test suite, with their expectations as assertions.

    @pytest.mark.flocc("hangar.toml", radio={"loss_ratio": 0.3})      # driver="launch" takes real processes over zenoh
    def test_the_hangar_merges_on_a_bad_radio(flocc_run):
        assert flocc_run.report.closures.rejected < 50

    def test_two_seeds_give_two_runs(flocc):
        first, second = (flocc.simulate("hangar.toml", seed=seed).check() for seed in (1, 2))
        assert first.report.closures != second.report.closures

A marked test runs its scenario and fails before its first line where an expectation was missed, also where it does not
name `flocc_run`, which is the run; `flocc` runs any number of scenarios. A scenario is a file, relative to the test's
own, or the name of a shipped one. This module imports nothing of flocc before a test asks for it, so that other tests
do not wait for it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pytest

if TYPE_CHECKING:
    from flocc_launch.report.model import Expectation, RunReport
    from flocc_launch.scenarios.scenario import Scenario

MARKER = "flocc(scenario, driver='simulate', seed=None, **changes): the scenario that flocc_run runs"


@dataclass(frozen=True, slots=True)
class ScenarioRun:
    """One scenario that was run.

    Attributes:
        folder: Its run folder (docs/report.md).
        report: What `report.json` says.
    """

    folder: Path
    report: "RunReport"

    @property
    def missed(self) -> "list[Expectation]":
        """Expectations that were not met, and those without a value."""
        return [expectation for expectation in self.report.expectations if expectation.met is not True]

    def check(self) -> "ScenarioRun":
        """Fail the test where an expectation was missed, with what the doctor says of the run; gives the run back."""
        __tracebackhide__ = True
        if self.missed:
            pytest.fail(self._why(), pytrace=False)
        return self

    def _why(self) -> str:
        from flocc_launch.doctor import diagnose, finding_lines
        from flocc_launch.runs.run_folder import RunFolder

        asked = [f"{e.name}: expected {e.limit}, was {e.value}" for e in self.missed]
        found = finding_lines(diagnose(RunFolder.open(self.folder)))
        return "\n".join(
            [f"scenario {self.report.scenario} missed", *asked, *found, f"report: {self.folder}/report.html"]
        )


RUN = pytest.StashKey[ScenarioRun]()


class ScenarioRunner:
    """Runs scenarios, each in a folder of its own below the test's temporary one."""

    def __init__(self, tests: Path, out: Path) -> None:
        """Prepare.

        Args:
            tests: Folder that scenario files are relative to.
            out: Where run folders go.
        """
        self._tests = tests
        self._out = out
        self._count = 0

    def simulate(self, scenario: str | Path, seed: int | None = None, **changes: Any) -> ScenarioRun:
        """Run on virtual time; the same seed gives the same run.

        Args:
            scenario: File or name of a shipped one.
            seed: Another one than the scenario's.
            changes: Tables and keys of the scenario to replace, as `radio={"loss_ratio": 0.3}`.

        Raises:
            FloccError: The scenario cannot be used.
        """
        from flocc_launch.scenarios.recordings import recordings
        from flocc_launch.setup.cache import cache_folder
        from flocc_launch.simulation.simulate import simulate

        read, folder = self._read(scenario, seed, changes), self._fresh()
        report = simulate(read, folder, recordings=recordings(read), cache=cache_folder() / "perception")
        return ScenarioRun(folder, report)

    def launch(self, scenario: str | Path, seed: int | None = None, **changes: Any) -> ScenarioRun:
        """Run with one process per robot over real zenoh, in real time; arguments as for `simulate`.

        Raises:
            FloccError: The scenario cannot be used, or no agent could be started.
        """
        from flocc_launch.swarm.launching import launch

        folder = self._fresh()
        return ScenarioRun(folder, launch(self._read(scenario, seed, changes), folder))

    def _read(self, scenario: str | Path, seed: int | None, changes: Mapping[str, Any]) -> "Scenario":
        from flocc_launch.scenarios.shipped import read_scenario

        path = self._tests / scenario
        dotted = flat(changes) | ({} if seed is None else {"seed": seed})
        return read_scenario(str(path) if path.exists() else str(scenario), dotted)

    def _fresh(self) -> Path:
        self._count += 1
        return self._out / f"flocc-run-{self._count}"


def flat(changes: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Nested tables as dotted keys: `{"radio": {"loss_ratio": 0.3}}` is `{"radio.loss_ratio": 0.3}`."""
    found: dict[str, Any] = {}
    for key, value in changes.items():
        inner = flat(value, f"{above}{key}.") if isinstance(value, Mapping) else {f"{above}{key}": value}
        found |= inner
    return found


def pytest_configure(config: pytest.Config) -> None:
    """Make the marker known."""
    config.addinivalue_line("markers", MARKER)


def pytest_itemcollected(item: pytest.Item) -> None:
    """A marked test runs its scenario also where it does not look at the run."""
    if isinstance(item, pytest.Function) and item.get_closest_marker("flocc") and "flocc_run" not in item.fixturenames:
        item.fixturenames.append("flocc_run")


@pytest.fixture
def flocc(request: pytest.FixtureRequest, tmp_path: Path) -> ScenarioRunner:
    """Runs scenarios on demand."""
    return ScenarioRunner(request.path.parent, tmp_path)


@pytest.fixture
def flocc_run(request: pytest.FixtureRequest, flocc: ScenarioRunner) -> ScenarioRun:
    """The run of the test's `flocc` marker; the test fails before its first line where an expectation was missed."""
    marker = request.node.get_closest_marker("flocc")
    if marker is None or len(marker.args) != 1:
        pytest.fail("flocc_run needs @pytest.mark.flocc(SCENARIO)", pytrace=False)
    run = request.node.stash[RUN] = run_marked(flocc, marker.args[0], **marker.kwargs)
    return run


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> None:
    """Check the run of the marker here, so that a miss is a failure of the test and no error of its set-up."""
    __tracebackhide__ = True
    if RUN in item.stash:
        item.stash[RUN].check()


def run_marked(
    runner: ScenarioRunner,
    scenario: str | Path,
    driver: Literal["simulate", "launch"] = "simulate",
    seed: int | None = None,
    **changes: Any,
) -> ScenarioRun:
    """Run what a marker says; a scenario that cannot be used is one sentence, without flocc's own lines."""
    from flocc_protocol.errors import FloccError

    if driver not in ("simulate", "launch"):
        pytest.fail(f"flocc marker: driver is 'simulate' or 'launch', not {driver!r}", pytrace=False)
    run = runner.launch if driver == "launch" else runner.simulate
    try:
        return run(scenario, seed=seed, **changes)
    except FloccError as error:
        raise pytest.fail.Exception(str(error), pytrace=False) from None
