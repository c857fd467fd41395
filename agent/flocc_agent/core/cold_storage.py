"""What is old leaves memory: pieces that are full go to a cold storage, oldest first, and come back when asked for.

Rules: a piece never changes once it is full. What has no room in the storage stays in memory: nothing is dropped. The
storage is handed in, as the clock is: the core does not know that it is a file.
"""

from collections import OrderedDict, deque
from typing import Protocol

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
