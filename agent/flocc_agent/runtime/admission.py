"""What is taken in of peers: a payload is an envelope that its sender may have written, or is refused and counted."""

from collections import Counter
from dataclasses import dataclass

from flocc_protocol.errors import DecodeError
from flocc_protocol.messages import Envelope, UnknownVersion, decode, kind_of

REFUSED_MAX = 512
"""Refusals that are counted apart, by peer and reason."""
DETAIL_MAX = 200
"""Characters; what is refused may be quoted in it."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a payload is not taken in.

    Attributes:
        reason: One of few, for counting.
        detail: What is special about this payload, or empty.
    """

    reason: str
    detail: str = ""


def admitted(sender: str, kind: str, payload: bytes) -> Envelope | Refusal:
    """Decode a payload and hold it against the key that it came under.

    Args:
        sender: Robot that alone may write the key.
        kind: Kind of message by the key.
        payload: What came.
    """
    try:
        envelope = decode(payload)
    except UnknownVersion as error:
        return Refusal("another protocol version", str(error))
    except DecodeError as error:
        return Refusal("malformed message", f"malformed message, {kind}: {error}"[:DETAIL_MAX])
    if envelope.sender.robot != sender or kind_of(envelope.message) != kind:
        return Refusal("message of another robot or kind than its key")
    return envelope


class Refusals:
    """How often what was refused of whom."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[str, str]] = Counter()

    def count(self, peer: str, reason: str) -> tuple[str, str] | None:
        """Count one; gives the peer and reason it is counted as where it is the first of these, and is to be told."""
        if len(self._counts) >= REFUSED_MAX and (peer, reason) not in self._counts:
            peer, reason = "others", "for more reasons than are kept"
        self._counts[peer, reason] += 1
        return (peer, reason) if self._counts[peer, reason] == 1 else None

    def by_reason(self) -> dict[str, int]:
        """Messages refused by reason, of all peers."""
        refused = Counter[str]()
        for (_, reason), count in self._counts.items():
            refused[f"refused {reason}"] += count
        return dict(refused)
