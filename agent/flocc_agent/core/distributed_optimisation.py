"""Distributed optimisation: no leader; every robot solves its own part and agrees with one neighbour at a time.

Which closures are right is decided before robots agree on anything, from logs alone: each robot solves its own log, and
the lower robot of each pair both logs together, with the whole back end. So wrong ones are found as a leader finds
them, and nothing that robots say while they move feeds back into that choice. The lower robot lists the poses that the
pair shares; the list has an edition, and what is told of another one counts for nothing.

A robot steps when it has news of every neighbour in range, or has waited long enough; then it tells each of them, in
range, where it has the shared poses. What is lost is said again, with pauses that double. Every robot starts in its own
frame and moves into that of a neighbour whose anchor is lower, so that one frame survives: the lowest robot's. A robot
gives corrections to itself only, with its step as the round; one that contradicts its own log is not given, and the
robot begins again alone. Nor is one while neighbours are farther away than covariances allow (`coming_apart`); where
that does not shrink, the robot goes back to where it last agreed, and does not hear those for a while.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.closure_choices import FAILURES_MAX, Choosing, ClosureChoices, shared_of, used_closures
from flocc_agent.core.coming_apart import SILENT_S, ComingApart, beyond
from flocc_agent.core.correction_evidence import way_m
from flocc_agent.core.distrust import DISTRUSTED_FIRST_S, DISTRUSTED_MAX_S
from flocc_agent.core.effects import Effect, Report, StepConsensus, Unicast
from flocc_agent.core.own_part import (
    ConsensusProblem,
    ConsensusState,
    ConsensusStep,
    OwnedClosure,
    SharedWith,
    ToldPoses,
)
from flocc_agent.core.pair_exchange import SharedPair, ToldFrame, asking_for_list, told_by
from flocc_agent.core.parameters import DistributedParameters
from flocc_agent.core.peer_budgets import Muted
from flocc_agent.core.plausibility import HELD_BACK_S
from flocc_agent.core.pose_graph import Component, GraphSolution, LoopClosure, PoseGraph, Trajectory
from flocc_agent.core.reports import CAME_APART, PartMoved, PeerRefused, RoundFailed
from flocc_agent.core.rounds import KEYFRAMES_PER_ROUND, PATIENCE_S
from flocc_agent.geometry import inverse, pose_from_tq
from flocc_protocol.arrays import Array
from flocc_protocol.ids import INDEX_MAX, KeyframeId, LogId, Term
from flocc_protocol.messages import SharedPoses

Float = NDArray[np.float64]
STEPS_AFTER_RESTART = 1000
"""A restarted robot counts on from its last correction and this: above whatever it said before."""
DELIVER_PERIOD_S = 2.0
"""Shortest time between two corrections that a robot gives itself, as between a leader's."""
NEIGHBOURS_MAX = 128
OVERTAKEN_S = 5.0
"""A message that is older than the last one by its number is new by its time after so long: its sender began again."""
VAIN_STEPS_MAX, NEARER_RATIO = 40, 0.9
"""After so many steps that brought a robot no nearer to its neighbours it rests all the same."""


class GraphSource(Protocol):
    """Where the pose graph comes from: the robot's copies of all logs."""

    @property
    def keyframes(self) -> int:
        """Number of keyframes of all logs."""
        ...

    @property
    def revision(self) -> int:
        """Grows with every closure and log."""
        ...

    def graph(self) -> PoseGraph:
        """The pose graph of everything known."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class _Agreed:
    """Where a robot was when no neighbour was farther away than covariances allow."""

    anchor: LogId
    origin: Float
    origin_step: int
    step: ConsensusStep


class DistributedOptimisation:
    """One robot's part in the optimisation of everybody's poses.

    Attributes:
        anchor: Log after which the frame of this robot's poses is named.
        number: Number of its steps.
        is_settled: Its poses stand still, where its neighbours have them.
    """

    def __init__(
        self,
        own: LogId,
        source: GraphSource,
        parameters: DistributedParameters,
        near: Callable[[str], bool],
        number: int = 0,
    ) -> None:
        """Start alone.

        Args:
            own: The log that this robot writes.
            source: Copies of all logs.
            parameters: Rates and tolerance.
            near: Whether a robot of this name is in range.
            number: Steps are counted from here on.
        """
        self.anchor = own
        self.number = number
        self.is_settled = False
        self._is_back = number > 0
        self._number_min = number
        self._own = own
        self._source = source
        self._parameters = parameters
        self._near = near
        self._pairs: dict[LogId, SharedPair] = {}
        self._within: tuple[OwnedClosure, ...] = ()
        self._T_alone: Float = np.zeros((0, 4, 4))
        self._origin: Float | None = None
        self._origin_step = -1
        self._seen: tuple[int, int] | None = None
        self._seen_s = float("-inf")
        self._graph = PoseGraph({})
        self._choices = ClosureChoices(own, parameters)
        self._state: ConsensusState | None = None
        self._step: ConsensusStep | None = None
        self._has_news = False
        self._running_until_s: float | None = None
        self._running_lists: dict[LogId, int] = {}
        self._moving_to: LogId | None = None
        self._next_s = float("-inf")
        self._wait_until_s = float("-inf")
        self._repeat_at_s = float("inf")
        self._repeat_pause_s = parameters.repeat_s
        self._deliver_at_s = float("-inf")
        self._undelivered = False
        self._failures = 0
        self._distrusted = Muted(DISTRUSTED_FIRST_S, DISTRUSTED_MAX_S)
        self._contradicted_s: float | None = None
        self._rejoin_at_s = float("inf")
        self._silences_seen_s = float("-inf")
        self._coming_apart = ComingApart()
        self._agreed: _Agreed | None = None
        self._least_gap = float("inf")
        self._vain_steps = 0

    # Events

    def on_shared_poses(self, sender: LogId, message: SharedPoses, now: float) -> list[Effect]:
        """Keep what another robot says of the poses that both have."""
        if self._is_distrusted(sender, now):
            return []
        pair = self._pairs.get(sender)
        if pair is None:
            if len(self._pairs) >= NEIGHBOURS_MAX or not message.edition:
                return []
            pair = self._pairs[sender] = SharedPair()
        if pair.said is not None and message.step < pair.said.step:
            if now < pair.said_s + OVERTAKEN_S:
                return []  # messages overtake each other, but not for so long: it began again
            pair.said = pair.heard = None
            if sender < self._own:
                pair.edition, pair.keyframes = 0, ()
            else:
                self._list_anew(pair)
        if sender < self._own and message.edition != pair.edition and not self._take_list(sender, pair, message):
            return [] if message.keyframes or message.edition <= pair.edition else [self._ask_for_list(sender)]
        before, pair.said, pair.said_s = pair.said, message, now
        if self._own < sender and before is not None and message.edition < before.edition == pair.edition:
            self._list_anew(pair)  # it began again: what both said of the old list is of no use
        if message.edition != pair.edition or len(message) != len(pair.keyframes) or not len(message):
            return []
        pair.is_news = pair.is_news or before is None or message.step > before.step
        if message.anchor == self.anchor and not self._is_back:
            self._take_origin(message)
            if before is None or message.step > before.step:
                pair.heard = message
                self._has_news |= before is None or not self._rests() or self._says_more(message, before)
        self._has_news |= message.anchor < self.anchor or (self._is_back and message.anchor == self.anchor)
        return []

    def on_own_correction(self, number: int) -> None:
        """Others hold a correction that this robot gave itself before it lost its disk: it counts on above that."""
        self._number_min = max(self._number_min, number)

    def on_step(self, number: int, step: ConsensusStep, now: float) -> list[Effect]:
        """A step ended: tell neighbours; an answer that is late or of another step counts for nothing."""
        if self._running_until_s is None or number != self.number:
            return []
        self._running_until_s = None
        self._failures = 0
        self._state, self._step = step.state, step
        if step.aligned and self._moving_to is not None:
            said = self._pairs[self._moving_to].said
            assert said is not None, "it said where the poses are to be moved"
            self.anchor, self._origin_step, self._is_back = said.anchor, said.origin_step, False
        self._moving_to = None
        self._origin = step.origin
        if self.anchor == self._own:
            self._origin_step = number
        for other, told in step.told.items():
            pair = self._pairs[other]
            if pair.edition == self._running_lists[other]:
                pair.told = told
        for other, information in step.information.items():
            pair = self._pairs[other]
            if pair.edition == self._running_lists[other]:
                pair.information = Array.of(information)
        self.is_settled = max(step.moved, step.gap) <= self._parameters.tolerance
        self._has_news |= step.aligned or step.moved > self._parameters.tolerance
        self._watch_gap(step.gap)
        self._undelivered = True
        self._repeat_pause_s = self._parameters.repeat_s
        self._repeat_at_s = now + self._repeat_pause_s
        reports = [self._refuse(other, reason) for other, reason in sorted(step.refused.items())]
        self._leave(step.refused, step.refused, now)
        return [*reports, *self._watch_contacts(step, now), *self._said()]

    def on_failed(self, number: int, reason: str, now: float) -> list[Effect]:
        """A step without a result: it is tried again after a growing pause."""
        if self._running_until_s is None or number != self.number:
            return []
        self._running_until_s = None
        self._moving_to = None
        self._failures = min(self._failures + 1, FAILURES_MAX)
        self._next_s = now + self._parameters.period_s * 2**self._failures
        self._has_news = True
        return [Report(RoundFailed(term=Term(0, self._own), round=number, reason=reason))]

    def on_chosen(self, number: int, solution: GraphSolution, now: float) -> list[Effect]:
        """One or two logs were solved for themselves: take the closures that are right."""
        choosing = self._choices.end(number, now)
        if choosing is None:
            return []
        if choosing.other == self._own:
            self._take_own(choosing.graph, solution)
        else:
            self._take_pair(choosing, solution)
        return []

    def on_choice_failed(self, number: int, reason: str, now: float) -> list[Effect]:
        """They could not be solved: tried again after a growing pause."""
        if not self._choices.fail(number, now):
            return []
        return [Report(RoundFailed(term=Term(0, self._own), round=self.number, reason=reason))]

    def on_judged(self, why: str | None, now: float) -> list[Effect]:
        """Whether something in this robot's own log speaks against its part; what lasts was brought by neighbours.

        Then it begins again alone, and does not hear for a while those that it had heard. Others' corrections and
        records may be on their way, so that it waits before that; meanwhile its last correction stands.
        """
        if why is None:
            self._contradicted_s = None
            return []
        if self._contradicted_s is None:
            self._contradicted_s = now
        self._undelivered = True
        if now < self._contradicted_s + HELD_BACK_S:
            return []
        self._contradicted_s = None
        heard = sorted(other for other, pair in self._pairs.items() if pair.said is not None)
        self._begin_alone()
        self._step, self._undelivered = None, False
        self._next_s = now + self._parameters.period_s
        self._leave(self._pairs, heard, now)
        reason = f"{why}: it goes on alone"
        return [self._refuse(other, reason) for other in heard]

    # Time

    def tick(self, now: float) -> list[Effect]:
        """Give up what is overdue, choose closures, begin the next step, repeat what may have been lost."""
        effects: list[Effect] = []
        if self._running_until_s is not None and self._running_until_s <= now:
            effects += self.on_failed(self.number, "it took too long", now)
        overdue = self._choices.overdue(now)
        if overdue is not None:
            effects += self.on_choice_failed(overdue, "it took too long", now)
        self._look(now)
        if self._silent_at_s() <= now:
            self._silences_seen_s, self._has_news = now, True
        if self._rejoin_at_s <= now:
            self._rejoin_at_s, self._has_news = float("inf"), True
        effects += self._choices.begin(self._graph, now)
        if self._running_until_s is None and self._begin_at_s() <= now:
            effects.append(self._begin(now))
        if self._repeat_at_s <= now:
            self._repeat_pause_s = min(2.0 * self._repeat_pause_s, self._parameters.repeat_max_s)
            self._repeat_at_s = now + self._repeat_pause_s
            effects += self._said()
        return effects

    def deadline(self) -> float:
        """When `tick` or `component` is due next."""
        deliver_s = self._may_deliver_s() if self._undelivered else float("inf")
        step_s = self._begin_at_s() if self._running_until_s is None else self._running_until_s
        choice_s = self._choices.deadline()
        return min(
            step_s, choice_s, self._repeat_at_s, deliver_s, self._look_at_s(), self._rejoin_at_s, self._silent_at_s()
        )

    def component(self, now: float) -> Component | None:
        """This robot's corrected poses, at most once per period, None where there is nothing new or agreed on."""
        if self._step is None or not self._undelivered or self._may_deliver_s() > now:
            return None
        self._undelivered = False
        self._deliver_at_s = now + DELIVER_PERIOD_S
        T = self._step.T_map_keyframe
        T_map_odom = T[-1] @ inverse(self._trajectory.T_odom_keyframe[len(T) - 1])
        logs = (self._own,) if self.anchor == self._own else (self.anchor, self._own)
        return Component(logs, {self._own: T}, {self._own: T_map_odom}, {}, cost=self._step.cost)

    def report(self) -> Report:
        """Where this robot's part stands, for people."""
        step = self._step
        fact = PartMoved(
            step=self.number,
            anchor=self.anchor,
            neighbours=len(self._sharing()),
            shared_poses=sum(len(pair.keyframes) for pair in self._pairs.values()),
            cost=None if step is None else step.cost,
            moved=None if step is None else step.moved,
            gap=None if step is None else step.gap,
            closures_used=len(self._owned()),
            keyframes=0 if step is None else len(step.T_map_keyframe),
        )
        return Report(fact)

    def _silent_at_s(self) -> float:
        """When the next neighbour is silent so long that only what both agreed on counts: that takes a step."""
        ends = (pair.said_s + SILENT_S for pair in self._pairs.values() if pair.said is not None and pair.keyframes)
        return min((end for end in ends if end > self._silences_seen_s), default=float("inf"))

    def _may_deliver_s(self) -> float:
        """Not before that, unless a contact says that neighbours agree."""
        return max(self._deliver_at_s, self._coming_apart.until_s())

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return {"shared_with": (len(self._pairs), NEIGHBOURS_MAX), **self._distrusted.sizes("not_agreed_with")}

    # What others may look at

    def shares_with(self) -> tuple[LogId, ...]:
        """Robots with which it shares poses."""
        return tuple(sorted(other for other, pair in self._pairs.items() if pair.keyframes))

    @property
    def solved(self) -> int:
        """Own keyframes in its part."""
        return 0 if self._step is None else len(self._step.T_map_keyframe)

    @property
    def has_chosen(self) -> bool:
        """Whether all closures that it knows of were chosen or turned away."""
        return self._choices.deadline() == float("inf")

    @property
    def gap(self) -> float:
        """Largest difference from where neighbours have the shared poses, after its last step."""
        return 0.0 if self._step is None else self._step.gap

    # What it knows

    @property
    def _trajectory(self) -> Trajectory:
        return self._graph.trajectories.get(self._own, Trajectory(np.zeros((0, 4, 4))))

    def _look(self, now: float) -> None:
        """Take in what the logs gained: every closure, keyframes in steps, the last few after a while."""
        revision, keyframes = self._source.revision, self._source.keyframes
        if keyframes == 0 or self._look_at_s() > now:
            return
        self._seen, self._seen_s = (revision, keyframes), now
        graph = self._source.graph()
        if self._own not in graph.trajectories:
            return
        self._graph = graph
        self._choices.look(graph)
        for lower, pair in self._pairs.items():
            if lower < self._own and not self._bears_out(lower, pair.keyframes):
                pair.edition, pair.keyframes = 0, ()  # closures of it were taken back
                pair.heard = pair.told = None
        self._has_news = True

    def _look_at_s(self) -> float:
        """When it is time to take in what the logs gained; never where they gained nothing."""
        if self._seen is None:
            return float("-inf") if self._source.keyframes else float("inf")
        revision, keyframes = self._seen
        grown = self._source.keyframes - keyframes
        if revision != self._source.revision or grown >= KEYFRAMES_PER_ROUND:
            return self._seen_s
        return self._seen_s + PATIENCE_S if grown else float("inf")

    def _is_distrusted(self, log: LogId, now: float) -> bool:
        return self._distrusted.is_muted(log.robot, log.robot, now)

    def _take_list(self, sender: LogId, pair: SharedPair, message: SharedPoses) -> bool:
        """Take the list of shared poses that a lower robot made, if it is newer and closures here bear it out."""
        listed = tuple(message.keyframes)
        if message.edition <= pair.edition or not listed or listed[-1] >= len(self._trajectory):
            return False
        if not self._bears_out(sender, listed):
            return False
        pair.edition, pair.keyframes, pair.information = message.edition, listed, message.information
        pair.heard = pair.told = None
        self._has_news = True
        return True

    def _bears_out(self, other: LogId, listed: tuple[int, ...]) -> bool:
        """Whether closures here that nothing doubts tie all of these own keyframes to another robot."""
        tied = {
            own.index
            for c in self._graph.closures
            for own, there in ((c.query, c.match), (c.match, c.query))
            if own.log == self._own and there.log == other and not c.doubt
        }
        return tied.issuperset(listed)

    def _take_origin(self, message: SharedPoses) -> None:
        if self.anchor != self._own and message.origin_step > self._origin_step:
            self._origin, self._origin_step = pose_from_tq(np.array(message.origin)), message.origin_step

    def _says_more(self, message: SharedPoses, before: SharedPoses) -> bool:
        """Whether a message moved something since the last one."""
        if (message.edition, message.anchor, message.known) != (before.edition, before.anchor, before.known):
            return True
        if len(message.stiffness.numpy()):
            return True
        apart = message.rows.numpy()[:, :7] - before.rows.numpy()[:, :7]
        apart[:, :3] += message.base_m.numpy() - before.base_m.numpy()
        return bool(np.abs(apart).max() > 0.5 * self._parameters.tolerance)

    def _sharing(self) -> list[SharedPair]:
        """Those with whom it agrees on poses in its frame."""
        return [p for p in self._pairs.values() if p.keyframes and p.said is not None and p.said.anchor == self.anchor]

    def _rests(self) -> bool:
        """Whether its poses stand still where neighbours have them, or come no nearer to that."""
        return self.is_settled or self._vain_steps >= VAIN_STEPS_MAX

    def _watch_gap(self, gap: float) -> None:
        """Count steps that brought it no nearer to its neighbours."""
        nearer = gap < NEARER_RATIO * self._least_gap
        self._vain_steps = 0 if nearer else min(self._vain_steps + 1, VAIN_STEPS_MAX)
        self._least_gap = gap if nearer or gap > self._least_gap / NEARER_RATIO**4 else self._least_gap

    def _watch_contacts(self, step: ConsensusStep, now: float) -> list[Effect]:
        """Say with whom it comes apart, and go back to where it last agreed with everybody."""
        T = {log: self._graph.trajectories[log] for log in (self._own, *step.apart) if log in self._graph.trajectories}
        ways_m = {log: way_m(np.asarray(trajectory.T_odom_keyframe)) for log, trajectory in T.items()}
        both_m = {log: ways_m.get(self._own, 0.0) + ways_m.get(log, 0.0) for log in step.apart}
        contacts = {log: beyond(apart, both_m[log]) for log, apart in step.apart.items()}
        apart = self._coming_apart.on_contacts(contacts, now)
        if not apart:
            if self._coming_apart.until_s() < now:
                self._agreed = _Agreed(self.anchor, step.origin, self._origin_step, step)
            return []
        agreed = self._agreed
        self._begin_alone()
        self._step, self._undelivered = None, False
        if agreed is not None:
            self.anchor, self._origin, self._origin_step = agreed.anchor, agreed.origin, agreed.origin_step
            self._state, self._step, self._is_back = agreed.step.state, agreed.step, False
        self._leave(apart, apart, now)
        return [*(self._refuse(other, CAME_APART) for other in apart), self.report()]

    def _leave(self, logs: Iterable[LogId], distrusted: Iterable[LogId], now: float) -> None:
        """Take back what is shared with others, and do not hear some of them for a while; it owns what it owned."""
        for other in distrusted:
            self._distrusted.on_failed(other.robot, other.robot, now)
        self._coming_apart.forget(logs)
        for other in logs:
            pair = self._pairs[other]
            pair.said = None
            self._list_anew(pair)
            self._rejoin_at_s = self._distrusted.until_s()
            if not pair.owned:
                pair.edition, pair.keyframes = 0, ()

    def _owned(self) -> tuple[OwnedClosure, ...]:
        return (*self._within, *(each for pair in self._pairs.values() for each in pair.owned))

    # What it chooses

    def _take_own(self, graph: PoseGraph, solution: GraphSolution) -> None:
        component = next((c for c in solution.components if self._own in c.logs), None)
        if component is None:
            return
        T = np.asarray(component.T_map_keyframe[self._own], dtype=float)
        self._within = used_closures(graph.closures, solution, {self._own: T})
        self._T_alone = T
        if not any(pair.said is not None for pair in self._pairs.values()):
            self._state = None  # nobody was heard yet: what was found alone is all there is
        self._has_news = True

    def _take_pair(self, choosing: Choosing, solution: GraphSolution) -> None:
        """Share what was found right; the list is a new one only where it is another one."""
        other = choosing.other
        component = next((c for c in solution.components if {self._own, other} <= set(c.logs)), None)
        T = {} if component is None else {log: component.T_map_keyframe[log] for log in (self._own, other)}
        between = [c for c in choosing.graph.closures if c.query.log != c.match.log]
        shared, used = shared_of(used_closures(choosing.graph.closures, solution, T, between))
        pair = self._pairs.get(other)
        if pair is None:
            if not shared or len(self._pairs) >= NEIGHBOURS_MAX:
                return
            pair = self._pairs[other] = SharedPair()
        if shared != pair.keyframes or {c.ends for c in used} != {c.ends for c in pair.owned}:
            self._list_anew(pair)
        pair.keyframes, pair.owned = shared, used
        self._has_news = True

    def _list_anew(self, pair: SharedPair) -> None:
        """Give the list of shared poses another edition."""
        pair.edition = min(max(self.number, pair.edition) + 1, INDEX_MAX)
        pair.information = pair.heard = pair.told = None

    # What it does

    def _begin_at_s(self) -> float:
        if not self._has_news or len(self._trajectory) == 0:
            return float("inf")
        waits = not self.is_settled and any(
            not pair.is_news for other, pair in self._pairs.items() if pair.heard is None and self._is_met(other, pair)
        )
        return max(self._next_s, self._wait_until_s) if waits else self._next_s

    def _is_met(self, other: LogId, pair: SharedPair) -> bool:
        """Whether a neighbour in this robot's frame is in range."""
        return pair.said is not None and pair.said.anchor == self.anchor and self._near(other.robot)

    def _begin(self, now: float) -> Effect:
        self.number = min(max(self.number, self._number_min) + 1, INDEX_MAX)
        self._running_until_s = now + self._parameters.timeout_s
        self._next_s = now + self._parameters.period_s
        self._wait_until_s = now + self._parameters.wait_s
        self._has_news = self.is_settled = False
        if self.anchor != self._own and not any(pair.keyframes for pair in self._pairs.values()):
            self._begin_alone()  # what brought it into another's frame was taken back
        moves_to = self._in_lower_frame()
        self._moving_to = None if moves_to is None else moves_to[0]
        said = None if moves_to is None else self._pairs[moves_to[0]].said
        anchor = self.anchor if said is None else said.anchor
        shared = {
            other: self._shared_with(other, pair, anchor, now)
            for other, pair in self._pairs.items()
            if pair.keyframes and not self._is_distrusted(other, now)
        }
        self._running_lists = {other: pair.edition for other, pair in self._pairs.items()}
        for pair in self._pairs.values():
            pair.heard, pair.is_news = None, False
        origin = self._origin if said is None else pose_from_tq(np.array(said.origin))
        return StepConsensus(
            self.number,
            ConsensusProblem(
                log=self._own,
                trajectory=self._trajectory,
                owned=tuple(each for each in self._owned() if self._is_known(each.closure)),
                shared=shared,
                T_alone=self._T_alone,
                number=self.number,
                anchored=anchor == self._own,
                origin=origin,
                move_to=moves_to,
                state=self._state,
            ),
        )

    def _is_known(self, closure: LoopClosure) -> bool:
        ends = [end for end in (closure.query, closure.match) if end.log == self._own]
        return all(end.index < len(self._trajectory) for end in ends)

    def _shared_with(self, other: LogId, pair: SharedPair, anchor: LogId, now: float) -> SharedWith:
        """What it shares with another; what that one said in another frame than this step's is not heard.

        One that fell silent before both agreed pulls no more: of one that agreed the last word stands.
        """
        high = max(self._own, other)
        heard = pair.heard if pair.heard is not None and pair.heard.anchor == anchor else None
        return SharedWith(
            pair.edition,
            tuple(KeyframeId(high, index) for index in pair.keyframes),
            None if pair.information is None else pair.information.numpy(),
            None if heard is None else told_by(heard),
            forgotten=pair.said_s + SILENT_S <= now,
        )

    def _in_lower_frame(self) -> tuple[LogId, ToldPoses] | None:
        """A neighbour in the lowest frame that is lower than the own one, and what it told; the freshest of several."""
        lower = [
            (pair.said.anchor, -pair.said.origin_step, other, pair.said)
            for other, pair in self._pairs.items()
            if pair.said is not None
            and (pair.said.anchor < self.anchor or (self._is_back and pair.said.anchor == self.anchor))
            and pair.said.edition == pair.edition
            and 0 < len(pair.said) == len(pair.keyframes)
        ]
        if not lower:
            return None
        _, _, other, said = min(lower, key=lambda found: found[:3])
        return other, told_by(said)

    def _begin_alone(self) -> None:
        self.anchor, self._state, self._origin, self._origin_step = self._own, None, None, -1
        self._agreed = None
        self._is_back = True
        self._has_news = True

    def _said(self) -> list[Effect]:
        """What neighbours in range are told; with the list of shared poses until they have it."""
        if self._origin is None:
            return []
        frame = self._frame(self._origin)
        return [
            Unicast(other.robot, pair.message(frame, self._own < other))
            for other, pair in sorted(self._pairs.items())
            if pair.told is not None and self._near(other.robot)
        ]

    def _frame(self, origin: Float) -> ToldFrame:
        return ToldFrame(self.anchor, self.number, origin, max(self._origin_step, 0))

    def _ask_for_list(self, other: LogId) -> Effect:
        """Tell a lower robot that its list of shared poses is not here: this robot began again."""
        frame = self._frame(np.eye(4) if self._origin is None else self._origin)
        return Unicast(other.robot, asking_for_list(frame))

    def _refuse(self, other: LogId, reason: str) -> Effect:
        return Report(PeerRefused(peer=other.robot, reason=f"shared poses: {reason}"))
