"""Questions for knots: a robot that needs them does not stop asking, one that asks for others does."""

from flocc_agent.core.effects import Unicast
from flocc_agent.core.knot_requests import ASKED_MAX, INTEREST_S, RARELY_S, KnotRequests
from flocc_protocol.ids import LogId, Term
from flocc_protocol.messages import CorrectionVersion, KnotRequest

VERSION = CorrectionVersion(LogId("r1"), Term(1, LogId("r4")), 10)


def asked_at_s(requests: KnotRequests, until_s: int) -> list[int]:
    return [t for t in range(until_s) if any(isinstance(e, Unicast) for e in requests.ask(float(t)))]


def test_knots_that_a_robot_needs_are_asked_for_on_and_on() -> None:
    requests = KnotRequests(lambda _: ["r2"])
    requests.want(VERSION, 0.0)
    times_s = asked_at_s(requests, 60)
    assert len(times_s) > ASKED_MAX
    assert times_s[-1] - times_s[-2] == RARELY_S


def test_knots_that_another_robot_needed_are_given_up() -> None:
    requests = KnotRequests(lambda _: ["r2"])
    requests.on_interest("r3", VERSION, 0.0)
    assert len(asked_at_s(requests, 60)) == ASKED_MAX


def test_an_own_need_outlives_a_newer_version_that_another_robot_asks_for() -> None:
    requests = KnotRequests(lambda _: ["r2"])
    requests.want(VERSION, 0.0)
    requests.on_interest("r3", VERSION._replace(round=11), 1.0)
    assert len(asked_at_s(requests, 600)) > 2 * ASKED_MAX


def test_who_asked_long_ago_may_have_them_by_now() -> None:
    """Seed 99200197: the robot that leads by now had asked for knots of an older leader, and was never asked itself."""
    requests = KnotRequests(lambda _: ["r2"])
    requests.on_interest("r2", VERSION, 0.0)
    requests.on_interest("r3", VERSION._replace(term=Term(4, LogId("r2"))), 1.0)
    assert asked_at_s(requests, int(INTEREST_S) + 3)[0] == INTEREST_S


def test_who_needs_the_knots_of_a_log_no_more_asks_on_for_others_only() -> None:
    requests = KnotRequests(lambda _: ["r9"])
    versions = [VERSION._replace(log=LogId(name)) for name in ("r1", "r2", "r3")]
    for version in versions:
        requests.want(version, 0.0)
    requests.on_interest("r5", versions[1], 0.0)
    requests.keep([LogId("r1")])
    assert requests.ask(0.0) == [Unicast("r9", KnotRequest((versions[0], versions[1])))]
