"""A bandwidth budget on virtual time: latents keep to it, messages do not wait for them."""

from typing import Any

import pytest

from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation.simulate import playbacks_of, swarm_of
from flocc_launch.simulation.swarm import Swarm
from flocc_launch.simulation.virtual_fetches import PIECE_BYTES

BUDGET_BYTES_S = 20_000.0
END_S = 60.0


def run(bandwidth_bytes_s: float | None) -> Swarm:
    fields: dict[str, Any] = {
        "name": "budget",
        "tracks": {"robots": 3, "seed": 3, "area_m": 12.0, "length_m": 30.0},
        "keyframes": {"distance_m": 1.0, "rotation_rad": 0.7},
        "perception": {"method": "synthetic", "synthetic": {"latent_bytes": 400_000, "outlier_probability": 0.0}},
        "simulation": {"optimiser": "quick"},
        "core": {"loop_closing": {"fetch_timeout_s": 60.0}},
        "bandwidth_bytes_s": bandwidth_bytes_s,
    }
    scenario = Scenario.model_validate(fields)
    swarm = swarm_of(scenario, playbacks_of(scenario, {}), 1)
    swarm.run_until(END_S)
    return swarm


@pytest.fixture(scope="module")
def limited() -> Swarm:
    return run(BUDGET_BYTES_S)


@pytest.fixture(scope="module")
def free() -> Swarm:
    return run(None)


def latent_bytes(swarm: Swarm) -> int:
    return sum(traffic.received["latent"] for traffic in swarm.network.traffic.values())


def test_no_robot_uses_more_than_its_budget_but_for_the_piece_under_way(limited: Swarm) -> None:
    for name in limited.stations:
        assert limited.network.used_bytes(name) <= BUDGET_BYTES_S * (END_S + 1.0) + 2 * PIECE_BYTES


def test_the_budget_is_used_where_latents_are_wanted(limited: Swarm, free: Swarm) -> None:
    assert latent_bytes(free) > 3 * latent_bytes(limited) > 0
    assert sum(limited.network.used_bytes(name) for name in limited.stations) > 0.8 * 3 * BUDGET_BYTES_S * END_S


def test_logs_stay_ahead_of_latents(limited: Swarm, free: Swarm) -> None:
    """Every record is everywhere, as without a budget, while most latents still wait."""
    for swarm in (limited, free):
        lengths = [
            {log: len(copy.records) for log, copy in station.core.gossip.logs.items()}
            for station in swarm.running()
            if station.core
        ]
        assert len(lengths) == 3
        assert lengths[0] == lengths[1] == lengths[2]
    heartbeats = [sum(t.sent["heartbeat"] for t in swarm.network.traffic.values()) for swarm in (limited, free)]
    assert heartbeats[0] == pytest.approx(heartbeats[1], rel=0.2)
    assert sum(s.core.closing.load for s in limited.running() if s.core) > 10


def test_a_budget_calls_for_the_spectral_order(limited: Swarm, free: Swarm) -> None:
    orders = [
        {swarm.scenario.core.under(swarm.scenario.bandwidth_bytes_s).place_recognition.candidate_order}
        for swarm in (limited, free)
    ]
    assert orders == [{"spectral"}, {"similarity"}]
