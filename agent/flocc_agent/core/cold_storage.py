"""What is old leaves memory: pieces that are full go to a cold storage, oldest first, and come back when asked for.

Rules: a piece never changes once it is full. What has no room in the storage stays in memory: nothing is dropped. The
storage is handed in, as the clock is: the core does not know that it is a file.
"""

import pickle
from collections import OrderedDict, deque
from typing import Generic, Protocol, TypeVar

Value = TypeVar("Value")

PAGE_BYTES = 65536
"""A value that is replaced is in pages, so that one takes the room of the one before."""
CACHED_PIECES_MAX = 16
"""Pieces that were asked for last are held: a request for old records takes several steps in one of them."""


class ColdStorage(Protocol):
    """Keeps pieces of bytes for as long as the robot lives."""

    def put(self, piece: bytes) -> int | None:
        """Keep a piece: its place, or None where there is no room."""
        ...

    def get(self, place: int, size_bytes: int) -> bytes:
        """Give back what was put at a place."""
        ...

    def free(self, place: int, size_bytes: int) -> None:
        """Let other pieces of this size be put to a place."""
        ...


class Cools(Protocol):
    """Something that is made of pieces."""

    def cool(self, number: int) -> None:
        """Move a piece out of memory."""
        ...


class ColdPieces:
    """The pieces of one kind that are in memory, and those that left it; other threads may read while one adds."""

    def __init__(self, storage: ColdStorage, pieces_held: int) -> None:
        """Hold so many full pieces."""
        self._storage = storage
        self._pieces_held = pieces_held
        self._warm: deque[tuple[Cools, int]] = deque()
        self._cached: OrderedDict[int, bytes] = OrderedDict()

    def add(self, owner: Cools, number: int) -> None:
        """A piece is full; the oldest one leaves memory where there are too many."""
        self._warm.append((owner, number))
        while len(self._warm) > self._pieces_held:
            oldest, of_oldest = self._warm.popleft()
            oldest.cool(of_oldest)

    def put(self, piece: bytes) -> int | None:
        """Keep a piece: its place, or None where there is no room."""
        return self._storage.put(piece)

    def get(self, place: int, size_bytes: int) -> bytes:
        """A piece that left memory."""
        piece = self._cached.pop(place, None)  # nobody else has it until it is back, as the newest
        if piece is None:
            piece = self._storage.get(place, size_bytes)
        self._cached[place] = piece
        if len(self._cached) > CACHED_PIECES_MAX:
            self._cached.popitem(last=False)
        return piece

    def size(self) -> tuple[int, int]:
        """Full pieces in memory, and at most."""
        return len(self._warm), self._pieces_held


class RowPieces:
    """Rows of so many bytes each, only ever more; old pieces of them leave memory where there is a cold storage.

    Attributes:
        is_cold: Whether some left it.
    """

    def __init__(self, row_bytes: int, rows_of_a_piece: int, cold: ColdPieces | None = None) -> None:
        """Start without rows."""
        self.is_cold = False
        self._row_bytes = row_bytes
        self._piece_bytes = row_bytes * rows_of_a_piece
        self._rows_of_a_piece = rows_of_a_piece
        self._cold = cold
        self._pieces: list[bytes | int] = []
        self._last = bytearray()

    def __len__(self) -> int:
        return len(self._pieces) * self._rows_of_a_piece + len(self._last) // self._row_bytes

    def append(self, row: bytes) -> None:
        """Add the next row."""
        self._last += row
        if len(self._last) == self._piece_bytes:
            self._pieces.append(bytes(self._last))
            self._last = bytearray()
            if self._cold is not None:
                self._cold.add(self, len(self._pieces) - 1)

    def row(self, index: int) -> bytes:
        """One of them."""
        number, k = divmod(index, self._rows_of_a_piece)
        at = slice(k * self._row_bytes, (k + 1) * self._row_bytes)
        return self._piece(number)[at] if number < len(self._pieces) else bytes(self._last[at])

    def all(self, first: int = 0) -> bytes:
        """All from one on, one after the other."""
        number, k = divmod(first, self._rows_of_a_piece)
        pieces = [self._piece(n) for n in range(number, len(self._pieces))]
        return b"".join([*pieces, bytes(self._last)])[k * self._row_bytes :]

    def cool(self, number: int) -> None:
        """Move a piece out of memory, where there is room for it elsewhere."""
        piece = self._pieces[number]
        if isinstance(piece, bytes) and self._cold is not None:
            place = self._cold.put(piece)
            if place is not None:
                self._pieces[number] = place
                self.is_cold = True

    def _piece(self, number: int) -> bytes:
        piece = self._pieces[number]
        if isinstance(piece, bytes):
            return piece
        assert self._cold is not None
        return self._cold.get(piece, self._piece_bytes)


class ColdValue(Generic[Value]):
    """One value of this process's own making that is replaced now and then, and out of memory until it is asked for.

    Where the storage has no room, it stays in memory.
    """

    def __init__(self, storage: ColdStorage | None) -> None:
        """Start without one."""
        self._storage = storage
        self._places: list[int] = []
        self._value: Value | None = None

    def put(self, value: Value, is_large: bool) -> None:
        """Replace it; one that is not large stays in memory."""
        self._drop()
        if not is_large or self._storage is None:
            self._value = value
            return
        data = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
        for first in range(0, len(data), PAGE_BYTES):
            place = self._storage.put(data[first : first + PAGE_BYTES].ljust(PAGE_BYTES, b"\0"))
            if place is None:
                self._drop()
                self._value = value
                return
            self._places.append(place)

    def get(self) -> Value | None:
        """What was put last; None before that."""
        if self._storage is None or not self._places:
            return self._value
        found: Value = pickle.loads(b"".join(self._storage.get(place, PAGE_BYTES) for place in self._places))
        return found

    def _drop(self) -> None:
        if self._storage is not None:
            for place in self._places:
                self._storage.free(place, PAGE_BYTES)
        self._places, self._value = [], None
