"""Claim: a pair is registered once more where its record is in a version of a log that whoever waits never takes."""

import pytest
from tests.agent.core.test_core_robot import disk_of
from tests.agent.core.virtual_time import Robots

from flocc_agent.core.effects import Register
from flocc_agent.core.insisted import INSISTS_S, OFFERED_MAX, Insisted
from flocc_agent.core.log_copy import LogCopy
from flocc_agent.core.reports import LogForked
from flocc_agent.core.restored import Restored
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair

R1, R2, R3 = LogId("r1"), LogId("r2"), LogId("r3")
PLACES = 4


def registered_by_r1() -> Robots:
    """Two small robots that saw the same places; a server registered their pairs, and all is in its log."""
    robots = Robots()
    robots.add("r1", compute_class=9)
    for name in ("r2", "r3"):
        robots.add(name)
        for k in range(PLACES):
            robots.capture(name, float(k), look=k)
    robots.run(30.0)
    assert len(list(judged(robots.cores["r3"].gossip.logs[R1]))) == PLACES
    return robots


def judged(copy: LogCopy) -> list[CandidatePair]:
    return [CandidatePair.of(record.query, record.match) for _, record in copy.judgements()]


def with_another_log_of_r1(disk: Restored) -> Restored:
    """What a robot holds that first heard of what r1 wrote after its disk went back: nothing of the pairs."""
    robots = Robots()
    robots.add("r1", compute_class=9)
    robots.capture("r1", 7.0, look=77)
    robots.run(5.0)
    other = tuple(robots.cores["r1"].gossip.logs[R1].encoded)
    return Restored(tuple((log, other if log == R1 else data) for log, data in disk.records), disk.latents)


@pytest.mark.parametrize("is_back", [False, True], ids=["the server is gone", "the server is back"])
def test_a_pair_whose_record_the_other_side_never_takes_is_registered_once_more(is_back: bool) -> None:
    before = registered_by_r1()
    robots = Robots()
    robots.add("r2", restored=with_another_log_of_r1(disk_of(before, "r2")))
    robots.add("r3", restored=disk_of(before, "r3"))
    if is_back:  # with its earlier log as r3 has it, so that it takes these pairs for settled, too
        its_own = tuple((log, data) for log, data in disk_of(before, "r3").records if log == R1)
        robots.add("r1", compute_class=9, restored=Restored(its_own), incarnation=1)
    robots.run(INSISTS_S + 30.0)
    assert robots.facts("r2", LogForked)
    assert [core.closing.open_pairs() for core in robots.cores.values()] == [[] for _ in robots.cores]
    again = [effect.pair for _, _, effect in robots.done if isinstance(effect, Register)]
    assert sorted(again) == sorted(judged(before.cores["r1"].gossip.logs[R1]))
    logs = robots.cores["r2"].gossip.logs
    assert {pair for log in logs for pair in judged(logs[log])} == set(again)


def test_robots_that_hold_one_version_register_nothing_again() -> None:
    before = registered_by_r1()
    robots = Robots()
    for name in ("r2", "r3"):
        robots.add(name, restored=disk_of(before, name))
    robots.run(INSISTS_S + 30.0)
    assert not [effect for _, _, effect in robots.done if isinstance(effect, Register)]


def test_who_offers_settled_pairs_without_end_makes_logs_be_read_now_and_then_only() -> None:
    insisted = Insisted()
    pairs = [CandidatePair.of(KeyframeId(R2, k), KeyframeId(R3, k)) for k in range(OFFERED_MAX + 8)]
    assert insisted.among(pairs[:1], 0.0) == insisted.among(pairs[:1], INSISTS_S / 2) == set()
    assert insisted.among(pairs[:1], INSISTS_S) == {pairs[0]}
    assert insisted.among(pairs[1:], INSISTS_S) == set()
    size, size_max = insisted.sizes()["insisted"]
    assert size == size_max
    found = [insisted.among(pairs[8:], INSISTS_S * (2.0 + k / 10)) for k in range(10)]
    assert sum(map(bool, found)) == 1
