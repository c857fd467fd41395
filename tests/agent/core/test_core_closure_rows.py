"""What a correction is held against: closures and measurements of its log, without those of others and unread."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.core import measured_records
from flocc_agent.core.assembly import GraphAssembly
from flocc_agent.core.closure_rows import Tie
from flocc_agent.core.factors import Tracks, factor_of
from flocc_agent.core.gossip import NewRecord
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import ClosureRecord, FixRecord, KeyframeRecord, Record, RobotSightingRecord

R1, R2, R3 = LogId("r1"), LogId("r2"), LogId("r3")
KEYFRAMES = 6


def at(log: LogId, index: int) -> KeyframeId:
    return KeyframeId(log, index)


def closure(one: KeyframeId, other: KeyframeId, length_unscaled: float, scale: float | None = 2.0) -> ClosureRecord:
    T = (0.0, length_unscaled, 0.0, 1.0, 0.0, 0.0, 0.0)
    return ClosureRecord(one, other, T, 60, 100, 0.6, scale)


class Known:
    """An assembly, and how long each log is."""

    def __init__(self) -> None:
        self.assembly = GraphAssembly()
        self._counts: dict[LogId, int] = {}
        for log in (R1, R2, R3):
            for k in range(KEYFRAMES):
                self.add(log, KeyframeRecord(k, float(k), (float(k), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), None))

    def add(self, log: LogId, record: Record) -> None:
        number = self._counts.get(log, 0)
        self._counts[log] = number + 1
        self.assembly.add(NewRecord(log, number, record))


def test_ties_are_a_logs_newest_closures() -> None:
    known = Known()
    for record in (
        closure(at(R1, 0), at(R2, 1), 1.0),
        closure(at(R3, 2), at(R2, 3), 1.0),
        closure(at(R1, 5), at(R1, 1), 3.0, None),
    ):
        known.add(R1, record)
    assert known.assembly.ties(R1, 10) == [Tie(5, at(R1, 1), 0.0), Tie(0, at(R2, 1), 2.0)]
    assert known.assembly.ties(R1, 1) == [Tie(5, at(R1, 1), 0.0)]
    assert known.assembly.ties(R2, 10) == [Tie(3, at(R3, 2), 2.0), Tie(1, at(R1, 0), 2.0)]
    assert known.assembly.ties(LogId("r9"), 10) == []
    assert known.assembly.joined(R1, R3)


def test_of_two_registrations_of_a_pair_one_is_a_tie() -> None:
    known = Known()
    known.add(R2, closure(at(R1, 0), at(R2, 1), 1.0))
    known.add(R1, closure(at(R2, 1), at(R1, 0), 4.0))
    known.add(R3, closure(at(R1, 0), at(R2, 1), 9.0))
    assert known.assembly.ties(R1, 10) == [Tie(0, at(R2, 1), 8.0)]
    assert known.assembly.ties(R2, 10) == [Tie(1, at(R1, 0), 8.0)]


@pytest.mark.parametrize(
    ("sent", "kept"),
    [
        (Array.of(np.linspace(-0.1, 3e-9, 21), "f4"), np.linspace(-0.1, 3e-9, 21, dtype=np.float32)),
        (Array.of(np.full(21, 1e300), "f8"), np.full(21, np.finfo(np.float32).max)),
        (Array.int8(np.linspace(-12.7, 12.7, 21)), Array.int8(np.linspace(-12.7, 12.7, 21)).numpy().astype(np.float32)),
        (None, None),
    ],
    ids=["as all robots send it", "beyond float32", "int8", "none"],
)
def test_a_covariance_is_kept_in_float32(sent: Array | None, kept: NDArray[np.float32] | None) -> None:
    known = Known()
    known.add(R1, replace(closure(at(R1, 0), at(R2, 1), 1.0), covariance=sent))
    (found,) = known.assembly.graph().closures
    assert (found.covariance is None) == (kept is None)
    if found.covariance is not None and kept is not None:
        assert found.covariance[np.triu_indices(6)].tolist() == kept.tolist()
        assert found.covariance.tolist() == found.covariance.T.tolist()


def test_measurements_of_other_logs_are_not_paid_for(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[tuple[LogId, type]] = []

    def counted(log: LogId, record: object, tracks: Tracks) -> object:
        made.append((log, type(record)))
        return factor_of(log, record, tracks)

    monkeypatch.setattr(measured_records, "factor_of", counted)
    known = Known()
    variance, covariance = Array.of(np.eye(3).ravel(), "f8"), Array.of(np.zeros(21), "f4")
    for log in (R1, R2, R3):
        known.add(log, FixRecord(1, Array.of(np.ones(3), "f8"), variance))
    T = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    known.add(R2, RobotSightingRecord(2, "r1", T, covariance))
    assert [factor.kind for factor in known.assembly.measured(R1)] == ["fix", "robot"]
    assert sorted(made) == [(R1, FixRecord), (R2, RobotSightingRecord)]
    assert len(known.assembly.measured(R1)) == 2
    assert len(made) == 2, "a factor is made once"
    assert len(known.assembly.graph().measured) == 4
    assert len(made) == 4
