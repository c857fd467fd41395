"""Claims on the transport, over real zenoh sessions on loopback. What measures time: test_zenoh_timing.py."""

import asyncio
import hashlib
import logging
import subprocess
import sys
from collections.abc import AsyncIterator, Iterable
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial

import numpy as np
import pytest
from tests.agent.runtime.loopback import free_ports, loopback_configs, until

from flocc_agent.config import TransportConfig
from flocc_agent.radio import LinkParameters, Radio, RadioParameters
from flocc_agent.runtime.latent_transfer import Piece, Server
from flocc_agent.runtime.transport import Fetched, FetchFailed, FetchProblem, TransportError
from flocc_agent.runtime.zenoh_admin import ask
from flocc_agent.runtime.zenoh_transport import ZenohTransport
from flocc_protocol.errors import DecodeError
from flocc_protocol.keys import Admin, latent_key

pytestmark = [pytest.mark.swarm, pytest.mark.beside]

ROBOTS = ("r1", "r2", "r3")
LATENT = bytes(range(256)) * 4000
LATENT_SMALL = 10_000
GREETING = "hello"


class Member:
    """One robot of a test: its transport and what it received."""

    def __init__(self, robot: str, config: TransportConfig, radio: Radio | None = None, swarm: str = "test") -> None:
        self.robot = robot
        self.received: list[tuple[str, str, bytes]] = []
        self.held: dict[str, bytes] = {}
        self.lookups: list[str] = []
        self.encode_bytes: list[int | None] = []
        self.transport = ZenohTransport(swarm, robot, config, radio)
        self.met: set[str] = set()
        self.transport.set_receiver(self._receive)
        self.transport.serve_latents(self._lookup)

    def _receive(self, sender: str, kind: str, payload: bytes) -> None:
        if kind == GREETING:
            self.met.add(sender)
        else:
            self.received.append((sender, kind, payload))

    def _lookup(self, key: str, encode_bytes: int | None) -> bytes | None:
        self.lookups.append(key)
        self.encode_bytes.append(encode_bytes)
        return self.held.get(key)

    def heard(self, *message: object) -> bool:
        return message in self.received


@asynccontextmanager
async def swarm(
    robots: Iterable[str] = ROBOTS, radios: dict[str, Radio] | None = None, **options: object
) -> AsyncIterator[list[Member]]:
    """Robots that are connected."""
    members = [
        Member(name, config, (radios or {}).get(name)) for name, config in loopback_configs(robots, **options).items()
    ]
    async with AsyncExitStack() as stack:
        for member in members:
            await stack.enter_async_context(member.transport)
        await meet(members)
        yield members


async def meet(members: list[Member]) -> None:
    """Greet until everybody heard everybody."""

    def greet() -> None:
        for member in members:
            member.transport.broadcast(GREETING, b"")

    everybody = {member.robot for member in members}
    await until(lambda: all(member.met == everybody - {member.robot} for member in members), act=greet)


async def test_a_broadcast_reaches_everybody_else_and_names_its_sender() -> None:
    async with swarm() as (one, two, three):
        one.transport.broadcast("hb", b"alive")
        await until(lambda: two.heard("r1", "hb", b"alive") and three.heard("r1", "hb", b"alive"))
        assert not one.heard("r1", "hb", b"alive")


async def test_a_unicast_reaches_its_receiver_alone() -> None:
    async with swarm() as (one, two, three):
        one.transport.unicast("r2", "pull", b"for two")
        one.transport.broadcast("log", b"after")
        await until(lambda: two.heard("r1", "pull", b"for two") and three.heard("r1", "log", b"after"))
        assert not three.heard("r1", "pull", b"for two")


async def test_a_message_of_many_fragments_arrives_whole() -> None:
    async with swarm(ROBOTS[:2]) as (one, two):
        one.transport.broadcast("corr", LATENT[:900_000])
        await until(lambda: two.heard("r1", "corr", LATENT[:900_000]))


async def test_fetches_a_latent_in_pieces_and_looks_it_up_once() -> None:
    async with swarm(ROBOTS[:2], chunk_bytes=100_000) as (one, two):
        two.held["r2/7"] = LATENT
        assert await one.transport.fetch_latent("r2", "r2/7", 10.0) == Fetched(LATENT)
        assert two.lookups == ["r2/7"]
        received = one.transport.counters().received_from["r2"]["latent"]
        assert received.payload_bytes == len(LATENT)


async def test_an_empty_latent_is_a_latent() -> None:
    async with swarm(ROBOTS[:2]) as (one, two):
        two.held["r2/0"] = b""
        assert await one.transport.fetch_latent("r2", "r2/0", 10.0) == Fetched(b"")


async def test_says_why_a_latent_does_not_come() -> None:
    async with swarm(ROBOTS[:2], latent_bytes_max=LATENT_SMALL) as (one, two):
        two.held["r2/1"] = b"right"
        wrong_hash = hashlib.sha256(b"other").digest()
        problems = [
            await one.transport.fetch_latent("r2", "r2/404", 10.0),
            await one.transport.fetch_latent("r2", "r2/1", 10.0, sha256=wrong_hash),
            await one.transport.fetch_latent("r9", "r9/0", 0.2),
            await one.transport.fetch_latent("r9", "r9/0", 10.0),
        ]
        assert problems == [
            FetchFailed(problem)
            for problem in (
                FetchProblem.UNKNOWN,
                FetchProblem.WRONG_HASH,
                FetchProblem.DEADLINE,
                FetchProblem.NO_ANSWER,
            )
        ]


async def test_a_get_that_names_no_piece_is_answered_with_an_error() -> None:
    async with swarm(ROBOTS[:2]) as (one, two):
        two.held["r2/1"] = b"right"
        assert await one.transport.fetch_latent("r2", "r2/1", 10.0) == Fetched(b"right")
        session = one.transport._bulk._session
        assert session is not None
        key = latent_key("test", "r2", "r2/1")
        for wrong in ("", "?offset=0", "?offset=-5;length=9", "?offset=abc;length=9", "?offset=0;length=9;asker=A B"):
            replies = await asyncio.to_thread(lambda: list(session.get(key + wrong, timeout=10.0)))  # noqa: B023
            assert [reply.err.payload.to_bytes() for reply in replies if reply.err] == [b"flocc: bad request"], wrong


async def test_does_not_take_a_latent_that_is_larger_than_allowed() -> None:
    configs = loopback_configs(("r1", "r2"), chunk_bytes=2000)
    small = configs["r1"].model_copy(update={"latent_bytes_max": LATENT_SMALL})
    one, two = Member("r1", small), Member("r2", configs["r2"])
    async with one.transport, two.transport:
        await meet([one, two])
        two.held["r2/1"] = bytes(LATENT_SMALL + 1)
        assert await one.transport.fetch_latent("r2", "r2/1", 10.0) == FetchFailed(FetchProblem.TOO_LARGE)


async def test_lost_pieces_are_asked_for_again() -> None:
    radio = Radio(RadioParameters(LinkParameters(loss_ratio=0.3)), np.random.default_rng(2))
    async with swarm(ROBOTS[:2], radios={"r1": radio}, chunk_bytes=200_000) as (one, two):
        two.held["r2/7"] = LATENT
        fetched: object = None
        for _ in range(5):
            fetched = await one.transport.fetch_latent("r2", "r2/7", 20.0)
            if isinstance(fetched, Fetched):
                break
        assert fetched == Fetched(LATENT)
        assert one.transport.counters().dropped["radio-loss"] > 0


async def test_asks_for_less_at_a_time_where_long_pieces_do_not_come(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Server.piece

    def piece(server: Server, latent: str, offset: int, length: int, encode_bytes: int | None) -> Piece | None:
        if length > 40_000:
            raise DecodeError("no answer, as on a link that is too slow")
        return whole(server, latent, offset, length, encode_bytes)

    monkeypatch.setattr(Server, "piece", piece)
    async with swarm(ROBOTS[:2], chunk_bytes=160_000) as (one, two):
        two.held["r2/7"] = LATENT
        assert await one.transport.fetch_latent("r2", "r2/7", 20.0) == Fetched(LATENT)


async def test_positions_travel_with_messages_so_that_the_receiver_can_judge_the_range() -> None:
    radios = {name: Radio(RadioParameters(), np.random.default_rng(4)) for name in ROBOTS[:2]}
    async with swarm(ROBOTS[:2], radios=radios) as (one, two):
        radios["r1"].update_position("r1", (100.0, 0.0, 0.0))
        radios["r2"].update_position("r2", (0.0, 0.0, 0.0))
        radios["r2"].parameters = RadioParameters(range_m=50.0)
        one.transport.broadcast("log", b"far")
        await until(lambda: two.transport.counters().dropped.get("radio-range", 0) > 0)
        assert radios["r2"].position_m("r1") == (100.0, 0.0, 0.0)
        radios["r1"].update_position("r1", (10.0, 0.0, 0.0))
        one.transport.broadcast("log", b"near")
        await until(lambda: two.heard("r1", "log", b"near"))


async def test_hears_at_most_so_many_peers() -> None:
    configs = loopback_configs(ROBOTS)
    two = Member("r2", configs["r2"].model_copy(update={"peers_max": 1}))
    members = [Member("r1", configs["r1"]), two, Member("r3", configs["r3"])]

    def greet() -> None:
        for member in (members[0], members[2]):
            member.transport.broadcast(GREETING, b"")

    async with members[0].transport, two.transport, members[2].transport:
        await until(lambda: two.transport.counters().dropped.get("too-many-peers", 0) > 0, act=greet)
        assert len(two.met) == 1


async def test_a_message_that_is_too_large_is_neither_sent_nor_accepted() -> None:
    configs = loopback_configs(("r1", "r2"))
    small = configs["r2"].model_copy(update={"message_bytes_max": 1024})
    one, two = Member("r1", configs["r1"]), Member("r2", small)
    async with one.transport, two.transport:
        await meet([one, two])
        two.transport.broadcast("log", bytes(1025))
        assert two.transport.counters().dropped["not-sent"] == 1
        one.transport.broadcast("log", bytes(1025))
        await until(lambda: two.transport.counters().dropped.get("too-large") == 1)


async def test_names_strangers_and_doubles_once(caplog: pytest.LogCaptureFixture) -> None:
    configs = loopback_configs(("r1", "r2", "r3"))
    one, stranger = Member("r1", configs["r1"]), Member("r2", configs["r2"], swarm="other")
    dials_one = configs["r3"].model_copy(update={"roster": {"a": configs["r1"].roster["r1"]}})
    double = Member("r1", dials_one)
    with caplog.at_level(logging.WARNING):
        async with one.transport, stranger.transport, double.transport:
            await until(lambda: {"foreign-swarm", "name-twice"} <= set(one.transport.counters().dropped))
    assert "robot r1: robot r2 of swarm other is ignored" in caplog.messages
    assert caplog.messages.count("robot r1: another process runs under the name r1") in (1, 2)
    assert stranger.received == one.received == []


async def test_a_port_in_use_is_one_clear_sentence_and_nothing_stays_open() -> None:
    config = loopback_configs(("r1",))["r1"]
    async with ZenohTransport("test", "r1", config):
        second = ZenohTransport("test", "r2", config)
        with pytest.raises(TransportError) as error:
            await second.open()
        port = config.control_listen[0].rsplit(":", 1)[1]
        assert str(error.value) == f"robot r2: the address 127.0.0.1:{port} is in use by another process"
    async with ZenohTransport("test", "r1", config):
        pass


async def test_an_address_of_another_machine_is_one_clear_sentence() -> None:
    config = TransportConfig(control_listen=("tcp/192.0.2.1:7000",), multicast=False)
    with pytest.raises(TransportError, match=r"robot r1: the address 192.0.2.1:7000 is not one of this machine"):
        await ZenohTransport("test", "r1", config).open()


async def test_closing_ends_a_fetch_and_may_be_repeated() -> None:
    async with swarm(ROBOTS[:2]) as (one, _):
        fetch = asyncio.create_task(one.transport.fetch_latent("r9", "r9/0", 30.0))
        await until(lambda: not fetch.done())
        await one.transport.close()
        assert isinstance(await fetch, FetchFailed)
        await one.transport.close()
        one.transport.broadcast("hb", b"nobody hears")
        assert one.transport.counters().dropped["not-sent"] == 1


def greeting_of(robot: str, request: bytes) -> bytes:
    return request + robot.encode()


async def test_an_operator_is_answered_by_everybody_or_by_one() -> None:
    configs = loopback_configs(ROBOTS[:2])
    members = [Member(name, config) for name, config in configs.items()]
    for member in members:
        member.transport.serve_admin(Admin.STATUS, partial(greeting_of, member.robot))
    async with members[0].transport, members[1].transport:
        assert await ask(configs["r1"], "test", Admin.STATUS, b"I am ", timeout_s=1.5) == {
            "r1": b"I am r1",
            "r2": b"I am r2",
        }
        assert await ask(configs["r1"], "test", Admin.STATUS, b"", "r2", timeout_s=1.0) == {"r2": b"r2"}
        assert await ask(configs["r1"], "test", Admin.CHAOS, b"", timeout_s=1.0) == {}


async def test_an_operator_finds_everybody_by_scouting_whatever_the_identifiers_of_sessions() -> None:
    """Sessions of robots dial by their identifiers, which are drawn: a few operators are tried."""
    config = TransportConfig(interface="lo", multicast_address=f"224.0.0.224:{free_ports(1)[0]}")
    members = [Member(name, config) for name in ROBOTS]
    for member in members:
        member.transport.serve_admin(Admin.STATUS, partial(greeting_of, member.robot))
    async with members[0].transport, members[1].transport, members[2].transport:
        await meet(members)
        for _ in range(4):
            assert sorted(await ask(config, "test", Admin.STATUS, timeout_s=1.5)) == list(ROBOTS)


LEAVES = """
import asyncio
from flocc_agent.config import TransportConfig
from flocc_agent.runtime.zenoh_admin import ask
from flocc_agent.runtime.zenoh_transport import ZenohTransport
from flocc_protocol.errors import DecodeError
from flocc_protocol.keys import Admin, latent_key
async def main():
    async with ZenohTransport("test", "r1", TransportConfig(multicast=False)):
        raise SystemExit(3)
asyncio.run(main())
"""


def test_a_process_that_fails_with_an_open_transport_still_ends() -> None:
    assert subprocess.run([sys.executable, "-c", LEAVES], timeout=20, check=False).returncode == 3
