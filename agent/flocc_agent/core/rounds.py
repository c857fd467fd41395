"""Optimisation rounds: the leader optimises what its logs hold; no robot is asked, none is waited for."""

from flocc_agent.core.assembly import GraphAssembly
from flocc_agent.core.cold_storage import ColdStorage, ColdValue
from flocc_agent.core.effects import Effect, Optimise, Report
from flocc_agent.core.parameters import KEYFRAMES_HELD, RoundParameters
from flocc_agent.core.pose_graph import ClosureState, GraphSolution
from flocc_agent.core.reports import RoundSolved, RoundTimedOut
from flocc_protocol.ids import Term

FAILURES_MAX = 6
TIMEOUT_S = 60.0
"""A round without a result by then is given up and the next one may start; each in a row gets twice the time."""
PERIOD_PER_KEYFRAME_S = 1e-3
"""Shortest time between two rounds for each keyframe of the swarm, where that is longer than the period: a large
correction costs everybody something."""
KEYFRAMES_PER_ROUND = 20
"""New keyframes that call for a round even without a new closure, so that a trajectory's end is corrected, too."""
PATIENCE_S = 5.0
"""Fewer new keyframes wait this long for a round: the last ones of a trajectory are corrected, too."""
HURRIED_PERIOD_S = 0.5
"""Least pause between rounds while groups meet."""
HURRY_MAX_S = 2.0
"""A meeting hurries rounds for one period, but no longer than this: a long period is somebody's wish to save work."""
GRAPH_KEPT_S = 30.0
"""So long a robot that leads no more keeps what it built of the graph, objects for each closure: it may lead again."""


class Rounds:
    """When a leader optimises, and what it makes of the answer."""

    def __init__(
        self,
        assembly: GraphAssembly,
        parameters: RoundParameters,
        cold: ColdStorage | None = None,
        keyframes_held: int = KEYFRAMES_HELD,
    ) -> None:
        """Start without a solution.

        Args:
            assembly: Gives the graph.
            parameters: When rounds are.
            cold: Where the last solution is between rounds, once it is large.
            keyframes_held: One of more keyframes is large.
        """
        self._keyframes_held = keyframes_held
        self._assembly = assembly
        self._parameters = parameters
        self._term: Term | None = None
        self._round = 0
        self._running_until_s: float | None = None
        self._started_s = float("-inf")
        self._next_s = float("-inf")
        self._hurried_until_s = float("-inf")
        self._started: tuple[int, int] | None = None
        self._failures = 0
        self._graph_kept_until_s: float | None = None
        self._solution: ColdValue[GraphSolution] = ColdValue(cold)

    @property
    def round(self) -> int:
        """Number of the current term's last round; 0 before the first."""
        return self._round

    def on_term(self, term: Term | None) -> None:
        """This robot leads in this term, or no longer leads (None); a new term starts with round 1."""
        if term != self._term:
            self._term = term
            self._round = 0
            self._running_until_s = None
            self._started = None

    def solution(self) -> GraphSolution | None:
        """The last solution that counted, also of an earlier term."""
        return self._solution.get()

    def hurry(self, now: float) -> None:
        """Groups meet, and news are to be expected: for one short period rounds may follow each other quickly."""
        self._hurried_until_s = now + min(self._parameters.period_s, HURRY_MAX_S)
        self._next_s = min(self._next_s, now + HURRIED_PERIOD_S)

    def on_solution(self, term: Term, round_number: int, solution: GraphSolution, now: float) -> bool:
        """Take an answer; False for one of an earlier round or term, which counts for nothing.

        A round that was given up counts as long as no other one was started. The next one pauses for as long as this
        one's solve took (on virtual time, the round, but a minute at most: clocks step there), so that a large graph on
        a slow computer does not take all of it: the first round also starts the solver's process, 20 s on a busy
        machine, which says nothing of the graph.
        """
        if (term, round_number) != (self._term, self._round):
            return False
        took_s = min(now - self._started_s, TIMEOUT_S)
        self._running_until_s = None
        self._failures = 0
        self._next_s = max(self._next_s, now + (solution.solve_s or took_s))
        keyframes = sum(len(T) for component in solution.components for T in component.T_map_keyframe.values())
        self._solution.put(solution, keyframes > self._keyframes_held)
        return True

    def on_failed(self, term: Term, round_number: int, now: float) -> None:
        """A round without a solution: the last one stands; it is tried again, after a growing pause."""
        if self._running_until_s is not None and (term, round_number) == (self._term, self._round):
            self._try_again(now)

    def tick(self, now: float) -> list[Effect]:
        """Give up a round that is overdue, start one that is wanted; who leads no longer forgets what it built."""
        if self._term is None:
            self._rest(now)
            return []
        effects: list[Effect] = []
        if self._running_until_s is not None and self._running_until_s <= now:
            self._try_again(now)
            effects.append(Report(RoundTimedOut(term=self._term, round=self._round)))
        if self._running_until_s is not None or self._next_s > now or not self._is_due(now):
            return effects
        return [*effects, self._start(self._term, now)]

    def deadline(self) -> float:
        """When `tick` is due next."""
        if self._term is None:
            return float("inf")
        if self._running_until_s is not None:
            return self._running_until_s
        if self._stale():
            return self._next_s
        return max(self._next_s, self._started_s + PATIENCE_S) if self._grown() else float("inf")

    def _rest(self, now: float) -> None:
        if self._graph_kept_until_s is None:
            self._graph_kept_until_s = now + GRAPH_KEPT_S
        elif self._graph_kept_until_s <= now:
            self._assembly.forget_built()

    def _start(self, term: Term, now: float) -> Effect:
        self._graph_kept_until_s = None
        self._round += 1
        self._running_until_s = now + TIMEOUT_S * 2**self._failures
        self._started_s = now
        self._next_s = now + (HURRIED_PERIOD_S if now < self._hurried_until_s else self._period_s())
        self._started = (self._assembly.revision, self._assembly.keyframes)
        return Optimise(term, self._round, self._assembly.graph(), self.solution())

    def _period_s(self) -> float:
        return max(self._parameters.period_s, PERIOD_PER_KEYFRAME_S * self._assembly.keyframes)

    def _try_again(self, now: float) -> None:
        self._running_until_s = None
        self._started = None
        self._failures = min(self._failures + 1, FAILURES_MAX)
        self._next_s = max(self._next_s, now + self._period_s() * 2**self._failures)

    def _stale(self) -> bool:
        """Whether the last started round of this term missed a log, a closure, a fix or many keyframes."""
        if self._assembly.keyframes == 0:
            return False
        if self._started is None:
            return True
        return self._started[0] != self._assembly.revision or self._grown() >= KEYFRAMES_PER_ROUND

    def _is_due(self, now: float) -> bool:
        """Whether a round is wanted at once, or was for long enough."""
        return self._stale() or (self._grown() > 0 and self._started_s + PATIENCE_S <= now)

    def _grown(self) -> int:
        """Keyframes since the last started round of this term; 0 before the first."""
        return 0 if self._started is None else self._assembly.keyframes - self._started[1]


def solution_report(term: Term, round_number: int, solution: GraphSolution) -> Report:
    """What a round did, for people."""
    states = [result.state for result in solution.closures]
    fact = RoundSolved(
        term=term.counter,
        leader=term.leader.robot,
        round=round_number,
        components=tuple(component.logs for component in solution.components),
        keyframes=sum(len(p) for c in solution.components for p in c.T_map_keyframe.values()),
        closures_used=states.count(ClosureState.USED),
        closures_rejected=states.count(ClosureState.REJECTED),
        closures_excluded=states.count(ClosureState.EXCLUDED),
        measured_used=sum(result.state is ClosureState.USED for result in solution.measured),
        measured_not_used=sum(result.state is not ClosureState.USED for result in solution.measured),
        cost=sum(component.cost for component in solution.components),
        solve_s=solution.solve_s,
        odometry_scales={
            log.robot: scale.ratio for c in solution.components for log, scale in sorted(c.odometry_scales.items())
        },
        warnings=solution.warnings,
    )
    return Report(fact)
