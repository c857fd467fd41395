"""Signed messages wait here until their signatures were looked at, off the event loop.

Each peer has a queue and a budget of its own: whoever sends more than is checked for it fills its own queue and delays
nobody else. A turn takes from each peer what its budget allows, asks the robot what of it would be checked at all, and
has that checked by a worker; then the robot gets the messages, in the order in which their peer sent them. The next
turn waits until the robot has handled them, since what it holds by then, and whom it does not listen to, decides what
is worth a check.
"""

from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field

from flocc_agent.core.claims import Claim
from flocc_protocol.messages import CorrectionBatch, Envelope, Records

PEERS_MAX = 256
WAITING_MAX = 256
"""Messages of one peer."""
CHECKS_PER_S, CHECKS_BURST = 1000.0, 2000.0
"""Of what one peer sends: some 0.1 to 0.2 s of CPU a second; answers bring 750 keyframes a second at most."""
TURN_CLAIMS = 256
"""A turn takes in no further peer's messages once it has so many to check: some 40 ms."""
TURN_MESSAGES = 32
"""Of one peer in one turn."""


@dataclass(slots=True)
class _Signer:
    """What waits of a peer, and how many checks it may still have, as of a time; below none it waits."""

    checks: float
    as_of_s: float
    waiting: deque[Envelope] = field(default_factory=deque)

    def due_s(self) -> float:
        """When it may have a check."""
        return self.as_of_s + max(-self.checks, 0.0) / CHECKS_PER_S

    def charge(self, looked_at: int, now: float) -> None:
        """Account for checks."""
        gained = CHECKS_PER_S * max(now - self.as_of_s, 0.0)
        self.checks, self.as_of_s = min(self.checks + gained, CHECKS_BURST) - looked_at, now


class SignatureQueue:
    """Hands signed messages on once a worker has checked what they claim."""

    def __init__(
        self,
        claims_of: Callable[[Envelope, float], list[Claim]],
        check: Callable[[Sequence[Sequence[Claim]]], Awaitable[list[int]]],
        deliver: Callable[[Envelope], None],
    ) -> None:
        """Start with nothing.

        Args:
            claims_of: What of a message would be checked.
            check: Has the claims of messages checked elsewhere; gives how many of each were looked at.
            deliver: Takes a message whose claims were checked; whoever handled it calls `on_handled`.
        """
        self._claims_of = claims_of
        self._check = check
        self._deliver = deliver
        self._peers: dict[str, _Signer] = {}
        self._turn: list[Envelope] = []

    @staticmethod
    def is_for(envelope: Envelope) -> bool:
        """Whether a message may carry signatures."""
        return isinstance(envelope.message, Records | CorrectionBatch)

    def size(self) -> tuple[int, int]:
        """Messages of the peer of which most wait, and how many may."""
        return max((len(peer.waiting) for peer in self._peers.values()), default=0), WAITING_MAX

    def is_waiting(self) -> bool:
        """Whether anything waits, or is checked or handled."""
        return bool(self._turn) or any(peer.waiting for peer in self._peers.values())

    def put(self, envelope: Envelope, now: float) -> bool:
        """Let a message wait for its turn; False where too many of its peer's wait already."""
        name = envelope.sender.robot
        peer = self._peers.get(name)
        if peer is None:
            if not self._is_room():
                return False
            peer = self._peers[name] = _Signer(CHECKS_BURST, now)
        if len(peer.waiting) >= WAITING_MAX:
            return False
        peer.waiting.append(envelope)
        return True

    def _is_room(self) -> bool:
        """Whether one more peer may be known, if need be in the place of one of whom nothing waits."""
        if len(self._peers) < PEERS_MAX:
            return True
        at_work = {envelope.sender.robot for envelope in self._turn}
        idle = next((name for name, peer in self._peers.items() if not peer.waiting and name not in at_work), None)
        if idle is not None:
            del self._peers[idle]
        return idle is not None

    def on_handled(self, envelope: Envelope) -> None:
        """The robot has handled a message that was handed on; with the last one of them the turn is over."""
        if self._turn and envelope is self._turn[-1]:
            self._turn = []

    def due_s(self) -> float:
        """When the next turn can begin: as soon as a peer of which something waits may have checks."""
        if self._turn:
            return float("inf")
        return min((peer.due_s() for peer in self._peers.values() if peer.waiting), default=float("inf"))

    def next_turn(self, now: float) -> list[list[Claim]]:
        """Begin a turn where one is due: what is to be checked for each of its messages, in order."""
        found: list[list[Claim]] = []
        if self.due_s() > now:
            return found
        for name, peer in list(self._peers.items()):
            if not peer.waiting or peer.due_s() > now or sum(map(len, found)) >= TURN_CLAIMS:
                continue
            self._peers[name] = self._peers.pop(name)  # behind those whose turn this was not
            found += self._taken(peer, now)
        return found

    def _taken(self, peer: _Signer, now: float) -> list[list[Claim]]:
        """Messages of one peer up to the first that claims something: what the next ones claim depends on it."""
        found: list[list[Claim]] = []
        while peer.waiting and not any(found) and len(found) < TURN_MESSAGES:
            self._turn.append(peer.waiting.popleft())
            found.append(self._claims_of(self._turn[-1], now))
        return found

    async def run_turn(self, claims: list[list[Claim]], now: float) -> None:
        """Have a turn's claims checked, then hand its messages on."""
        if any(claims):
            counts = await self._check(claims)
            for envelope, looked_at in zip(self._turn, counts, strict=True):
                self._peers[envelope.sender.robot].charge(looked_at, now)
        for envelope in list(self._turn):
            self._deliver(envelope)
