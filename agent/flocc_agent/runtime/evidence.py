"""What one robot can tell an operator who asks why maps have not merged: made on demand, from what its logs hold."""

from collections.abc import Iterator
from dataclasses import dataclass

from flocc_agent.core.parameters import CoreParameters
from flocc_agent.core.pose_graph import ClosureState, GraphSolution
from flocc_agent.core.registration import match_ratio
from flocc_agent.core.robot import Robot
from flocc_agent.runtime.reporting import best_similarities, counted
from flocc_agent.runtime.status import MergeStatus, PairStatus, SolverStatus
from flocc_protocol.records import ClosureRecord, RejectionRecord

PAIRS_MAX = 64
"""Pairs of robots that an answer tells of; of more, those with the fewest closures."""


@dataclass(slots=True)
class PairEvidence:
    """What came of the pairs of keyframes of two robots so far; see `PairStatus`."""

    accepted: int = 0
    rejected: int = 0
    best_ratio: float | None = None
    reason: str | None = None

    def reject(self, record: RejectionRecord) -> None:
        """Count a refused pair."""
        ratio = match_ratio(record.correspondences, record.odometry_correspondences)
        self.rejected += 1
        if self.best_ratio is None or ratio > self.best_ratio:
            self.best_ratio, self.reason = ratio, record.reason

    def status(self, robots: tuple[str, str]) -> PairStatus:
        """All of it, for an answer."""
        best = None if self.best_ratio is None else round(self.best_ratio, 4)
        return PairStatus(
            robots=robots, accepted=self.accepted, rejected=self.rejected, best_ratio=best, reason=self.reason
        )


def evidence_of(robot: Robot, parameters: CoreParameters, solver: SolverStatus | None) -> MergeStatus:
    """Similarities and thresholds, closures and refusals by pair of robots, and what the last own solution said."""
    found = sorted(pairs_of(robot).items(), key=lambda item: (item[1].accepted, item[0]))[:PAIRS_MAX]
    return MergeStatus(
        best_similarities=best_similarities(robot),
        similarity_threshold=parameters.place_recognition.similarity_threshold,
        match_ratio_threshold=parameters.loop_closing.match_ratio_threshold,
        pairs=[pair.status(robots) for robots, pair in found],
        solver=solver,
    )


def pairs_of(robot: Robot) -> dict[tuple[str, str], PairEvidence]:
    """Evidence by pair of robots, each pair of keyframes once."""
    found: dict[tuple[str, str], PairEvidence] = {}
    seen = set()
    for record in judgements(robot):
        ends = tuple(sorted((record.query, record.match)))
        if ends in seen:
            continue
        seen.add(ends)
        robots = (ends[0].log.robot, ends[1].log.robot)
        pair = found.setdefault((min(robots), max(robots)), PairEvidence())
        if isinstance(record, ClosureRecord):
            pair.accepted += 1
        else:
            pair.reject(record)
    return found


def judgements(robot: Robot) -> Iterator[ClosureRecord | RejectionRecord]:
    """Every judgement in all logs that counts, closures first: what anybody accepted is accepted."""
    records = list(counted(robot))
    yield from (record for record in records if isinstance(record, ClosureRecord))
    yield from (record for record in records if isinstance(record, RejectionRecord))


def solver_of(solution: GraphSolution) -> SolverStatus:
    """What the last solution of this robot used and warned of."""
    used = sum(closure.state is ClosureState.USED for closure in solution.closures)
    return SolverStatus(
        components=[sorted({log.robot for log in component.logs}) for component in solution.components],
        closures_used=used,
        closures_rejected=len(solution.closures) - used,
        warnings=list(solution.warnings[:8]),
    )
