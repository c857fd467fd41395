"""Claims on the transport that measure time, over real zenoh sessions on loopback."""

import asyncio
import time

import numpy as np
import pytest
from tests.agent.runtime.loopback import loopback_configs, until
from tests.agent.runtime.test_zenoh_transport import LATENT, ROBOTS, Member, meet, swarm

from flocc_agent.radio import LinkParameters, Partition, Radio, RadioParameters
from flocc_agent.runtime.transport import Fetched, FetchFailed, FetchProblem

pytestmark = pytest.mark.swarm


async def test_a_cut_fetch_goes_on_where_it_ended_also_with_another_holder() -> None:
    radio = Radio(RadioParameters(LinkParameters(latency_s=0.05)), np.random.default_rng(1))
    async with swarm(radios={"r1": radio}, chunk_bytes=100_000) as (one, two, three):
        two.held["r2/7"] = three.held["r2/7"] = LATENT
        cut = await one.transport.fetch_latent("r2", "r2/7", 0.6)
        assert isinstance(cut, FetchFailed)
        assert cut.problem is FetchProblem.DEADLINE
        assert 0 < cut.kept_bytes < len(LATENT)
        assert await one.transport.fetch_latent("r3", "r2/7", 10.0) == Fetched(LATENT)
        assert one.transport.counters().received_from["r3"]["latent"].payload_bytes >= len(LATENT) - cut.kept_bytes
        assert one.transport.counters().received["latent"].payload_bytes == len(LATENT)


async def test_a_fetch_says_what_the_link_carries_while_a_picture_is_encoded() -> None:
    radio = Radio(RadioParameters(LinkParameters(bandwidth_bytes_s=1e6)), np.random.default_rng(2))
    async with swarm(ROBOTS[:2], radios={"r1": radio}) as (one, two):
        two.held = {f"r2/{n}": LATENT[:300_000] for n in range(3)}
        for n, encode_s in enumerate((0.5, 0.5, None)):
            fetched = await one.transport.fetch_latent("r2", f"r2/{n}", 20.0, encode_s=encode_s)
            assert fetched == Fetched(LATENT[:300_000])
    first, measured, without = two.encode_bytes
    assert first is None, "nothing was measured yet"
    assert measured is not None
    assert 200_000 < measured < 520_000, "half a second of a megabyte per second, less what requests cost"
    assert without is None


async def test_heartbeats_are_on_time_while_latents_flow() -> None:
    async with swarm(ROBOTS[:2]) as (one, two):
        two.held["r2/7"] = LATENT * 7
        gaps: list[float] = []
        fetch = asyncio.create_task(one.transport.fetch_latent("r2", "r2/7", 30.0))
        last = time.monotonic()
        while not fetch.done():
            await asyncio.sleep(0.01)
            gaps.append(time.monotonic() - last)
            last = time.monotonic()
        assert isinstance(await fetch, Fetched)
        assert max(gaps, default=0.0) < 0.1


async def test_the_emulated_radio_delays_and_separates() -> None:
    radio = Radio(RadioParameters(LinkParameters(latency_s=0.2)), np.random.default_rng(3))
    async with swarm(ROBOTS[:2], radios={"r2": radio}) as (one, two):
        sent_s = time.monotonic()
        one.transport.broadcast("log", b"late")
        await until(lambda: two.heard("r1", "log", b"late"))
        assert time.monotonic() - sent_s >= 0.2
        radio.parameters = RadioParameters(partitions=(Partition((("r1",),)),))
        one.transport.broadcast("log", b"unheard")
        await until(lambda: two.transport.counters().dropped.get("radio-partition", 0) > 0)
        assert not two.heard("r1", "log", b"unheard")


async def test_a_broken_peer_is_slowed_down_and_counted() -> None:
    configs = loopback_configs(("r1", "r2"))
    one = Member("r1", configs["r1"])
    two = Member("r2", configs["r2"].model_copy(update={"peer_messages_per_s": 20.0}))
    async with one.transport, two.transport:
        await meet([one, two])
        for i in range(500):
            one.transport.broadcast("log", b"%d" % i)
        await until(lambda: two.transport.counters().dropped.get("rate", 0) > 300)
        assert len(two.received) <= 100
