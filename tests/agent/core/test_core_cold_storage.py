"""Pieces that left memory come back, also where several threads ask at once (reports are written beside the loop)."""

import random
import sys
from concurrent.futures import ThreadPoolExecutor

from flocc_agent.core.cold_storage import CACHED_PIECES_MAX, ColdPieces


class _Pieces:
    """A storage in memory, where the place of a piece is its number."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []

    def put(self, piece: bytes) -> int:
        self.pieces.append(piece)
        return len(self.pieces) - 1

    def get(self, place: int, size_bytes: int) -> bytes:
        return self.pieces[place][:size_bytes]


def test_threads_read_side_by_side() -> None:
    cold = ColdPieces(_Pieces(), 0)
    places = [cold.put(bytes([k]) * 8) for k in range(CACHED_PIECES_MAX + 1)]

    def read(start: int) -> bool:
        asked = random.Random(start).choices(places, k=40_000)
        return all(place is not None and cold.get(place, 8) == bytes([place]) * 8 for place in asked)

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            assert all(pool.map(read, range(4)))
    finally:
        sys.setswitchinterval(before)
