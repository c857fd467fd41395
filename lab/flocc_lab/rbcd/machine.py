"""RBCD among robots: no leader; every robot iterates on its own block with the separators it heard last.

Robots exchange only separators: their own keyframes at the ends of closures between robots. A robot iterates when it
has news of every neighbour that shares its frame, or has waited long enough; what is lost is said again, with pauses
that double. Every robot starts in its own frame and moves into that of a neighbour whose anchor is lower, so that one
frame survives: the lowest robot's. The graph is whole from the beginning and an iteration never fails: this runs
offline, as the paper's baseline.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import LoopClosure, PoseGraph
from flocc_lab.rbcd.blocks import BlockProblem, BlockState, BlockStep
from flocc_lab.rbcd.separators import SEPARATORS_MAX, Separators
from flocc_protocol.arrays import Array
from flocc_protocol.ids import INDEX_MAX, KeyframeId, LogId
from flocc_protocol.messages import OFFERS_MAX, CandidatePair

Float = NDArray[np.float64]

NEIGHBOURS_MAX = 128


@dataclass(frozen=True, slots=True)
class RbcdParameters:
    """Rates and tolerance.

    Attributes:
        period_s: Shortest time between two iterations of a robot; shorter converges sooner and sends more.
        wait_s: A robot waits this long for news of a neighbour before it iterates on old ones.
        repeat_s: First pause after which a robot at rest says its separators again; doubles up to `repeat_max_s`.
        repeat_max_s: Longest pause between repetitions.
        tolerance: A block whose poses moved less (metres, or entries of a rotation) rests until it hears something new.
    """

    period_s: float = 0.2
    wait_s: float = 1.0
    repeat_s: float = 0.5
    repeat_max_s: float = 16.0
    tolerance: float = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class IterateBlock:
    """Do one iteration of the own block."""

    number: int
    problem: BlockProblem


Effect = Separators | IterateBlock


@dataclass(slots=True)
class _Neighbour:
    """What another robot said last."""

    anchor: LogId
    iteration: int
    origin: Float
    origin_iteration: int
    poses: dict[int, Float] = field(default_factory=dict)
    is_news: bool = True


class RbcdMachine:
    """One robot's part in the optimisation of everybody's poses.

    Attributes:
        anchor: Log after which the frame of this robot's poses is named.
        iteration: Number of its iterations.
        is_settled: Its poses stand still and its robust weights are final.
    """

    def __init__(
        self,
        own: LogId,
        graph: PoseGraph,
        parameters: RbcdParameters,
    ) -> None:
        self.anchor = own
        self.iteration = 0
        self.is_settled = False
        self._own = own
        self._parameters = parameters
        self._neighbours: dict[LogId, _Neighbour] = {}
        self._heard: dict[CandidatePair, float] = {}
        self._epoch = 0
        self._origin: Float | None = None
        self._origin_iteration = -1
        self._trajectory = graph.trajectories[own]
        self._closures = tuple(c for c in graph.closures if own in (c.query.log, c.match.log))
        ends = [self._ends(c) for c in self._closures if c.query.log != c.match.log]
        self._separators = tuple(sorted({own.index for own, _ in ends}))
        self._far_ends = tuple(sorted({other for _, other in ends}))
        self._joined = tuple(sorted({other.log for _, other in ends}))
        self._state: BlockState | None = None
        self._has_news = True
        self._is_running = False
        self._aligning: _Neighbour | None = None
        self._next_s = float("-inf")
        self._wait_until_s = float("-inf")
        self._repeat_at_s = float("inf")
        self._repeat_pause_s = parameters.repeat_s

    # Events

    def on_separators(self, sender: LogId, message: Separators) -> None:
        """Keep what another robot says of its separators, and the weights that are its to decide."""
        held = self._neighbours.get(sender)
        if held is not None and message.iteration < held.iteration:
            return
        if held is None and len(self._neighbours) >= NEIGHBOURS_MAX:
            return
        if held is None or held.anchor != message.anchor:
            origin = message.origin.numpy()
            held = self._neighbours[sender] = _Neighbour(message.anchor, message.iteration, origin, -1)
            self._has_news = True
        held.is_news = held.is_news or message.iteration > held.iteration
        held.iteration = message.iteration
        if held.anchor == self.anchor and message.epoch > self._epoch:
            self._epoch = message.epoch
            self._has_news = True
        if message.origin_iteration > held.origin_iteration:
            held.origin, held.origin_iteration = message.origin.numpy(), message.origin_iteration
        if held.anchor == self.anchor and held.origin_iteration > self._origin_iteration:
            self._origin, self._origin_iteration = held.origin, held.origin_iteration
        self._has_news |= self._take_poses(held, message) | self._take_weights(sender, message)

    def on_step(self, number: int, step: BlockStep, now: float) -> list[Effect]:
        """An iteration ended: say the separators."""
        assert self._is_running, "nothing was asked"
        assert number == self.iteration, "one iteration at a time"
        self._is_running = False
        self._state = step.state
        if step.aligned and self._aligning is not None:
            self.anchor = self._aligning.anchor
            self._origin_iteration = self._aligning.origin_iteration
        self._aligning = None
        self._origin = step.origin
        if self.anchor == self._own:
            self._origin_iteration = number
        self.is_settled = step.moved <= self._parameters.tolerance and step.finished
        self._has_news |= not self.is_settled or step.aligned
        self._repeat_pause_s = self._parameters.repeat_s
        self._repeat_at_s = now + self._repeat_pause_s
        return [*self._said()]

    # Time

    def tick(self, now: float) -> list[Effect]:
        """Begin the next iteration, repeat what may have been lost."""
        effects: list[Effect] = []
        if not self._is_running and self._begin_at_s() <= now:
            effects.append(self._begin(now))
        if self._repeat_at_s <= now:
            self._repeat_pause_s = min(2.0 * self._repeat_pause_s, self._parameters.repeat_max_s)
            self._repeat_at_s = now + self._repeat_pause_s
            effects += self._said()
        return effects

    def deadline(self) -> float:
        """When `tick` is due next."""
        return self._repeat_at_s if self._is_running else min(self._begin_at_s(), self._repeat_at_s)

    # What it knows

    def _ends(self, closure: LoopClosure) -> tuple[KeyframeId, KeyframeId]:
        """The own and the other end of a closure between two robots."""
        return (closure.query, closure.match) if closure.query.log == self._own else (closure.match, closure.query)

    def _heard_of(self) -> list[_Neighbour]:
        """Neighbours that closures join to this robot and that said something."""
        return [self._neighbours[log] for log in self._joined if log in self._neighbours]

    def _sharing(self) -> list[_Neighbour]:
        """Those of them that are in this robot's frame."""
        return [neighbour for neighbour in self._heard_of() if neighbour.anchor == self.anchor]

    def _take_poses(self, held: _Neighbour, message: Separators) -> bool:
        """Whether a pose moved enough to begin anew."""
        moved = False
        for index, pose in zip(message.keyframes, message.poses.numpy(), strict=True):
            before = held.poses.get(index)
            same = before is not None and before.shape == pose.shape
            moved |= not same or bool(np.abs(pose - before).max() > 0.5 * self._parameters.tolerance)
            held.poses[index] = pose
        return moved

    def _take_weights(self, sender: LogId, message: Separators) -> bool:
        changed = False
        for pair, weight in zip(message.pairs, message.weights.numpy().tolist(), strict=True):
            if pair.low.log == sender and pair.high.log == self._own and self._heard.get(pair) != weight:
                self._heard[pair] = weight
                changed = True
        return changed

    # What it does

    def _begin_at_s(self) -> float:
        if not self._has_news:
            return float("inf")
        waits = not self.is_settled and any(not neighbour.is_news for neighbour in self._sharing())
        return max(self._next_s, self._wait_until_s) if waits else self._next_s

    def _begin(self, now: float) -> Effect:
        self.iteration = min(self.iteration + 1, INDEX_MAX)
        self._is_running = True
        self._next_s = now + self._parameters.period_s
        self._wait_until_s = now + self._parameters.wait_s
        self._has_news = self.is_settled = False
        for neighbour in self._neighbours.values():
            neighbour.is_news = False
        self._aligning = self._in_lower_frame()
        align_to = {} if self._aligning is None else self._poses_in(self._aligning.anchor)
        return IterateBlock(
            self.iteration,
            BlockProblem(
                log=self._own,
                trajectory=self._trajectory,
                closures=self._closures,
                others=self._poses_in(self.anchor),
                heard=dict(self._heard),
                epoch=self._epoch,
                anchored=self.anchor == self._own,
                origin=self._origin if self._aligning is None else self._aligning.origin,
                align_to=align_to,
                state=self._state,
            ),
        )

    def _in_lower_frame(self) -> _Neighbour | None:
        """A neighbour with closures in the lowest frame that is lower than this robot's; the freshest of several."""
        lower = [neighbour for neighbour in self._heard_of() if neighbour.anchor < self.anchor]
        return min(lower, key=lambda n: (n.anchor, -n.origin_iteration), default=None)

    def _poses_in(self, anchor: LogId) -> dict[KeyframeId, Float]:
        """Poses of the far ends of closures, of robots in a frame, as far as they said them."""
        found = {}
        for end in self._far_ends:
            neighbour = self._neighbours.get(end.log)
            if neighbour is not None and neighbour.anchor == anchor and end.index in neighbour.poses:
                found[end] = neighbour.poses[end.index]
        return found

    def _said(self) -> list[Separators]:
        """This robot's separators and the weights that are its to decide, in as many messages as they need."""
        state, origin = self._state, self._origin
        known = [] if state is None else [index for index in self._separators if index < len(state.X)]
        if state is None or origin is None or not known:
            return []
        weighed = [(pair, w) for pair, w in sorted(state.weights.items()) if pair.low.log != pair.high.log]
        messages = []
        for k in range(max(-(-len(known) // SEPARATORS_MAX), -(-len(weighed) // OFFERS_MAX))):
            keyframes = known[k * SEPARATORS_MAX : (k + 1) * SEPARATORS_MAX]
            part = weighed[k * OFFERS_MAX : (k + 1) * OFFERS_MAX]
            messages.append(
                Separators(
                    self.anchor,
                    self.iteration,
                    state.epoch,
                    Array.of(origin, "f8"),
                    max(self._origin_iteration, 0),
                    tuple(keyframes),
                    Array.of(state.X[keyframes], "f8"),
                    tuple(pair for pair, _ in part),
                    Array.of(np.array([weight for _, weight in part])),
                )
            )
        return messages
