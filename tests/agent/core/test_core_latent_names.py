"""In a swarm with keys the owner's log says what a latent is, whoever serves it."""

import hashlib
from functools import partial

import pytest
from tests.agent.core import virtual_time
from tests.agent.core.virtual_time import EveryoneSigns, Robots, answer, descriptor, keyframe

from flocc_agent.core.effects import Effect, Encode, FetchLatent
from flocc_agent.core.events import Event, KeyframeEncoded
from flocc_agent.core.latents import LatentNames
from flocc_agent.core.robot import Robot
from flocc_protocol.ids import KeyframeId
from flocc_protocol.records import LatentRecord


def named(of: KeyframeId) -> bytes:
    return hashlib.sha256(str(of).encode()).digest()


def work(robots: Robots, name: str, effect: Effect) -> Event | None:
    if isinstance(effect, Encode):
        return KeyframeEncoded(effect.keyframe, descriptor(effect.image), sha256=named(effect.keyframe))
    return answer(effect)


def fetched(keys: bool, monkeypatch: pytest.MonkeyPatch) -> tuple[Robots, list[FetchLatent]]:
    """Fetches of three robots; the third one hears the first only over the second."""
    if keys:
        monkeypatch.setattr(virtual_time, "Robot", partial(Robot, sealer=EveryoneSigns()))
    robots = Robots(work=work)
    for name in ("r1", "r2", "r3"):
        robots.add(name)
    robots.cut = {frozenset(("r1", "r3"))}
    for name in ("r1", "r3"):
        for k in range(3):
            robots.capture(name, float(k), look=k)
    robots.run(30.0)
    return robots, [effect for _, _, effect in robots.done if isinstance(effect, FetchLatent)]


def test_what_a_relay_serves_is_held_against_the_owners_record(monkeypatch: pytest.MonkeyPatch) -> None:
    _, fetches = fetched(True, monkeypatch)
    relayed = [fetch for fetch in fetches if fetch.holder != fetch.keyframe.log.robot]
    assert relayed
    for fetch in fetches:
        assert fetch.named is not None
        assert fetch.named.names(named(fetch.keyframe))
        assert not fetch.named.names(named(keyframe("r9/9")))


def test_without_keys_no_record_is_spent_on_it(monkeypatch: pytest.MonkeyPatch) -> None:
    robots, fetches = fetched(False, monkeypatch)
    assert {fetch.named for fetch in fetches} == {None}
    assert not any(
        isinstance(record, LatentRecord) for record in robots.cores["r1"].gossip.logs[keyframe("r1/0").log].records
    )


def test_the_last_record_of_a_keyframe_counts_and_absurd_ones_take_no_memory() -> None:
    names, one = LatentNames(), keyframe("r1/2")
    records = {3: LatentRecord(2, b"a" * 32), 4: LatentRecord(2, b"b" * 32), 5: LatentRecord(2**30, b"c" * 32)}
    names.record_at = lambda log, number: records[number]
    for number, record in records.items():
        names.add(KeyframeId(one.log, record.index), number)
    assert names.of(one) == records[4]
    assert names.of(KeyframeId(one.log, 2**30)) is None
    assert names.of(keyframe("r1/1")) is None
