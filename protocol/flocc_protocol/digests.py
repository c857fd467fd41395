"""What robots hold, compared: a hash of a whole table in every heartbeat, what changed in it to those who ask.

A robot has two tables with one entry per log: how much of the log it holds, and which correction. It numbers the
changes of each from its start on. Who finds that hashes differ asks for what changed since the number that it knows.
"""

from dataclasses import dataclass
from functools import lru_cache
from hashlib import blake2b
from typing import Any, NamedTuple

from flocc_protocol.codec import COUNT, LOG_ID, LOGS_MAX, REPEATED_MAX, Codec, Kinds, integer, packed, sequence, struct
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import INCARNATION_MAX, INDEX_MAX, LogId
from flocc_protocol.log_corrections import VERSION, CorrectionVersion
from flocc_protocol.record_batches import CHECKSUM, CHECKSUM_MAX

HASH_BYTES = 7
HASH_MAX = 256**HASH_BYTES - 1


class LogDigest(NamedTuple):
    """How much of one log the sender holds, with the chained checksum of those records."""

    log: LogId
    count: int  # type: ignore[assignment]  # tuples have a method of this name, which nobody needs here
    checksum: int


class TableState(NamedTuple):
    """One of the sender's tables.

    Attributes:
        hash: Exclusive or of `entry_hash` of all entries; equal tables have equal hashes.
        changes: How many changes it had since the sender's start.
    """

    hash: int
    changes: int


@dataclass(frozen=True, slots=True)
class DigestRequest:
    """Please say what changed in your tables after these changes of them."""

    digests_since: int
    versions_since: int


@dataclass(frozen=True, slots=True)
class Digests:
    """What changed in the sender's tables, the changes that are longest ago first.

    Attributes:
        boot: Start of the sender in which changes are numbered.
        digests_through: Number of the last change that `digests` tell of.
        digests: What the sender holds of logs.
        versions_through: Number of the last change that `versions` tell of.
        versions: Which corrections the sender holds.
    """

    boot: int
    digests_through: int
    digests: tuple[LogDigest, ...]
    versions_through: int
    versions: tuple[CorrectionVersion, ...]


def entry_hash(entry: LogDigest | CorrectionVersion) -> int:
    """Hash of one entry: the first bytes of BLAKE2b over it as it is on the wire."""
    return int.from_bytes(blake2b(packed(entry), digest_size=HASH_BYTES).digest(), "big")


_ANY_DIGEST = struct(LogDigest, log=LOG_ID, count=COUNT, checksum=CHECKSUM)


@lru_cache(maxsize=REPEATED_MAX)
def _digest(raw: Any) -> LogDigest:
    """The same digest comes back from many robots as the same object, checked once."""
    assert _ANY_DIGEST.build is not None
    return _ANY_DIGEST.build(raw)


def _pack_digest(value: LogDigest) -> LogDigest:
    """A digest is a tuple as it is on the wire."""
    log, count, checksum = value
    if not 0 <= count <= INDEX_MAX or not 0 <= checksum <= CHECKSUM_MAX:
        raise DecodeError(f"digest of {log} is out of range")
    return value


_DIGEST = Codec(_pack_digest, _ANY_DIGEST.wire, _digest)
TABLE_STATE = struct(TableState, hash=integer(0, HASH_MAX), changes=COUNT)


CODECS: Kinds = {
    "digests": (
        Digests,
        struct(
            Digests,
            boot=integer(0, INCARNATION_MAX),
            digests_through=COUNT,
            digests=sequence(_DIGEST, LOGS_MAX),
            versions_through=COUNT,
            versions=sequence(VERSION, LOGS_MAX),
        ),
    ),
    "want-digests": (DigestRequest, struct(DigestRequest, digests_since=COUNT, versions_since=COUNT)),
}
