"""A swarm as a test: `pytest examples/scenario_in_pytest` in an environment that has flocc; its plugin comes along."""

import pytest


@pytest.mark.flocc("hangar.toml")
def test_two_robots_find_one_map(flocc_run):
    """What the scenario expects is checked before the first line; this asks for more."""
    assert flocc_run.report.closures.accepted_inter_robot >= 5


@pytest.mark.flocc("hangar.toml", radio={"loss_ratio": 0.4})
def test_they_do_so_on_a_bad_radio(flocc_run):
    """Keys of the scenario are changed in the marker."""
    assert flocc_run.report.leader_changes <= 2


def test_the_same_seed_gives_the_same_run(flocc):
    """`flocc` runs any number of scenarios."""
    first, second = (flocc.simulate("hangar.toml", seed=4).check() for _ in range(2))
    assert first.report.bytes == second.report.bytes
