"""Descriptors of places as rows of matrices: compared in batches, old ones thinned, some lent by who else holds them.

Descriptors are compared as they came: int8 rows with one number each that makes them of unit length. Products of such
rows are whole numbers that a float32 holds exactly up to 1,040 numbers, so a similarity is the same whether it is found
alone or in a batch.

Of old keyframes the fewest stay that stand for all: one whose place another one of its log shows, is left out, whether
that was a moment before or on an earlier visit. What a log has of one place does not grow with how often it is there.
"""

import math
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flocc_protocol.arrays import Array

Floats = NDArray[np.float32]
Places = NDArray[np.intp]

NOTHING = -2.0
"""Similarity with a log of which no row is here: below every threshold."""
CAPACITY_FIRST = 64
DESCRIPTORS_MAX = 1024
THINNED_AT_ONCE = 64
"""Old rows that are looked through at one time."""
SAME_PLACE_SIMILARITY = 0.9
"""An old keyframe with a more similar one in its log is represented by that one."""
SAME_PLACE_STEP = 0.05
"""Where the representatives are too many, less similar ones stand for each other."""
ROWS_AT_ONCE = 256
"""int8 rows that are compared at one time: as floats they stay in a processor's cache."""


class Descriptor(NamedTuple):
    """A place descriptor: a row (D,) of int8 or float32, and what makes it of unit length."""

    row: NDArray[Any]
    inverse_norm: float


@dataclass(frozen=True, slots=True)
class _Lent:
    """Descriptors of one log that somebody else holds, as rows (K, D) of int8."""

    log: int
    rows: NDArray[np.int8]


class DescriptorRows:
    """Descriptors of one length of one or more logs: the rows of one growing matrix, and before them lent ones.

    A row that goes is replaced by the last one, so a log's rows lie anywhere.

    Attributes:
        dimension: D.
    """

    def __init__(self, dimension: int, dtype: type[np.int8 | np.float32]) -> None:
        self.dimension = dimension
        self._count = 0
        self._lent: list[_Lent] = []
        self._lent_ends = [0]
        self._rows: NDArray[Any] = np.empty((CAPACITY_FIRST, dimension), dtype=dtype)
        self._inverse_norms = np.empty(CAPACITY_FIRST, dtype=np.float32)
        self._logs = np.empty(CAPACITY_FIRST, dtype=np.int32)
        self._indices = np.empty(CAPACITY_FIRST, dtype=np.int32)
        self._nearest = np.empty(CAPACITY_FIRST, dtype=np.float32)
        """Of rows that stand for older ones: no earlier one that stands is more similar."""
        self._by_log: dict[int, array[int]] = {}
        self._standing: dict[int, int] = {}
        """How many of a log's rows, its first ones, stand for older ones."""
        self._unthinned: dict[int, int] = {}
        self._same_place: dict[int, float] = {}

    def __len__(self) -> int:
        return self._count

    @property
    def numbers(self) -> list[int]:
        """Of each log that has rows."""
        return list(self._unthinned)

    @property
    def logs(self) -> NDArray[np.int32]:
        """Number (N,) of each row's log."""
        return self._logs[: self._count]

    @property
    def indices(self) -> NDArray[np.int32]:
        """Keyframe (N,) of each row in its log."""
        return self._indices[: self._count]

    @property
    def _first(self) -> int:
        """Which is the first row of the matrix."""
        return self._lent_ends[-1]

    def append(self, log: int, index: int, descriptor: Descriptor) -> None:
        """Add a row; the first one that is no int8 makes all of them float32."""
        if self._rows.dtype != descriptor.row.dtype and self._rows.dtype == np.int8:
            self._rows = self._rows.astype(np.float32)
        place = self._count - self._first
        if place == len(self._rows) or self._count == len(self._logs):
            self._make_room(1)
        self._rows[place] = descriptor.row
        self._inverse_norms[self._count] = descriptor.inverse_norm
        self._logs[self._count] = log
        self._indices[self._count] = index
        if log in self._by_log:
            self._by_log[log].append(self._count)
        self._count += 1
        self._unthinned[log] = self._unthinned.get(log, 0) + 1

    def _make_room(self, more: int) -> None:
        """Let so many rows follow in the matrix."""
        held = self._count - self._first
        if held + more > len(self._rows):
            size = max(held + more, len(self._rows) + max(CAPACITY_FIRST, held // 4))
            rows = np.empty((size, self.dimension), dtype=self._rows.dtype)
            rows[:held] = self._rows[:held]
            self._rows = rows
        if self._count + more > len(self._logs):
            size = self._count + max(CAPACITY_FIRST, self._count // 4, more)
            self._inverse_norms = np.resize(self._inverse_norms, size)
            self._logs = np.resize(self._logs, size)
            self._indices = np.resize(self._indices, size)
            self._nearest = np.resize(self._nearest, size)

    # Rows that somebody else holds

    def lend(self, log: int, indices: Sequence[int], rows: NDArray[np.int8]) -> None:
        """Read newer descriptors of a log where somebody else holds them, if these are the same, and hold none."""
        held = self._rows_of(log)
        at = bisect_left(held, indices[0], key=self._indices.item)
        own = np.array(held[at : at + len(indices)], dtype=np.intp)
        if self._rows.dtype != np.int8 or len(own) != len(indices):
            return
        if at < self._standing.get(log, 0) or own.min() < self._first:
            return
        if self._indices[own].tolist() != list(indices) or not np.array_equal(self._rows[own - self._first], rows):
            return
        left = self._count - len(own)
        order, holes = np.arange(self._first, left), np.sort(own[own < left])
        order[holes - self._first] = np.setdiff1d(np.arange(left, self._count), own, assume_unique=True)
        self._rows[holes - self._first] = self._rows[order[holes - self._first] - self._first]
        size = len(order) + max(CAPACITY_FIRST, len(order) // 4)
        if len(self._rows) > size:
            self._rows = self._rows[:size].copy()
        self._order_columns(self._first, np.concatenate([own, order]))
        self._lent.append(_Lent(log, rows))
        self._lent_ends.append(self._first + len(rows))

    def _take_back(self, log: int) -> None:
        """Hold the oldest rows of a log here again, as many as are looked through at one time."""
        standing = self._standing.get(log, 0)
        while (lowest := self.places(log)[standing : standing + THINNED_AT_ONCE].min()) < self._first:
            self._take_back_lent(bisect_right(self._lent_ends, lowest) - 1)

    def _take_back_lent(self, number: int) -> None:
        """Hold what was lent as the so manieth here again."""
        first, end = self._lent_ends[number], self._lent_ends[number + 1]
        self._make_room(end - first)
        held = self._count - self._first
        self._rows[held : held + end - first] = self._lent.pop(number).rows
        self._lent_ends = list(accumulate((len(each.rows) for each in self._lent), initial=0))
        self._order_columns(first, np.concatenate([np.arange(end, self._count), np.arange(first, end)]))

    # Old rows

    def forget(self, log: int) -> None:
        """Hold no row of a log any more."""
        for number in reversed(range(len(self._lent))):
            if self._lent[number].log == log:
                self._take_back_lent(number)
        self._standing.setdefault(log, 0)
        self._leave_out(log, self.places(log))
        for table in (self._by_log, self._standing, self._unthinned, self._same_place):
            table.pop(log, None)

    def thin(self, log: int, held: int) -> None:
        """Keep a log's newest so many rows whole, and at most so many that stand for its older ones.

        A log is looked through in blocks of its own rows, and no other one's decide, so that robots which hold it find
        the same ones to stay: they ask for the same pairs then, instead of each for its own.
        """
        while self._unthinned[log] >= held + THINNED_AT_ONCE:
            self._take_back(log)
            first = self._standing.setdefault(log, 0)
            bound = self._same_place.setdefault(log, SAME_PLACE_SIMILARITY)
            places = self.places(log)
            self._standing[log] += THINNED_AT_ONCE
            self._unthinned[log] -= THINNED_AT_ONCE
            self._leave_out(log, self._represented(places[first : first + THINNED_AT_ONCE], places[:first], bound))
            while self._standing[log] > held and self._same_place[log] > -1.0:
                self._thin_again(log, held)

    def _thin_again(self, log: int, held: int) -> None:
        """Look through a log's rows that stand for others with a lower bound, where that may make few enough."""
        self._same_place[log] -= SAME_PLACE_STEP
        bound, standing = self._same_place[log], self.places(log)[: self._standing[log]]
        is_alone = self._nearest[standing] < bound
        if np.count_nonzero(is_alone) > held:
            return
        stay, near, gone = standing[is_alone], standing[~is_alone], []
        for first in range(0, len(near), THINNED_AT_ONCE):
            block = near[first : first + THINNED_AT_ONCE]
            gone.append(self._represented(block, stay, bound))
            stay = np.concatenate([stay, np.setdiff1d(block, gone[-1], assume_unique=True)])
        self._leave_out(log, np.concatenate(gone))

    def places(self, log: int) -> Places:
        """Places of a log's rows, in the order of its keyframes."""
        return np.array(self._rows_of(log), dtype=np.intp)

    def _represented(self, block: Places, others: Places, bound: float) -> Places:
        """Which rows of a block others of their log stand for, or one before them in the block that stays."""
        rows, nearest = self._units(block), np.full(len(block), NOTHING, dtype=np.float32)
        for first in range(0, len(others), ROWS_AT_ONCE):
            similarities = rows @ self._units(others[first : first + ROWS_AT_ONCE]).T
            np.maximum(nearest, similarities.max(axis=1), out=nearest)
        among, stays = rows @ rows.T, nearest < bound
        for k in np.flatnonzero(stays).tolist():
            before = among[k, :k][stays[:k]]
            nearest[k] = max(nearest[k], before.max(initial=NOTHING))
            stays[k] = nearest[k] < bound
        self._nearest[block] = nearest
        return block[~stays]

    def _leave_out(self, log: int, gone: Places) -> None:
        """Take away rows of a log that others stand for."""
        places = self.places(log)
        self._by_log[log] = array("i", places[~np.isin(places, gone)].tolist())
        self._standing[log] -= len(gone)
        for place in np.sort(gone)[::-1].tolist():
            self._count -= 1
            if place != self._count:
                self._move(self._count, place)

    def _move(self, place: int, to: int) -> None:
        """Put a row where one is no longer needed."""
        self._rows[to - self._first] = self._rows[place - self._first]
        for values in (self._inverse_norms, self._logs, self._indices, self._nearest):
            values[to] = values[place]
        of_log = self._by_log.get(int(self._logs[to]))
        if of_log is not None:
            of_log[bisect_left(of_log, int(self._indices[to]), key=self._indices.item)] = to

    def _order_columns(self, first: int, order: Places) -> None:
        """Put what is known of these rows after that of the first so many."""
        self._by_log.clear()
        for values in (self._inverse_norms, self._logs, self._indices, self._nearest):
            values[first : first + len(order)] = values[order]
        self._count = first + len(order)

    def _units(self, places: Places) -> Floats:
        """Rows (K, D) of unit length."""
        if places.min(initial=self._first) >= self._first:
            rows = self._rows[places - self._first].astype(np.float32)
        else:
            rows = np.array([self._row(place) for place in places.tolist()], dtype=np.float32)
        return np.asarray(rows * self._inverse_norms[places, None])

    def _row(self, place: int) -> NDArray[Any]:
        if place >= self._first:
            return np.asarray(self._rows[place - self._first])
        number = bisect_right(self._lent_ends, place) - 1
        return np.asarray(self._lent[number].rows[place - self._lent_ends[number]])

    # Comparing

    def similarities(self, descriptors: Sequence[Descriptor]) -> Floats:
        """Cosine similarities (B, N) of B descriptors with all rows."""
        queries = np.array([each.row for each in descriptors], dtype=np.float32)
        found = self._products(queries)
        found *= self._inverse_norms[: self._count]
        if len(descriptors) == 1:
            found *= np.float32(descriptors[0].inverse_norm)
        else:
            found *= np.array([[each.inverse_norm] for each in descriptors], dtype=np.float32)
        return found

    def around(self, log: int, index: int, reach: int) -> tuple[Floats, int] | None:
        """Unit descriptors (K, D) of a log's keyframes up to `reach` from one, and which is its; None without it."""
        rows = self._rows_of(log)
        first = bisect_left(rows, index - reach, key=self._indices.item)
        near = rows[first : first + 2 * reach + 1]
        indices = self._indices[near].tolist()
        if index not in indices:
            return None
        near = near[: bisect_right(indices, index + reach)]
        return self._units(np.array(near, dtype=np.intp)), indices.index(index)

    def _rows_of(self, log: int) -> "array[int]":
        """Rows of a log, in the order of its keyframes."""
        rows = self._by_log.get(log)
        if rows is None:
            places = np.flatnonzero(self.logs == log)
            in_order = places[np.argsort(self._indices[places], kind="stable")]
            rows = self._by_log[log] = array("i", in_order.tolist())
        return rows

    def _products(self, queries: Floats) -> Floats:
        """Products (B, N) of queries (B, D) with all rows."""
        if not self._lent and self._rows.dtype == np.float32:
            return np.asarray(queries @ self._rows[: self._count].T)
        products = np.empty((len(queries), self._count), dtype=np.float32)
        floats = np.empty((ROWS_AT_ONCE, self.dimension), dtype=np.float32)
        at = 0
        for rows in self._pieces():
            part = floats[: sum(map(len, rows))]
            np.concatenate(rows, out=part, casting="same_kind")
            products[:, at : at + len(part)] = queries @ part.T
            at += len(part)
        return products

    def _pieces(self) -> Iterator[list[NDArray[Any]]]:
        """All rows in their order, at most so many at one time as are compared together."""
        together: list[NDArray[Any]] = []
        room = ROWS_AT_ONCE
        held = self._rows[: self._count - self._first]
        own = (held[k : k + ROWS_AT_ONCE] for k in range(0, len(held), ROWS_AT_ONCE))
        for rows in chain((lent.rows for lent in self._lent), own):
            if len(rows) > room:
                yield together
                together, room = [], ROWS_AT_ONCE
            together.append(rows)
            room -= len(rows)
        if together:
            yield together


@lru_cache(maxsize=DESCRIPTORS_MAX)
def comparable(place: Array) -> Descriptor | None:
    """A descriptor (D,) to compare, or None where it has no direction; found once for all robots of a process."""
    values = place.numpy()
    norm = math.sqrt(float(values.dot(values)))
    if not math.isfinite(norm) or norm < 1e-12:
        return None
    if place.dtype == "i1":
        row: NDArray[Any] = np.frombuffer(place.data, dtype=np.int8)
        return Descriptor(row, place.scale / norm)
    unit = np.asarray(values / norm, dtype=np.float32)
    unit.flags.writeable = False
    return Descriptor(unit, 1.0)


def direction(place: Array) -> Floats | None:
    """A descriptor (D,) of unit length, or None where it has no direction."""
    descriptor = comparable(place)
    return None if descriptor is None else np.asarray(descriptor.row * np.float32(descriptor.inverse_norm))
