"""Claims on questions for knots: a robot's own need is asked for until it is met, others' only so often."""

import itertools

import pytest

from flocc_agent.core.knot_requests import ASKED_MAX, PAUSE_MAX_S, KnotRequests
from flocc_protocol.ids import LogId, Term
from flocc_protocol.messages import CorrectionVersion

R1, R2, R3 = (LogId(f"r{k}") for k in (1, 2, 3))
WANTED = CorrectionVersion(R1, Term(1, R2), 1)
HOUR_S = 3600


def asked_at_s(requests: KnotRequests, until_s: int) -> list[float]:
    """When it asks, looked at twice a second."""
    return [t / 2 for t in range(2 * until_s) if requests.ask(t / 2)]


def test_what_a_robot_needs_itself_is_asked_for_until_it_comes_with_growing_pauses() -> None:
    requests = KnotRequests(lambda term: ["r2"])
    requests.want(WANTED, 0.0)
    times_s = asked_at_s(requests, HOUR_S)
    pauses_s = [b - a for a, b in itertools.pairwise(times_s)]
    assert pauses_s == sorted(pauses_s)
    assert pauses_s[-1] == PAUSE_MAX_S
    assert times_s[-1] > HOUR_S - 2 * PAUSE_MAX_S
    requests.on_knots(WANTED, HOUR_S)
    assert requests.ask(2.0 * HOUR_S) == []


@pytest.mark.parametrize("needs_it_later", [False, True])
def test_what_others_need_is_given_up_unless_the_robot_needs_it_too(needs_it_later: bool) -> None:
    requests = KnotRequests(lambda term: ["r2", "r3"])
    requests.on_interest("r3", WANTED, 0.0)
    if needs_it_later:
        requests.want(WANTED, 0.0)
    assert (len(asked_at_s(requests, HOUR_S)) > ASKED_MAX) == needs_it_later


def test_an_own_need_outlives_a_newer_version_that_another_robot_asks_for() -> None:
    requests = KnotRequests(lambda term: ["r2"])
    requests.want(WANTED, 0.0)
    requests.on_interest("r3", WANTED._replace(round=2), 1.0)
    assert len(asked_at_s(requests, HOUR_S)) > ASKED_MAX
