"""Records on their way: batches of a log, and requests for what is missing."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from flocc_protocol.codec import COUNT, LOG_ID, Kinds, blob, integer, sequence, struct
from flocc_protocol.ids import INDEX_MAX, LogId
from flocc_protocol.records import SEALED_RECORD_BYTES_MAX

RECORDS_BATCH_MAX = 64
BATCHES_MAX = 64
RECORDS_BATCH_BYTES_MAX = 32 * 1024
CHECKSUM_MAX = 2**32 - 1


@dataclass(frozen=True, slots=True)
class RecordBatch:
    """Records of one log from number `first` on.

    Attributes:
        log: Whose log.
        first: Number of the first record.
        checksum_before: The sender's chained checksum of the records before `first`.
        records: Encoded records, in order; each ends in its writer's signature where the swarm signs records.
    """

    log: LogId
    first: int
    checksum_before: int
    records: tuple[bytes, ...]

    def __post_init__(self) -> None:
        if len(self.records) > RECORDS_BATCH_MAX or self.size_bytes > RECORDS_BATCH_BYTES_MAX:
            raise ValueError(f"{len(self.records)} records of {self.size_bytes} bytes are more than a batch may hold")
        if self.first + len(self.records) > INDEX_MAX:
            raise ValueError(f"a log does not hold {self.first + len(self.records)} records")

    @property
    def size_bytes(self) -> int:
        """Bytes of all its records."""
        return sum(map(len, self.records))

    @classmethod
    def of(
        cls,
        log: LogId,
        first: int,
        checksum_before: int,
        records: Iterable[bytes],
        room: int = RECORDS_BATCH_BYTES_MAX,
    ) -> "RecordBatch":
        """Build a batch from as many of the records, in order, as fit into that many bytes of one message."""
        taken: list[bytes] = []
        for record in records:
            room -= len(record)
            if room < 0 or len(taken) == RECORDS_BATCH_MAX:
                break
            taken.append(record)
        return cls(log, first, checksum_before, tuple(taken))


@dataclass(frozen=True, slots=True)
class Records:
    """Records of several logs; all together are no larger than one batch may be."""

    batches: tuple[RecordBatch, ...]

    def __post_init__(self) -> None:
        bytes_total = sum(batch.size_bytes for batch in self.batches)
        if len(self.batches) > BATCHES_MAX or bytes_total > RECORDS_BATCH_BYTES_MAX:
            raise ValueError(f"{len(self.batches)} batches of {bytes_total} bytes are more than a message may hold")


class LogPosition(NamedTuple):
    """A place in a log: the record of this number is the next one."""

    log: LogId
    first: int


@dataclass(frozen=True, slots=True)
class RecordRequest:
    """Please send records of these logs, of each from its position on, as many as fit one message."""

    positions: tuple[LogPosition, ...]


CHECKSUM = integer(0, CHECKSUM_MAX)
_POSITION = struct(LogPosition, log=LOG_ID, first=COUNT)
_BATCH = struct(
    RecordBatch,
    log=LOG_ID,
    first=COUNT,
    checksum_before=CHECKSUM,
    records=sequence(blob(SEALED_RECORD_BYTES_MAX), RECORDS_BATCH_MAX),
)


CODECS: Kinds = {
    "records": (Records, struct(Records, batches=sequence(_BATCH, BATCHES_MAX))),
    "want-records": (RecordRequest, struct(RecordRequest, positions=sequence(_POSITION, BATCHES_MAX))),
}
