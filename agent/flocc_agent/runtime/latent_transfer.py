"""Latents in pieces: what one piece says of the whole, and what a robot keeps of a fetch that was cut.

A piece is asked for with `offset` and `length`. Its attachment tells the offset, the size of the whole and its
SHA-256, so that a fetch goes on where it ended, also with another holder, and so that a wrong piece is noticed.
Nothing here knows zenoh.
"""

import hashlib
import struct
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Lock

from flocc_agent.runtime.transport import FetchProblem
from flocc_protocol.errors import DecodeError

HEADER = struct.Struct(">BQQ32s")
FORMAT = 1
PARTIALS_MAX = 8
SERVED_MAX = 4
PIECE_BYTES_MIN = 16 * 1024
LINKS_MAX = 256
RATE_SMOOTHING_RATIO = 0.3
CARRIED_BYTES_MAX = 2**31
DIGITS_MAX = 12

UNKNOWN = b"flocc: unknown latent"
BAD_REQUEST = b"flocc: bad request"


@dataclass(frozen=True, slots=True)
class Piece:
    """Part of a latent, at an offset, with size and hash of the whole."""

    offset: int
    total_bytes: int
    sha256: bytes
    payload: bytes

    def header(self) -> bytes:
        """What travels as attachment beside the payload."""
        return HEADER.pack(FORMAT, self.offset, self.total_bytes, self.sha256)

    @classmethod
    def parse(cls, header: bytes, payload: bytes) -> "Piece":
        """Read what `header()` wrote.

        Raises:
            DecodeError: The header is not one, or the piece does not lie inside of the whole.
        """
        if len(header) != HEADER.size:
            raise DecodeError(f"header of a piece is {len(header)} bytes, not {HEADER.size}")
        version, offset, total_bytes, sha256 = HEADER.unpack(header)
        if version != FORMAT:
            raise DecodeError(f"header of a piece has format {version}, not {FORMAT}")
        if offset + len(payload) > total_bytes or (not payload and offset != total_bytes):
            raise DecodeError(f"piece of {len(payload)} bytes at {offset} does not fit into {total_bytes} bytes")
        return cls(offset, total_bytes, sha256, payload)


@dataclass(slots=True)
class Partial:
    """What came so far of one latent, and how long a piece to ask for next; shorter on links that prove slow.

    Attributes:
        piece_bytes: Length to ask for.
        encode_bytes: What the link carries while this robot encodes a picture; None where it wants no picture. It
            stays the same for all pieces, because the holder chooses by it what the whole is.
        sha256: Of the whole; empty before the first piece.
        total_bytes: Of the whole; None before the first piece.
        received: The bytes so far.
    """

    piece_bytes: int
    encode_bytes: int | None = None
    sha256: bytes = b""
    total_bytes: int | None = None
    received: bytearray = field(default_factory=bytearray)

    @property
    def is_complete(self) -> bool:
        """Whether nothing is missing."""
        return self.total_bytes is not None and len(self.received) >= self.total_bytes

    def ask_for_less(self) -> None:
        """A piece did not come in time: a shorter one may."""
        self.piece_bytes = max(self.piece_bytes // 2, min(PIECE_BYTES_MIN, self.piece_bytes))

    def add(self, piece: Piece, latent_bytes_max: int, expected_sha256: bytes | None) -> FetchProblem | None:
        """Append a piece, or say why the latent cannot be had.

        A piece of another whole (the holder changed) starts anew. Other offsets than the next one are ignored.
        """
        if piece.total_bytes > latent_bytes_max:
            return FetchProblem.TOO_LARGE
        if expected_sha256 is not None and piece.sha256 != expected_sha256:
            return FetchProblem.WRONG_HASH
        if (piece.sha256, piece.total_bytes) != (self.sha256, self.total_bytes):
            self.sha256, self.total_bytes = piece.sha256, piece.total_bytes
            self.received.clear()
        if piece.offset == len(self.received):
            self.received += piece.payload
        if self.is_complete and hashlib.sha256(self.received).digest() != self.sha256:
            return FetchProblem.WRONG_HASH
        return None


class Partials:
    """Unfinished fetches, the most recent few."""

    def __init__(self, piece_bytes: int) -> None:
        self._piece_bytes = piece_bytes
        self._partials: OrderedDict[str, Partial] = OrderedDict()

    def of(self, latent: str, encode_bytes: int | None = None) -> Partial:
        """What came so far of a latent; the least recently asked is forgotten when there are too many."""
        partial = self._partials.setdefault(latent, Partial(self._piece_bytes, encode_bytes))
        self._partials.move_to_end(latent)
        while len(self._partials) > PARTIALS_MAX:
            self._partials.popitem(last=False)
        return partial

    def forget(self, latent: str) -> None:
        """A fetch is over."""
        self._partials.pop(latent, None)

    def kept_bytes(self, latent: str) -> int:
        """What the next try need not fetch again."""
        partial = self._partials.get(latent)
        return len(partial.received) if partial else 0


class LinkRates:
    """How fast pieces came from each robot lately, request and answer included."""

    def __init__(self) -> None:
        self._bytes_per_s: OrderedDict[str, float] = OrderedDict()

    def note(self, robot: str, piece_bytes: int, elapsed_s: float) -> None:
        """A piece came; short ones tell of the latency rather than of the rate and are left out."""
        if piece_bytes < PIECE_BYTES_MIN or elapsed_s <= 0:
            return
        rate = piece_bytes / elapsed_s
        before = self._bytes_per_s.setdefault(robot, rate)
        self._bytes_per_s[robot] = before + RATE_SMOOTHING_RATIO * (rate - before)
        self._bytes_per_s.move_to_end(robot)
        while len(self._bytes_per_s) > LINKS_MAX:
            self._bytes_per_s.popitem(last=False)

    def carried_bytes(self, robot: str, duration_s: float | None) -> int | None:
        """What the link from a robot carries in a time; None where nothing was measured or no time is given."""
        rate = self._bytes_per_s.get(robot)
        return None if rate is None or duration_s is None else min(int(rate * duration_s), CARRIED_BYTES_MAX)


class Server:
    """Cuts latents into pieces; remembers the last few, because one latent is asked for piece by piece."""

    def __init__(
        self, lookup: Callable[[str, int | None], bytes | None], latent_bytes_max: int, chunk_bytes_max: int
    ) -> None:
        self._lookup = lookup
        self._latent_bytes_max = latent_bytes_max
        self._chunk_bytes_max = chunk_bytes_max
        self._lock = Lock()
        self._recent: OrderedDict[tuple[str, int | None], tuple[bytes, bytes]] = OrderedDict()

    def piece(self, latent: str, offset: int, length: int, encode_bytes: int | None = None) -> Piece | None:
        """Give a piece of a latent, shorter at the end; None when it is not held or larger than allowed."""
        with self._lock:
            held = self._recent.get((latent, encode_bytes))
        if held is None:
            held = self._read(latent, encode_bytes)
        if held is None:
            return None
        payload, sha256 = held
        offset = min(offset, len(payload))
        end = offset + min(length, self._chunk_bytes_max)
        return Piece(offset, len(payload), sha256, payload[offset:end])

    def _read(self, latent: str, encode_bytes: int | None) -> tuple[bytes, bytes] | None:
        payload = self._lookup(latent, encode_bytes)
        if payload is None or len(payload) > self._latent_bytes_max:
            return None
        held = payload, hashlib.sha256(payload).digest()
        with self._lock:
            self._recent[latent, encode_bytes] = held
            while len(self._recent) > SERVED_MAX:
                self._recent.popitem(last=False)
        return held


def checked_number(text: str | None) -> int:
    """Read an offset or a length from a request.

    Raises:
        DecodeError: Not a small decimal number.
    """
    if text is None or not text.isascii() or not text.isdigit() or len(text) > DIGITS_MAX:
        raise DecodeError(f"{str(text)[:40]!r} is no offset or length")
    return int(text)
