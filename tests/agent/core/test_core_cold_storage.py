"""Pieces that left memory come back, also where several threads ask at once (reports are written beside the loop)."""

import random
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.cold_storage import CACHED_PIECES_MAX, PAGE_BYTES, ColdPieces, ColdValue, RowPieces
from flocc_agent.runtime.page_file import PageFile


class _Pieces:
    """A storage in memory, where the place of a piece is its number."""

    def __init__(self, pieces_max: int = 10**6) -> None:
        self.pieces: list[bytes] = []
        self.pieces_max = pieces_max

    def put(self, piece: bytes) -> int | None:
        if len(self.pieces) == self.pieces_max:
            return None
        self.pieces.append(piece)
        return len(self.pieces) - 1

    def get(self, place: int, size_bytes: int) -> bytes:
        return self.pieces[place][:size_bytes]

    def free(self, place: int, size_bytes: int) -> None:
        raise AssertionError((place, size_bytes))


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


def test_rows_are_the_same_wherever_they_are() -> None:
    cold = RowPieces(3, 4, ColdPieces(_Pieces(pieces_max=5), 2))
    warm = RowPieces(3, 4)
    for k in range(50):
        for rows in (cold, warm):
            rows.append(bytes([k, 0, k]))
    assert len(cold) == len(warm) == 50
    assert (cold.is_cold, warm.is_cold) == (True, False)
    for first in (0, 3, 4, 21, 47, 50):
        assert cold.all(first) == warm.all(first) == b"".join(bytes([k, 0, k]) for k in range(first, 50))
    assert [cold.row(k) for k in range(50)] == [bytes([k, 0, k]) for k in range(50)]


def test_a_value_that_is_replaced_takes_the_room_of_the_one_before() -> None:
    pages = PageFile()
    held: ColdValue[list[bytes]] = ColdValue(pages)
    assert held.get() is None
    sizes = []
    for k in range(6):
        held.put([bytes([k]) * 2 * PAGE_BYTES], is_large=True)
        assert held.get() == [bytes([k]) * 2 * PAGE_BYTES]
        sizes.append(pages.size_bytes)
    assert sizes == [3 * PAGE_BYTES] * 6
    held.put([b"small"], is_large=False)
    assert held.get() == [b"small"]
    pages.close()


def test_a_value_without_room_stays_in_memory() -> None:
    class Small(_Pieces):
        def free(self, place: int, size_bytes: int) -> None:
            assert size_bytes == PAGE_BYTES
            self.pieces_max += 1

    value = np.arange(PAGE_BYTES)
    for storage in (None, Small(pieces_max=2)):
        held: ColdValue[NDArray[np.int64]] = ColdValue(storage)
        held.put(value, is_large=True)
        assert held.get() is value
