"""What operators ask of running agents: status and faults on demand, as queries on the control session.

An agent answers under its own name; with TLS only certificates of operators may ask. Requests and answers are small
and opaque here; a few may wait, the rest go unanswered.
"""

import asyncio
import json
import logging
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import zenoh

from flocc_agent.config import TransportConfig
from flocc_agent.runtime.security import is_operator
from flocc_agent.runtime.zenoh_session import Plane, open_session, session_settings
from flocc_protocol import keys
from flocc_protocol.errors import DecodeError

logger = logging.getLogger(__name__)

Answer = Callable[[bytes], bytes]
"""Takes a request and gives the answer, on the event loop's thread."""

PENDING_MAX = 16
REQUEST_BYTES_MAX = 64 * 1024
ANSWER_BYTES_MAX = 1024 * 1024
OPERATOR = "operator"
LOOK_PERIOD_S = 0.05
SETTLE_S = 0.5
"""Nobody more has been linked for so long: those who are there have been found."""
FIND_TIMEOUTS = 3.0
"""How many timeouts the first agent has to be found; a machine under load links late."""
TOKENS_S = 1.0
SCOUT_S = 1.0


class AdminService:
    """Answers operators for one agent."""

    def __init__(self, swarm: str, robot: str) -> None:
        self._swarm, self._robot = swarm, robot
        self._answers: dict[keys.Admin, Answer] = {}
        self._threads = ThreadPoolExecutor(1, thread_name_prefix=f"{robot}-admin")
        self._pending = 0
        self._loop: asyncio.AbstractEventLoop | None = None

    def serve(self, admin: keys.Admin, answer: Answer) -> None:
        """Answer one kind of request; call before `open`."""
        self._answers[admin] = answer

    def open(self, session: zenoh.Session, loop: asyncio.AbstractEventLoop) -> None:
        """Declare what is answered, on the control session."""
        self._loop = loop
        for admin in self._answers:
            key = keys.admin_key(self._swarm, self._robot, admin)
            session.declare_queryable(key, partial(self._enqueue, admin), allowed_origin=zenoh.Locality.REMOTE)

    def close(self) -> None:
        """End the thread; blocks."""
        self._threads.shutdown(wait=True, cancel_futures=True)

    def _enqueue(self, admin: keys.Admin, query: zenoh.Query) -> None:
        assert self._loop is not None
        payload = query.payload.to_bytes() if query.payload is not None else b""
        if len(payload) > REQUEST_BYTES_MAX or self._pending >= PENDING_MAX:
            query.drop()
            return
        try:
            self._loop.call_soon_threadsafe(self._answer, admin, query, payload)
        except RuntimeError:  # the loop is closed
            query.drop()

    def _answer(self, admin: keys.Admin, query: zenoh.Query, payload: bytes) -> None:
        """Ask the robot, on the loop; a thread sends what it says."""
        self._pending += 1
        answer = self._answers[admin](payload)
        sent = asyncio.get_running_loop().run_in_executor(self._threads, self._reply, admin, query, answer)
        sent.add_done_callback(self._replied)

    def _reply(self, admin: keys.Admin, query: zenoh.Query, answer: bytes) -> None:
        try:
            with query:
                query.reply(keys.admin_key(self._swarm, self._robot, admin), answer)
        except zenoh.ZError as error:
            logger.debug("robot %s: an operator was not answered: %s", self._robot, error)

    def _replied(self, _: "asyncio.Future[None]") -> None:
        self._pending -= 1


async def ask(
    config: TransportConfig,
    swarm: str,
    admin: keys.Admin,
    request: bytes = b"",
    robot: str = "*",
    timeout_s: float = 3.0,
) -> dict[str, bytes]:
    """Ask agents in reach once, as an operator; arguments and errors as of `survey`."""
    return (await survey(config, swarm, admin, request, robot, timeout_s, tries=1)).answers


@dataclass(frozen=True, slots=True)
class Survey:
    """What came of asking a swarm.

    Attributes:
        answers: Answer by robot.
        present: Robots of the swarm that are there, by their own word or a neighbour's, whether they answered or not.
        others: Other swarms that are there.
        refuses: There are agents that speak to holders of keys only, and these are none, or not an operator's.
    """

    answers: dict[str, bytes]
    present: tuple[str, ...]
    others: tuple[str, ...]
    refuses: bool


def _names_nobody(_: bytes) -> Iterable[str]:
    return ()


async def survey(
    config: TransportConfig,
    swarm: str,
    admin: keys.Admin,
    request: bytes = b"",
    robot: str = "*",
    timeout_s: float = 3.0,
    tries: int = 2,
    named: Callable[[bytes], Iterable[str]] = _names_nobody,
) -> Survey:
    """Ask agents in reach, as an operator, and once more where one that is there has not answered.

    Args:
        config: How to reach the swarm: its roster, or scouting; with TLS the operator's folder.
        swarm: Name of the swarm.
        admin: What is asked.
        request: Its content.
        robot: Whom to ask, '*' for everybody.
        timeout_s: Time for finding agents, thrice that for the first one, and again for the answers to each try.
        tries: How often who is silent is asked.
        named: Whom an answer says to be there; the operator's own session may not have found them yet.

    Raises:
        TransportError: The network cannot be used as configured.
    """
    return await asyncio.to_thread(_ask_blocking, config, swarm, admin, request, robot, timeout_s, tries, named)


def _ask_blocking(
    config: TransportConfig,
    swarm: str,
    admin: keys.Admin,
    request: bytes,
    robot: str,
    timeout_s: float,
    tries: int,
    named: Callable[[bytes], Iterable[str]],
) -> Survey:
    settings = session_settings(config, swarm, OPERATOR, Plane.CONTROL, dials_all=True)
    dialled = endpoints_to_dial(config, settings)
    session = open_session(settings | {"listen/endpoints": [], "connect/endpoints": dialled}, OPERATOR)
    try:
        _find(session, len(dialled), timeout_s)
        answers: dict[str, bytes] = {}
        for left in reversed(range(tries)):
            answers |= _answers(session, keys.admin_key(swarm, robot, admin), request, timeout_s)
            there = _present(session)
            present = _robots(there, swarm).union(*map(named, answers.values()))
            if not left or (answers and present <= answers.keys()):
                break
            _await_linked(session, swarm, present, timeout_s)
        others = {presence.swarm for presence in there} - {swarm}
        refuses = not answers and _refuses(config, bool(present))
        return Survey(dict(sorted(answers.items())), tuple(sorted(present)), tuple(sorted(others)), refuses)
    finally:
        session.close()


def _answers(session: zenoh.Session, key: str, request: bytes, timeout_s: float) -> dict[str, bytes]:
    replies = session.get(
        key,
        zenoh.handlers.FifoChannel(256),
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=timeout_s,
        payload=request,
    )
    return dict(answer for answer in map(_read, replies) if answer is not None)


def _present(session: zenoh.Session) -> list[keys.Presence]:
    """Whose liveliness tokens are seen; sessions answer for their agents, however busy those are."""
    found = []
    for reply in session.liveliness().get(keys.presence_pattern(), timeout=TOKENS_S):
        if reply.ok is not None:
            with suppress(DecodeError):
                found.append(keys.parse_alive_key(str(reply.ok.key_expr)))
    return found


def _refuses(config: TransportConfig, present: bool) -> bool:
    """Whether those who are silent want keys: a robot's are not an operator's, and without any nobody is linked."""
    if config.tls is not None:
        return present and not is_operator(config.tls)
    return not present and any(locator.startswith("tls/") for locator in _scouted(config))


def _scouted(config: TransportConfig) -> list[str]:
    """Where agents say that they listen, to whoever scouts."""
    if not config.multicast:
        return []
    zenoh_config = zenoh.Config()
    zenoh_config.insert_json5("scouting/multicast/address", json.dumps(config.multicast_group(True)))
    zenoh_config.insert_json5("scouting/multicast/interface", json.dumps(config.interface))
    found: list[str] = []
    with suppress(zenoh.ZError):  # an interface that is not there
        scout = zenoh.scout(zenoh.handlers.FifoChannel(256), what="peer", config=zenoh_config)
        time.sleep(SCOUT_S)
        while (hello := scout.try_recv()) is not None:
            found += map(str, hello.locators)
        scout.stop()
    return found


def endpoints_to_dial(config: TransportConfig, settings: dict[str, Any]) -> list[str]:
    """Everybody whom an operator can name: the roster, and the agent whose configuration this is."""
    return sorted({*settings["connect/endpoints"], *_on_this_machine(config)})


def _on_this_machine(config: TransportConfig) -> list[str]:
    """Where the agent listens whose configuration this is; the operator may well sit at its side."""
    named = [endpoint for endpoint in config.control_listen if not endpoint.endswith(":0")]
    return [endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:") for endpoint in named]


def _find(session: zenoh.Session, count: int, timeout_s: float) -> None:
    """Wait until as many agents as are dialled are linked, one at least, and no other one comes any more.

    Those who are late cost `timeout_s`; somebody at all is waited for `FIND_TIMEOUTS` times as long.
    """
    began_s = changed_s = time.monotonic()
    linked = 0
    while (now_s := time.monotonic()) < began_s + timeout_s * (1.0 if linked else FIND_TIMEOUTS):
        if (found := len(session.info.peers_zid())) != linked:
            linked, changed_s = found, now_s
        if linked >= max(count, 1) and now_s >= changed_s + SETTLE_S:
            return
        time.sleep(LOOK_PERIOD_S)


def _await_linked(session: zenoh.Session, swarm: str, expected: set[str], timeout_s: float) -> None:
    """Wait until all robots that are said to be there have been found, at most so long."""
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s and not expected <= _robots(_present(session), swarm):
        time.sleep(LOOK_PERIOD_S)


def _robots(there: Iterable[keys.Presence], swarm: str) -> set[str]:
    return {presence.robot for presence in there if presence.swarm == swarm}


def _read(reply: zenoh.Reply) -> tuple[str, bytes] | None:
    if reply.ok is None or len(reply.ok.payload) > ANSWER_BYTES_MAX:
        return None
    try:
        return keys.parse_admin_key(str(reply.ok.key_expr)), reply.ok.payload.to_bytes()
    except DecodeError:
        return None
