"""What one peer may cost a robot: bytes of answers, and signatures that fail.

A request of a few bytes draws an answer of many, also in another's name; so answers to one name have a budget. A
signature is checked before anything is believed, which costs more than anything else about a message; where one fails,
what this peer relays of that robot is not looked at for a while, longer each time. What it relays of others is: it may
be an honest robot whose list of members is older. Without keys nothing fails, so that no stranger can silence a peer.
"""

from dataclasses import dataclass

from flocc_agent.core.effects import Effect, Unicast
from flocc_agent.core.pulls import remember
from flocc_protocol.messages import CorrectionBatch, Records

PEERS_MAX = 256
SILENCES_MAX = 1024
ANSWER_BYTES_PER_S = 1e6
"""Of one peer, over time; a robot that catches up on a whole map gets 750 keyframes a second."""
ANSWER_BURST_BYTES = 2e6
CORRECTION_BYTES = 4_000
"""What a correction counts; few are much larger."""
MUTED_FIRST_S = 1.0
MUTED_MAX_S = 64.0
FORGIVEN_S = 600.0
"""A peer of which nothing failed for so long begins anew with the first pause."""


@dataclass(slots=True)
class _Account:
    """What a peer may still be answered, as of a time."""

    bytes_left: float
    as_of_s: float


class AnswerBudget:
    """Bytes that are still to be had as answers, by peer."""

    def __init__(self) -> None:
        self._accounts: dict[str, _Account] = {}

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return {"answered": (len(self._accounts), PEERS_MAX)}

    def within(self, peer: str, answers: list[Effect], now: float) -> list[Effect]:
        """The answers to a request, as many as the peer's budget has room for; it asks again for the rest."""
        account = self._accounts.get(peer, _Account(ANSWER_BURST_BYTES, now))
        gained = ANSWER_BYTES_PER_S * max(now - account.as_of_s, 0.0)
        left = min(account.bytes_left + gained, ANSWER_BURST_BYTES)
        given: list[Effect] = []
        for answer in answers:
            size = _size_bytes(answer)
            if size > left:
                break
            left -= size
            given.append(answer)
        remember(self._accounts, peer, _Account(left, now), PEERS_MAX)
        return given


@dataclass(slots=True)
class _Silence:
    """Until when a peer is not heard, and for how long that is."""

    until_s: float
    lasts_s: float


class Muted:
    """Peers in whose messages a signature of some robot failed, and of whom; or leaders that are not believed."""

    def __init__(self, first_s: float = MUTED_FIRST_S, max_s: float = MUTED_MAX_S) -> None:
        self._first_s = first_s
        self._max_s = max_s
        self._silences: dict[tuple[str, str], _Silence] = {}

    def sizes(self, name: str) -> dict[str, tuple[int, int]]:
        """The table with its maximum, under a name."""
        return {name: (len(self._silences), SILENCES_MAX)}

    def forgive(self, peer: str, signer: str) -> None:
        """It was no failure."""
        self._silences.pop((peer, signer), None)

    def is_muted(self, peer: str, signer: str, now: float) -> bool:
        """Whether what a peer sends of a robot is not looked at now."""
        silence = self._silences.get((peer, signer))
        return silence is not None and now < silence.until_s

    def until_s(self) -> float:
        """When the last silence ends that began so far."""
        return max((silence.until_s for silence in self._silences.values()), default=float("-inf"))

    def on_failed(self, peer: str, signer: str, now: float) -> None:
        """A signature of a robot failed in what a peer sent."""
        last = self._silences.get((peer, signer))
        fresh = last is None or last.until_s + FORGIVEN_S <= now
        lasts_s = self._first_s if last is None or fresh else min(2 * last.lasts_s, self._max_s)
        remember(self._silences, (peer, signer), _Silence(now + lasts_s, lasts_s), SILENCES_MAX)


def _size_bytes(answer: Effect) -> int:
    match answer:
        case Unicast(_, Records(batches)):
            return sum(batch.size_bytes for batch in batches)
        case Unicast(_, CorrectionBatch(corrections)):
            return CORRECTION_BYTES * len(corrections)
        case _:
            return 0
