"""Latents over zenoh: a session of their own, get and reply with BLOCK at the lowest priority, on threads.

A get that finds nobody ends at once, a dead holder's ends when its link is given up, so pieces have a timeout of
their own; what arrived is kept, and the next try goes on from there.
"""

import asyncio
import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import BoundedSemaphore
from typing import Any

import zenoh

from flocc_agent.budget import Budget
from flocc_agent.config import TransportConfig
from flocc_agent.radio import Radio
from flocc_agent.runtime.latent_transfer import (
    BAD_REQUEST,
    UNKNOWN,
    LinkRates,
    Partial,
    Partials,
    Piece,
    Server,
    checked_number,
)
from flocc_agent.runtime.transport import LATENT, Fetched, FetchFailed, FetchProblem, LatentLookup, TrafficCounter
from flocc_agent.runtime.zenoh_session import open_session
from flocc_protocol import keys
from flocc_protocol.errors import DecodeError, FloccError
from flocc_protocol.ids import checked_name

logger = logging.getLogger(__name__)

SERVERS = 2
SERVE_PENDING_MAX = 64
TRIES_MAX = 5
PAUSE_S = 0.1
FETCHES_MAX = 2
"""Latents in flight at once, as many as the core asks for; more share the same link and make each later."""
CHUNK_TIMEOUT_S = 5.0
"""One piece of 256 KiB that takes longer is asked for again: 50 kB/s is the slowest link that gets on."""
REQUEST_BYTES = 100


class BulkService:
    """Serves this robot's latents and fetches those of others."""

    def __init__(
        self,
        swarm: str,
        robot: str,
        config: TransportConfig,
        counter: TrafficCounter,
        radio: Radio | None,
        clock_s: Callable[[], float],
        bandwidth_bytes_s: float | None = None,
    ) -> None:
        self._budget = None if bandwidth_bytes_s is None else Budget(bandwidth_bytes_s, clock_s())
        self._swarm, self._robot, self._config = swarm, robot, config
        self._counter, self._radio, self._clock_s = counter, radio, clock_s
        self._session: zenoh.Session | None = None
        self._server: Server | None = None
        self._pending = BoundedSemaphore(SERVE_PENDING_MAX)
        self._servers = ThreadPoolExecutor(SERVERS, thread_name_prefix=f"{robot}-serve")
        self._fetchers = ThreadPoolExecutor(FETCHES_MAX, thread_name_prefix=f"{robot}-fetch")
        self._slots = asyncio.Semaphore(FETCHES_MAX)
        self._partials = Partials(config.chunk_bytes)
        self._rates = LinkRates()
        self._in_flight: set[zenoh.CancellationToken] = set()

    def serve(self, lookup: LatentLookup) -> None:
        """Answer with latents from this lookup."""
        self._server = Server(lookup, self._config.latent_bytes_max, self._config.chunk_bytes)

    def open(self, settings: dict[str, Any], whose: str) -> None:
        """Open the session; blocks."""
        self._session = open_session(settings, whose)
        if self._server is not None:
            pattern = keys.latents_pattern(self._swarm, self._robot)
            self._session.declare_queryable(pattern, self._enqueue, allowed_origin=zenoh.Locality.REMOTE)

    def stop_fetching(self) -> None:
        """End all fetches; on the loop's thread."""
        for token in self._in_flight:
            token.cancel()

    def close_session(self) -> None:
        """Close the session, which `open` makes anew; blocks."""
        session, self._session = self._session, None
        if session is not None:
            session.close()

    def close(self) -> None:
        """Close the session and end the threads; blocks."""
        self.close_session()
        self._servers.shutdown(wait=True, cancel_futures=True)
        self._fetchers.shutdown(wait=True, cancel_futures=True)

    # --- serving: `_enqueue` on zenoh's thread, `_answer` on a serving thread

    def _enqueue(self, query: zenoh.Query) -> None:
        if not self._pending.acquire(blocking=False):
            self._counter.count_dropped("serve-busy")
            query.drop()
            return
        try:
            self._servers.submit(self._answer, query)
        except RuntimeError:  # the threads are closed
            query.drop()

    def _answer(self, query: zenoh.Query) -> None:
        try:
            with query:
                try:
                    self._reply(query)
                except FloccError as error:
                    self._counter.count_dropped("refused-request")
                    logger.debug("robot %s: refused a request for a latent: %s", self._robot, error)
                    query.reply_err(BAD_REQUEST)
        except zenoh.ZError as error:
            self._counter.count_dropped("not-sent")
            logger.debug("robot %s: a piece was not sent: %s", self._robot, error)
        finally:
            self._pending.release()

    def _reply(self, query: zenoh.Query) -> None:
        assert self._server is not None
        _, latent = keys.parse_latent_key(str(query.key_expr))
        offset, length = (checked_number(query.parameters.get(name)) for name in ("offset", "length"))
        wanted = query.parameters.get("encode_bytes")
        encode_bytes = None if wanted is None else checked_number(wanted)
        asker = query.parameters.get("asker")
        asker = None if asker is None else checked_name(asker)
        piece = self._server.piece(latent, offset, length, encode_bytes)
        if piece is None:
            query.reply_err(UNKNOWN)
            return
        query.reply(query.key_expr, piece.payload, attachment=piece.header())
        self._counter.count_sent(LATENT, len(piece.payload), () if asker is None else (asker,))

    # --- fetching: on the loop, except `_ask_blocking`

    async def fetch(
        self, owner: str, latent: str, deadline_s: float, sha256: bytes | None, encode_s: float | None
    ) -> Fetched | FetchFailed:
        """Fetch one latent; see `Transport.fetch_latent`."""
        encode_bytes = self._rates.carried_bytes(owner, encode_s)
        try:
            async with asyncio.timeout(deadline_s), self._slots:
                problem = await self._complete(owner, latent, sha256, encode_bytes)
        except TimeoutError:
            problem = FetchProblem.DEADLINE
        if problem in (FetchProblem.NO_ANSWER, FetchProblem.DEADLINE, FetchProblem.CLOSED):
            return FetchFailed(problem, self._partials.kept_bytes(latent))
        partial = self._partials.of(latent)
        self._partials.forget(latent)
        return FetchFailed(problem) if problem is not None else Fetched(bytes(partial.received))

    async def _complete(
        self, owner: str, latent: str, sha256: bytes | None, encode_bytes: int | None
    ) -> FetchProblem | None:
        """Ask for piece after piece until nothing is missing; pieces in a row that do not come end it."""
        partial, tries = self._partials.of(latent, encode_bytes), 0
        while not partial.is_complete:
            await self._afford()
            asked_s = time.monotonic()
            answer = await self._ask(owner, latent, partial)
            if isinstance(answer, Piece) and await self._is_received(owner, answer):
                self._rates.note(owner, len(answer.payload), time.monotonic() - asked_s)
                problem, tries = partial.add(answer, self._config.latent_bytes_max, sha256), 0
                if problem is not None:
                    return problem
                continue
            tries += 1
            if isinstance(answer, FetchProblem) and answer is not FetchProblem.NO_ANSWER:
                return answer
            if tries >= TRIES_MAX:
                return FetchProblem.NO_ANSWER
            if not isinstance(answer, Piece):
                partial.ask_for_less()
            await asyncio.sleep(PAUSE_S * 2 ** (tries - 1))
        return None

    async def _afford(self) -> None:
        """Wait until the budget has room for a piece."""
        while self._budget is not None:
            pause_s = self._budget.pause_s(self._counter.used_bytes(), self._clock_s())
            if pause_s <= 0.0:
                return
            await asyncio.sleep(pause_s)

    async def _ask(self, owner: str, latent: str, partial: Partial) -> Piece | FetchProblem:
        """Ask for the next piece, on a thread."""
        key = keys.latent_key(self._swarm, owner, latent)
        selector = f"{key}?offset={len(partial.received)};length={partial.piece_bytes};asker={self._robot}"
        if partial.encode_bytes is not None:
            selector += f";encode_bytes={partial.encode_bytes}"
        token = zenoh.CancellationToken()
        self._in_flight.add(token)
        try:
            loop = asyncio.get_running_loop()
            return await loop.run_in_executor(self._fetchers, self._ask_blocking, selector, token)
        except RuntimeError:  # the threads are closed
            return FetchProblem.CLOSED
        except asyncio.CancelledError:
            token.cancel()
            raise
        finally:
            self._in_flight.discard(token)

    def _ask_blocking(self, selector: str, token: zenoh.CancellationToken) -> Piece | FetchProblem:
        session = self._session
        if session is None:
            return FetchProblem.CLOSED
        try:
            replies = session.get(
                selector,
                zenoh.handlers.FifoChannel(4),
                timeout=CHUNK_TIMEOUT_S,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_LOW,
                consolidation=zenoh.ConsolidationMode.NONE,
                cancellation_token=token,
                allowed_destination=zenoh.Locality.REMOTE,
            )
            reply = next(iter(replies), None)
        except zenoh.ZError as error:
            logger.debug("robot %s: a piece could not be asked for: %s", self._robot, error)
            return FetchProblem.NO_ANSWER
        return self._piece(reply)

    def _piece(self, reply: zenoh.Reply | None) -> Piece | FetchProblem:
        """Read a reply; a malformed one counts as none."""
        if reply is None:
            return FetchProblem.NO_ANSWER
        if reply.ok is None:
            refused = reply.err is not None and reply.err.payload.to_bytes() == UNKNOWN
            return FetchProblem.UNKNOWN if refused else FetchProblem.NO_ANSWER
        header = reply.ok.attachment.to_bytes() if reply.ok.attachment is not None else b""
        try:
            return Piece.parse(header, reply.ok.payload.to_bytes())
        except DecodeError as error:
            self._counter.count_dropped("malformed-piece")
            logger.debug("robot %s: refused a piece of a latent: %s", self._robot, error)
            return FetchProblem.NO_ANSWER

    async def _is_received(self, owner: str, piece: Piece) -> bool:
        """Count a piece, after the emulated radio let the request and the piece pass."""
        if self._radio is not None:
            now_s = self._clock_s()
            asked = self._radio.transmit(self._robot, owner, LATENT, REQUEST_BYTES, now_s)
            arrivals = self._radio.transmit(owner, self._robot, LATENT, len(piece.payload), asked[0]) if asked else []
            if not arrivals:
                self._counter.count_lost(LATENT, len(piece.payload), owner)
                return False
            await asyncio.sleep(arrivals[0] - now_s)
        self._counter.count_received(LATENT, len(piece.payload), owner)
        return True
