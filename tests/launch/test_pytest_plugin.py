"""The pytest plugin, in test suites of their own: what a user sees of scenarios that pass, fail or cannot be used."""

import re

import pytest

pytest_plugins = ["pytester"]

SCENARIO = """
name = "hangar"
rate = 4.0
[tracks]
robots = 2
[tracks.routes_m]
r1 = [[0, 0], [12, 0]]
r2 = [[0, 0], [12, 0]]
[perception]
method = "synthetic"
[simulation]
optimiser = "quick"
[expectations]
merged_within_s = 20.0
closures_min = 1
"""


def run(pytester: pytest.Pytester, tests: str, *arguments: str) -> pytest.RunResult:
    pytester.makefile(".toml", hangar=SCENARIO)
    pytester.makepyfile(tests)
    return pytester.runpytest_subprocess("-p", "no:cacheprovider", "--strict-markers", *arguments)


def test_scenarios_that_pass_fail_or_cannot_be_used(pytester: pytest.Pytester) -> None:
    """One suite for all of them: each suite starts a Python of its own."""
    result = run(
        pytester,
        """
        import pytest

        APART = [{"at_s": 0.0, "kind": "partition", "groups": [["r1"], ["r2"]]}]

        @pytest.mark.flocc("hangar.toml", seed=3, radio={"loss_ratio": 0.1})
        def test_its_report_is_at_hand(flocc_run):
            assert flocc_run.report.seed == 3
            assert flocc_run.report.closures.accepted_inter_robot >= 1
            assert (flocc_run.folder / "report.html").exists()

        @pytest.mark.flocc("hangar.toml", faults=APART)
        def test_a_missed_expectation(flocc_run):
            raise AssertionError("the check fails before")

        def test_a_seed_is_a_run(flocc):
            one, again, other = (flocc.simulate("hangar.toml", seed=seed).check() for seed in (1, 1, 2))
            events = [(run.folder / "events.jsonl").read_bytes() for run in (one, again, other)]
            assert events[0] == events[1] != events[2]

        def test_a_miss_is_no_failure_until_it_is_checked(flocc):
            run = flocc.simulate("hangar.toml", expectations={"closures_min": 100_000})
            assert [expectation.name for expectation in run.missed] == ["closures_min"]

        @pytest.mark.flocc("hangar.toml", radio={"lossy": 1.0})
        def test_unknown_key(flocc_run): ...

        @pytest.mark.flocc("nowhere.toml")
        def test_no_file(flocc_run): ...

        @pytest.mark.flocc("nowhere.toml")
        def test_no_file_and_no_look_at_the_run(): ...

        @pytest.mark.flocc("hangar.toml", faults=APART)
        def test_a_miss_that_nobody_looks_at(): ...

        @pytest.mark.flocc("hangar.toml", driver="gazebo")
        def test_no_driver(flocc_run): ...

        def test_no_marker(flocc_run): ...
        """,
    )
    result.assert_outcomes(passed=3, failed=2, errors=5)
    lines = "\n".join(result.outlines)
    assert re.search(r"merged_within_s: expected 20.0, was None.*heard nobody at all.*report.html", lines, re.S)
    assert "the check fails before" not in re.sub(r"raise AssertionError.*", "", lines)
    for told in ("the key 'radio.lossy' does not exist", "nowhere.toml", "not 'gazebo'", "flocc_run needs"):
        assert told in lines
    assert "Traceback" not in lines
    assert "pytest_plugin.py" not in lines, "what cannot be used is said without flocc's own lines"


@pytest.mark.swarm
@pytest.mark.scenarios
def test_a_marked_scenario_is_launched_over_real_zenoh(pytester: pytest.Pytester) -> None:
    result = run(
        pytester,
        """
        import pytest

        @pytest.mark.flocc("hangar.toml", driver="launch", settle_s=1.0)
        def test_it_merges(flocc_run):
            assert flocc_run.report.driver == "launch"
        """,
    )
    result.assert_outcomes(passed=1)


def test_the_plugin_loads_nothing_of_flocc_before_it_is_asked(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import sys

        def test_it_is_light():
            heavy = {"numpy", "pydantic", "zenoh", "gtsam", "flocc_launch.scenarios.scenario", "flocc_agent"}
            assert "flocc_launch.commands.pytest_plugin" in sys.modules
            assert heavy & set(sys.modules) == set()
        """
    )
    pytester.runpytest_subprocess("-p", "no:cacheprovider").assert_outcomes(passed=1)
