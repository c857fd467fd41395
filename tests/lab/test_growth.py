"""Claims on how growth with the team is measured."""

from collections.abc import Iterable
from typing import Any

import pytest

from flocc_lab import growth


def test_the_exponent_is_that_of_the_law() -> None:
    robots = [5, 10, 20, 50]
    assert growth.exponent(robots, [3.0 * n**1.5 for n in robots]) == pytest.approx(1.5)


def test_of_fixed_density_each_robot_has_as_much_room_as_one_of_the_largest_team() -> None:
    edges = growth.areas_m([5, 20], 120.0)
    assert edges == {"area": [120.0, 120.0], "density": [60.0, 120.0]}


def test_both_kinds_of_town_are_measured_and_the_largest_team_once() -> None:
    asked: list[growth.Team] = []

    def by_a_law(teams: Iterable[growth.Team], minutes: float) -> dict[growth.Team, dict[str, Any]]:
        """Bytes with the square of the team and with how dense it is, CPU with the team."""
        asked.extend(teams)
        return {(n, edge_m): cost(n, edge_m, round(minutes * n**3 * 1e6 / edge_m**2)) for n, edge_m in asked}

    measured = growth.growth([4, 16], 2.0, 100.0, by_a_law)
    assert asked == [(4, 50.0), (4, 100.0), (16, 100.0)]
    assert measured["fixed_area"]["exponents"] == {"bytes_per_robot": 2.0, "cpu_s_per_robot": 0.0}
    assert measured["fixed_density"]["exponents_of_the_largest"] == {"bytes_per_robot": 1.0, "cpu_s_per_robot": 0.0}
    assert measured["fixed_area"]["runs"][0]["shares"] == {"records": 0.75, "heartbeat": 0.25, "correction": 0.0}


def cost(robots: int, area_m: float, received: int) -> dict[str, Any]:
    return {
        "robots": robots,
        "area_m": area_m,
        "keyframes": 1,
        "closures": 1,
        "held_ratio": 1.0,
        "memory_mb": 1,
        "cpu_s": 2.0 * robots,
        "messages_received_bytes": received,
        "received_bytes": {"records": 0.75 * received, "heartbeat": 0.25 * received},
    }
