"""All closures that a robot knows: one of each pair, those of a log, and the graph's.

Every robot takes in every closure, and it is looked at now and then: what a closure says is a row of bytes, of which
old ones leave memory; 12 bytes of its pair and 12 for each of its ends remain. Who leads looks at all of them in each
round, and keeps as many as it built.
"""

import math
from array import array
from bisect import bisect_left, insort
from collections.abc import Callable, Iterable, Sequence, Set
from struct import Struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.cold_storage import ColdPieces, RowPieces
from flocc_agent.core.known_sets import pair_number, pair_of, place_of
from flocc_agent.core.parameters import KEYFRAMES_HELD
from flocc_agent.core.pose_graph import LoopClosure
from flocc_agent.geometry import inverse, poses_from_tq, symmetric
from flocc_protocol.arrays import Array
from flocc_protocol.ids import INDEX_MAX, KeyframeId, LogId
from flocc_protocol.messages import CandidatePair
from flocc_protocol.records import UPPER_TRIANGLE, ClosureRecord

Float = NDArray[np.float64]
Rows = NDArray[np.void]

ROWS_OF_A_PIECE = 64
"""Closures that leave memory together: some 12 kB."""
ROW = np.dtype(
    [
        ("query_log", "<u4"),
        ("query", "<u4"),
        ("match_log", "<u4"),
        ("match", "<u4"),
        ("log", "<u4"),
        ("number", "<u4"),
        ("has_scale", "<u4"),
        ("has_covariance", "<u4"),
        ("T", "<f8", 7),
        ("match_ratio", "<f8"),
        ("scale", "<f8"),
        ("covariance", "<f4", UPPER_TRIANGLE),
    ]
)
"""Both keyframes, by the numbers of their logs here; log and number of the record; what it says, with the covariance in
float32 as on the wire."""
PACKED = Struct("<8I7ddd")
"""What comes before the covariance."""
WHERE = Struct("<8I3d")
"""Of a row: what comes before the rotation."""
SCALE_AT = ROW.fields["scale"][1] if ROW.fields is not None else 0
ROWS_MAX = 2**32
"""More than there can be: rows are numbered with four bytes."""
LENGTH_MIN = 1e-9
Rank = Callable[[LogId, int, CandidatePair], int]
Counts = Callable[[LogId, int, CandidatePair], bool]
NO_COVARIANCE = bytes(4 * UPPER_TRIANGLE)
FLOAT32_MAX = float(np.finfo(np.float32).max)


class Tie(NamedTuple):
    """One closure of a log: its keyframe there, the other end, and how long its translation is, metres or 0."""

    near: int
    far: KeyframeId
    length_m: float


class End(NamedTuple):
    """One end of a closure that has a length: its keyframe in a stretch, the other end, and its row in the table."""

    near: int
    far: KeyframeId
    row: int


def length_m(closure: ClosureRecord) -> float:
    """How far apart its cameras are; 0 without a scale."""
    x, y, z = closure.T_query_match_unscaled[:3]
    return (closure.scale_initial or 0.0) * math.hypot(x, y, z)


def tie_of(log: LogId, query: KeyframeId, match: KeyframeId, length_m: float) -> Tie:
    """A closure as one of its logs sees it."""
    return Tie(query.index, match, length_m) if query.log == log else Tie(match.index, query, length_m)


class ClosureTable:
    """Closures by their pairs and by their logs."""

    def __init__(
        self, cold: ColdPieces | None = None, built_max: int = KEYFRAMES_HELD, rank: Rank = lambda _log, _n, _pair: 0
    ) -> None:
        """Start with none.

        Args:
            cold: Where old rows go; None: they stay in memory.
            built_max: Closures of the graph that are kept from one look at it to the next.
            rank: Of the record that says a closure, its log and number: the highest of a pair counts.
        """
        self._rank = rank
        self._built_max = built_max
        self._built: dict[int, LoopClosure] = {}
        """By their rows, which say the same for ever."""
        self._logs: list[LogId] = []
        self._numbers: dict[LogId, int] = {}
        self._rows = RowPieces(ROW.itemsize, ROWS_OF_A_PIECE, cold)
        self._of_pair: dict[tuple[LogId, LogId], tuple[array[int], array[int]]] = {}
        """Numbers of the pairs of two logs, and their rows."""
        self._of_log: dict[LogId, array[int]] = {}
        """Rows of a log, in the order in which they became known."""
        self._ends: dict[LogId, array[int]] = {}
        """Closures at the keyframes of a log: keyframe and row as one number, in their order."""
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return {"built_closures": (len(self._built), self._built_max)}

    def add(self, log: LogId, number: int, closure: ClosureRecord) -> bool:
        """Take in the closure of a log's record; False where another registration of its pair counts.

        Of several registrations of one pair the one in the lowest log counts, on every robot, of those that knew most
        of withdrawn keyframes.
        """
        pair = CandidatePair.of(closure.query, closure.match)
        key = (pair.low.log, pair.high.log)
        of_pair = self._of_pair.get(key)
        if of_pair is None:
            of_pair = self._of_pair[key] = array("Q"), array("I")
        numbers, rows = of_pair
        packed, row = pair_number(pair), len(self._rows)
        logs = key if key[0] != key[1] else key[:1]
        at, is_there = place_of(numbers, packed)
        if is_there:
            held = rows[at]
            if self._order(log, number, pair) >= self._order(*self._registered(held), pair):
                return False
            for each in logs:
                self._of_log[each].remove(held)
            self._take_ends(pair, held)
            self._built.pop(held, None)
            rows[at] = row
        else:
            numbers.insert(at, packed)
            rows.insert(at, row)
            self._count += 1
        self._put_ends(pair, row)
        for each in logs:
            of_log = self._of_log.get(each)
            if of_log is None:
                of_log = self._of_log[each] = array("I")
            of_log.append(row)
        self._rows.append(self._packed(log, number, closure))
        return True

    def take_out(self, log: LogId, first: int, end: int, counts: Counts) -> list[CandidatePair]:
        """Closures of a stretch of a log whose records count no more leave; their pairs."""
        of_log = [logs for logs in self._of_pair if log in logs]
        gone = [pair for logs in of_log for pair in self._of_stretch(logs, log, first, end)]
        gone = [pair for pair in gone if not counts(*self._registered(self._row(pair)), pair)]
        for pair in gone:
            self._remove(pair)
        return sorted(gone)

    def _of_stretch(self, logs: tuple[LogId, LogId], log: LogId, first: int, end: int) -> list[CandidatePair]:
        numbers, _ = self._of_pair[logs]
        pairs = (pair_of(logs, number) for number in numbers)
        ends = ((pair, (pair.low, pair.high)) for pair in pairs)
        return [pair for pair, both in ends if any(k.log == log and first <= k.index < end for k in both)]

    def _remove(self, pair: CandidatePair) -> None:
        logs = pair.low.log, pair.high.log
        numbers, rows = self._of_pair[logs]
        at, _ = place_of(numbers, pair_number(pair))
        row = rows.pop(at)
        del numbers[at]
        if not numbers:
            del self._of_pair[logs]
        for each in set(logs):
            self._of_log[each].remove(row)
        self._built.pop(row, None)
        self._count -= 1
        self._take_ends(pair, row)

    def _order(self, log: LogId, number: int, pair: CandidatePair) -> tuple[int, LogId, int]:
        return -self._rank(log, number, pair), log, number

    def ties(self, log: LogId, ties_max: int) -> Sequence[Tie]:
        """The newest ones of a log, the newest first."""
        rows = self._of_log.get(log)
        return [] if rows is None else [self._tie(log, row) for row in rows[-ties_max:][::-1]]

    def ends(self, log: LogId, first: int, end: int) -> int:
        """Closures at keyframes of a log, from one to before another, whatever log is at their other end."""
        of_log = self._ends.get(log)
        return 0 if of_log is None else bisect_left(of_log, end * ROWS_MAX) - bisect_left(of_log, first * ROWS_MAX)

    def mark(self, log: LogId, first: int, end: int) -> int:
        """A number of the same closures that is another one when one comes, leaves or is registered anew."""
        of_log = self._ends.get(log)
        if of_log is None:
            return 0
        return sum(of_log[bisect_left(of_log, first * ROWS_MAX) : bisect_left(of_log, end * ROWS_MAX)])

    def near(self, log: LogId, first: int, end: int) -> list[End]:
        """Those of them that have a length."""
        of_log = self._ends.get(log)
        if of_log is None:
            return []
        number, found = self._numbers[log], list[End]()
        for each in of_log[bisect_left(of_log, first * ROWS_MAX) : bisect_left(of_log, end * ROWS_MAX)]:
            near, row = divmod(each, ROWS_MAX)
            query_log, query, match_log, match, _, _, has_scale, _, *t = WHERE.unpack_from(self._rows.row(row))
            if has_scale and any(t):
                is_query = query_log == number and query == near
                far = KeyframeId(self._logs[match_log], match) if is_query else KeyframeId(self._logs[query_log], query)
                found.append(End(near, far, row))
        return found

    def seen(self, log: LogId, ends: Sequence[End]) -> Float:
        """What closures say of their other ends, T_near_far (K, 4, 4) metric."""
        rows = self._rows_of(end.row for end in ends)
        T, _ = _metric(rows)
        queries = zip(rows["query_log"].tolist(), rows["query"].tolist(), ends, strict=True)
        back = [(query_log, query) != (self._numbers[log], end.near) for query_log, query, end in queries]
        T[back] = inverse(T[back])
        return T

    def said(self, closures: Sequence[CandidatePair]) -> tuple[Float, NDArray[np.bool_]]:
        """What closures say, T_low_high (K, 4, 4), and whether in metres; else the translation is 1 long."""
        rows = self._rows_of(self._row(closure) for closure in closures)
        T, has_length = _metric(rows)
        queries = [KeyframeId(self._logs[row["query_log"]], int(row["query"])) for row in rows]
        back = [query != closure.low for query, closure in zip(queries, closures, strict=True)]
        T[back] = inverse(T[back])
        return T, has_length

    def of_logs(self, low: LogId, high: LogId) -> list[CandidatePair]:
        """Those between two logs, or within one, in the order of their pairs."""
        of_pair = self._of_pair.get((low, high))
        return [] if of_pair is None else [pair_of((low, high), number) for number in of_pair[0]]

    def _row(self, pair: CandidatePair) -> int:
        numbers, rows = self._of_pair[pair.low.log, pair.high.log]
        return rows[place_of(numbers, pair_number(pair))[0]]

    def _rows_of(self, numbers: Iterable[int]) -> Rows:
        return np.frombuffer(b"".join(self._rows.row(number) for number in numbers), dtype=ROW)

    def _put_ends(self, pair: CandidatePair, row: int) -> None:
        for keyframe in (pair.low, pair.high):
            of_log = self._ends.get(keyframe.log)
            if of_log is None:
                of_log = self._ends[keyframe.log] = array("Q")
            insort(of_log, keyframe.index * ROWS_MAX + row)

    def _take_ends(self, pair: CandidatePair, row: int) -> None:
        for keyframe in (pair.low, pair.high):
            of_log = self._ends[keyframe.log]
            del of_log[bisect_left(of_log, keyframe.index * ROWS_MAX + row)]

    def links(self) -> list[tuple[LogId, LogId]]:
        """Pairs of logs with closures between them, or within one."""
        return sorted(self._of_pair)

    def logs_count(self) -> int:
        """How many logs there are that closures were ever of, or stood in."""
        return len(self._logs)

    def logs(self) -> set[LogId]:
        """Logs that closures are of, or stand in."""
        return set(self._logs)

    def closures(self, counts: Callable[[LogId], int], unread: Set[KeyframeId]) -> list[LoopClosure]:
        """Those of which both keyframes are known, in the order of their pairs.

        Args:
            counts: From which number on no keyframe of a log is known.
            unread: Keyframes before that of which nothing is known.
        """
        chosen = self._in_order(counts)
        if not len(chosen):
            return []
        numbers = chosen.tolist()
        new = [row for row in numbers if row not in self._built]
        others: dict[int, LoopClosure] = {}
        if new:
            rows = np.frombuffer(self._rows.all(), dtype=ROW)
            room = max(self._built_max - len(self._built), 0)
            self._built.update(zip(new[:room], self._build(rows[new[:room]]), strict=True))
            others.update(zip(new[room:], self._build(rows[new[room:]]), strict=True))
        found = [self._built.get(row) or others[row] for row in numbers]
        return [c for c in found if c.query not in unread and c.match not in unread] if unread else found

    def forget_built(self) -> None:
        """Nobody asks for the graph's closures for now: they are built anew when somebody does."""
        self._built.clear()

    def _in_order(self, counts: Callable[[LogId], int]) -> NDArray[np.intp]:
        """Rows of pairs whose keyframes are below the counts of their logs, in the order of the pairs."""
        columns: list[tuple[NDArray[np.int64], ...]] = []
        rank = {log: k for k, log in enumerate(sorted(self._logs))}
        for (low, high), (numbers, rows) in self._of_pair.items():
            packed = np.array(numbers, dtype=np.int64)
            lows, highs = packed // (INDEX_MAX + 1), packed % (INDEX_MAX + 1)
            near = (lows < counts(low)) & (highs < counts(high))
            shape = int(np.count_nonzero(near))
            logs = (np.full(shape, rank[low]), np.full(shape, rank[high]))
            columns.append((logs[0], lows[near], logs[1], highs[near], np.array(rows, dtype=np.int64)[near]))
        if not columns:
            return np.empty(0, dtype=np.intp)
        low_logs, lows, high_logs, highs, rows_of_all = map(np.concatenate, zip(*columns, strict=True))
        return np.asarray(rows_of_all[np.lexsort((highs, high_logs, lows, low_logs))], dtype=np.intp)

    def _build(self, rows: Rows) -> Iterable[LoopClosure]:
        poses, covariances = poses_from_tq(rows["T"]), symmetric(rows["covariance"])
        columns = (rows[name].tolist() for name in ("query_log", "query", "match_log", "match", "match_ratio"))
        scales, has_scale, has = (rows[name].tolist() for name in ("scale", "has_scale", "has_covariance"))
        for k, (query_log, query, match_log, match, ratio) in enumerate(zip(*columns, strict=True)):
            yield LoopClosure(
                query=KeyframeId(self._logs[query_log], query),
                match=KeyframeId(self._logs[match_log], match),
                T_query_match_unscaled=poses[k],
                match_ratio=ratio,
                scale_initial=scales[k] if has_scale[k] else None,
                covariance=covariances[k] if has[k] else None,
            )

    def _packed(self, log: LogId, number: int, closure: ClosureRecord) -> bytes:
        (query_log, query), (match_log, match) = closure.query, closure.match
        triangle, scale = closure.covariance, closure.scale_initial
        said = PACKED.pack(
            self._number(query_log),
            query,
            self._number(match_log),
            match,
            self._number(log),
            number,
            scale is not None,
            triangle is not None,
            *closure.T_query_match_unscaled,
            closure.match_ratio,
            scale or 0.0,
        )
        return said + (NO_COVARIANCE if triangle is None else _float32(triangle))

    def _registered(self, row: int) -> tuple[LogId, int]:
        """Log and number of the record of a row."""
        log, number = WHERE.unpack_from(self._rows.row(row))[4:6]
        return self._logs[log], number

    def _tie(self, log: LogId, row: int) -> Tie:
        data = self._rows.row(row)
        query_log, query, match_log, match, _, _, _, _, *t = WHERE.unpack_from(data)
        (scale,) = Struct("<d").unpack_from(data, SCALE_AT)
        ends = KeyframeId(self._logs[query_log], query), KeyframeId(self._logs[match_log], match)
        return tie_of(log, *ends, scale * math.hypot(*t))

    def _number(self, log: LogId) -> int:
        number = self._numbers.get(log)
        if number is None:
            number = self._numbers[log] = len(self._logs)
            self._logs.append(log)
        return number


def _float32(values: Array) -> bytes:
    """Values in float32, as nearly all come; another robot may send wider ones."""
    if values.dtype == "f4":
        return values.data
    return np.clip(values.numpy(), -FLOAT32_MAX, FLOAT32_MAX).astype("<f4").tobytes()


def _metric(rows: Rows) -> tuple[Float, NDArray[np.bool_]]:
    """What closures say, T_query_match (K, 4, 4), and whether in metres; else the translation is 1 long."""
    T = poses_from_tq(rows["T"])
    lengths = np.linalg.norm(T[:, :3, 3], axis=1)
    has_length = (rows["has_scale"] > 0) & (rows["scale"] * lengths > 0.0)
    T[:, :3, 3] *= np.where(has_length, rows["scale"], 1.0 / np.maximum(lengths, LENGTH_MIN))[:, None]
    return T, has_length
