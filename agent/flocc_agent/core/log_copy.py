"""A prefix of one robot's log, as every robot holds it: the records' bytes, decoded when somebody asks.

Rules: what a record says is not kept as objects; whoever derives something from records does so as they come. Full
blocks of records never change, so copies of one log in one process share them, and old ones leave memory where there
is a cold storage; the last few records are kept singly. Descriptors of a block stand in it as rows, which place
recognition reads where they are.
The chained checksum is one of all bytes so far: it is known after each block, and found again from there.
"""

from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import blake2b
from itertools import accumulate
from typing import overload
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.cold_storage import ColdPieces
from flocc_protocol.records import (
    JUDGEMENT_CODES,
    KEYFRAME_CODE,
    ClosureRecord,
    KeyframeRecord,
    Record,
    RejectionRecord,
    UnknownRecord,
    chain,
    decode_record,
    int8_descriptor,
)

Rows = NDArray[np.int8]

BLOCK_RECORDS = 64
"""Records of a block: some 15 kB, so that a checksum within it takes microseconds."""
DECODED_MAX = 1024
CODE_AT = 1
"""Where a record says of what kind it is."""


@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False)
class _Block:
    """`BLOCK_RECORDS` records in one piece, and their descriptors apart, as rows that others may read.

    Attributes:
        data: The records without what stands in the rows.
        ends: Where each ends in that.
        cuts: Where in a record its row belongs; 0 where it has none.
        rows: Descriptors (K, D) int8, of the records that have one, in their order; of one length.
    """

    data: bytes
    ends: "array[int]"
    cuts: "array[int]"
    rows: Rows

    @classmethod
    def of(cls, records: Sequence[bytes]) -> "_Block":
        """These records."""
        places = list(map(int8_descriptor, records))
        dimension = next((place.stop - place.start for place in places if place is not None), 0)
        data, rows = list[bytes](), list[bytes]()
        ends, cuts, end = array("I"), array("H"), 0
        for record, place in zip(records, places, strict=True):
            if place is None or place.stop - place.start != dimension:
                data.append(record)
                cuts.append(0)
            else:
                data.append(record[: place.start] + record[place.stop :])
                cuts.append(place.start)
                rows.append(record[place])
            end += len(data[-1])
            ends.append(end)
        return cls(b"".join(data), ends, cuts, np.frombuffer(b"".join(rows), np.int8).reshape(len(rows), dimension))

    @classmethod
    def whole(cls, data: bytes, ends: "array[int]") -> "_Block":
        """Records in one piece, with their descriptors."""
        return cls(data, ends, array("H", bytes(2 * len(ends))), np.empty((0, 0), np.int8))

    def record(self, k: int) -> bytes:
        data, cut = self.data[self.ends[k - 1] if k else 0 : self.ends[k]], self.cuts[k]
        return data if not cut else b"".join((data[:cut], self.rows[self._row(k)].tobytes(), data[cut:]))

    def _row(self, k: int) -> int:
        return k - self.cuts[:k].count(0)

    def is_keyframe(self, k: int) -> bool:
        return self.data[(self.ends[k - 1] if k else 0) + CODE_AT] == KEYFRAME_CODE


@dataclass(frozen=True, slots=True)
class _ColdBlock:
    """Where a block is that left memory."""

    place: int
    size_bytes: int


_blocks: "WeakValueDictionary[bytes, _Block]" = WeakValueDictionary()
"""By a hash of their bytes and of where records end."""


def _block_of(records: Sequence[bytes]) -> _Block:
    """A block of these records; one that somebody in this process holds already."""
    key = blake2b(b"".join([array("I", map(len, records)).tobytes(), *records]), digest_size=16).digest()
    block = _blocks.get(key)
    if block is None:
        block = _blocks[key] = _Block.of(records)
    return block


class EncodedRecords(Sequence[bytes]):
    """Records' bytes, in order; only ever longer, but for `truncate`. Other threads may read while one appends."""

    def __init__(self, records: Iterable[bytes] = (), cold: ColdPieces | None = None) -> None:
        """Start with these; with a cold storage, old blocks leave memory."""
        self._full: list[_Block | _ColdBlock] = []
        self._end: tuple[int, list[bytes]] = (0, [])
        """How many blocks are full, and the records after them; replaced as one, so that readers see both."""
        self._cold = cold
        for record in records:
            self.append(record)

    def __len__(self) -> int:
        full, tail = self._end
        return full * BLOCK_RECORDS + len(tail)

    def __iter__(self) -> Iterator[bytes]:
        full, tail = self._end
        for number in range(full):
            yield from map(self._block(number).record, range(BLOCK_RECORDS))
        yield from tail

    @overload
    def __getitem__(self, index: int) -> bytes: ...

    @overload
    def __getitem__(self, index: slice) -> list[bytes]: ...

    def __getitem__(self, index: int | slice) -> bytes | list[bytes]:
        end = self._end
        count = end[0] * BLOCK_RECORDS + len(end[1])
        if isinstance(index, slice):
            first, last, step = index.indices(count)
            newest = end[0] * BLOCK_RECORDS
            if first >= newest and step == 1:
                return end[1][first - newest : last - newest]
            return [self._at(k, end) for k in range(first, last, step)]
        if not -count <= index < count:
            raise IndexError(f"record {index} of {count}")
        return self._at(index % count, end)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and list(self) == list(other)

    __hash__ = None  # type: ignore[assignment]  # it grows

    def _at(self, index: int, end: tuple[int, list[bytes]]) -> bytes:
        number, k = divmod(index, BLOCK_RECORDS)
        return end[1][k] if number == end[0] else self._block(number).record(k)

    def _block(self, number: int) -> _Block:
        block = self._full[number]
        if isinstance(block, _Block):
            return block
        assert self._cold is not None
        piece, ends = self._cold.get(block.place, block.size_bytes), array("I")
        ends.frombytes(piece[: BLOCK_RECORDS * ends.itemsize])
        return _Block.whole(piece[BLOCK_RECORDS * ends.itemsize :], ends)

    def cool(self, number: int) -> None:
        """Move a full block out of memory, where there is room for it elsewhere."""
        block = self._full[number]
        if isinstance(block, _Block) and self._cold is not None:
            records = [block.record(k) for k in range(BLOCK_RECORDS)]
            piece = array("I", accumulate(map(len, records))).tobytes() + b"".join(records)
            place = self._cold.put(piece)
            if place is not None:
                self._full[number] = _ColdBlock(place, len(piece))

    def append(self, data: bytes) -> None:
        """Add the next record."""
        full, tail = self._end
        tail.append(data)
        if len(tail) == BLOCK_RECORDS:
            self._full.append(_block_of(tail))
            self._end = (full + 1, [])
            if self._cold is not None:
                self._cold.add(self, full)

    def truncate(self, count: int) -> None:
        """Keep so many records."""
        number, k = divmod(min(count, len(self)), BLOCK_RECORDS)
        self._end = (number, self[number * BLOCK_RECORDS : number * BLOCK_RECORDS + k])
        del self._full[number:]

    def block_checksum(self, number: int, k: int, before: int) -> int:
        """Checksum after the first `k` records of a full block, of that before it."""
        block = self._block(number)
        for record in map(block.record, range(k)):
            before = chain(before, record)
        return before

    def block_descriptors(self, number: int, first: int) -> tuple[list[int], Rows]:
        """Keyframes of a full block that is in memory, of which the first has this index, and their rows (K, D)."""
        block = self._full[number]
        if not isinstance(block, _Block):
            return [], np.empty((0, 0), np.int8)
        keyframes = accumulate((block.is_keyframe(k) for k in range(BLOCK_RECORDS)), initial=first)
        return [index for index, cut in zip(keyframes, block.cuts, strict=False) if cut], block.rows


class _DecodedRecords(Sequence[Record]):
    """What records say, decoded when it is asked for, without descriptors."""

    def __init__(self, encoded: EncodedRecords, seal_bytes: int) -> None:
        self._encoded = encoded
        self._seal_bytes = seal_bytes

    def __len__(self) -> int:
        return len(self._encoded)

    def __iter__(self) -> Iterator[Record]:
        return map(self._decoded, self._encoded)

    @overload
    def __getitem__(self, index: int) -> Record: ...

    @overload
    def __getitem__(self, index: slice) -> list[Record]: ...

    def __getitem__(self, index: int | slice) -> Record | list[Record]:
        if isinstance(index, slice):
            return [self._decoded(data) for data in self._encoded[index]]
        return self._decoded(self._encoded[index])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and list(self) == list(other)

    __hash__ = None  # type: ignore[assignment]  # it grows

    def _decoded(self, data: bytes) -> Record:
        return kept(decoded(data[: len(data) - self._seal_bytes]))


class LogCopy:
    """A prefix of one robot's log.

    Attributes:
        encoded: The records' bytes, each with its writer's seal where the swarm seals records.
        keyframes: How many of them are keyframes.
    """

    __slots__ = ("_block_checksums", "_block_keyframes", "_seal_bytes", "_tail_checksums", "encoded", "keyframes")

    def __init__(self, cold: ColdPieces | None = None) -> None:
        self.encoded = EncodedRecords(cold=cold)
        self.keyframes = 0
        self._seal_bytes = 0
        self._block_checksums = array("I")
        self._block_keyframes = array("I", [0])
        self._tail_checksums = [0]

    def __len__(self) -> int:
        return len(self.encoded)

    @property
    def records(self) -> Sequence[Record]:
        """The records without descriptors, decoded when they are looked at."""
        return _DecodedRecords(self.encoded, self._seal_bytes)

    def other_records(self) -> Iterator[Record]:
        """The records that are no keyframes; keyframes are not even decoded."""
        others = (data for data in self.encoded if data[CODE_AT] != KEYFRAME_CODE)
        return (kept(decoded(data[: len(data) - self._seal_bytes])) for data in others)

    def judgements(self, first: int = 0) -> Iterator[tuple[int, ClosureRecord | RejectionRecord]]:
        """Closures and rejections with the numbers of their records, from a number on; others are not decoded."""
        for number, data in enumerate(self.encoded[first:] if first else self.encoded, first):
            if data[CODE_AT] in JUDGEMENT_CODES:
                record = kept(decoded(data[: len(data) - self._seal_bytes]))
                if isinstance(record, ClosureRecord | RejectionRecord):
                    yield number, record

    @property
    def checksum(self) -> int:
        """Chained checksum of all records."""
        return self._tail_checksums[-1]

    def checksum_at(self, count: int) -> int:
        """Chained checksum of the first so many records."""
        number, k = divmod(count, BLOCK_RECORDS)
        if number == len(self._block_checksums):
            return self._tail_checksums[k]
        return self.encoded.block_checksum(number, k, self._block_checksums[number])

    def append(self, data: bytes, seal_bytes: int = 0) -> None:
        """Add the next record, the last so many bytes of which are its seal."""
        assert seal_bytes == self._seal_bytes or not len(self), "all records of a log are sealed, or none"
        self._seal_bytes = seal_bytes
        self.encoded.append(data)
        self._tail_checksums.append(chain(self._tail_checksums[-1], data))
        if len(self._tail_checksums) > BLOCK_RECORDS:
            self._block_checksums.append(self._tail_checksums[0])
            del self._tail_checksums[:-1]
        self.keyframes += data[CODE_AT] == KEYFRAME_CODE
        if len(self._tail_checksums) == 1:
            self._block_keyframes.append(self.keyframes)

    def descriptors(self, block: int) -> tuple[list[int], Rows]:
        """Keyframes of a full block and their descriptors, as they are held here: rows (K, D) of int8."""
        return self.encoded.block_descriptors(block, self._block_keyframes[block])

    def agrees(self, first: int, checksum_before: int, records: Sequence[bytes]) -> bool:
        """Whether records from a number on, which this copy holds or could go on with, are what it has there."""
        if self.checksum_at(first) != checksum_before:
            return False
        held = self.encoded[first : first + len(records)]
        return held == list(records[: len(held)])

    def accepts(self, record: Record) -> bool:
        """Whether the record can be next: keyframes are numbered without gaps."""
        return not isinstance(record, KeyframeRecord) or record.index == self.keyframes


@lru_cache(maxsize=DECODED_MAX)
def decoded(data: bytes) -> Record:
    """A record, decoded once where several copies of a log live in one process."""
    return decode_record(data)


def kept(record: Record) -> Record:
    """A record without what is held elsewhere: place recognition has the descriptor, the log the record's bytes."""
    match record:
        case KeyframeRecord():
            return replace(record, descriptor=None)
        case UnknownRecord(code):
            return UnknownRecord(code, b"")
        case _:
            return record
