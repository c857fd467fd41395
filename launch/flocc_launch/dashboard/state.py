"""What is known of a swarm at one moment, folded from its events."""

from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.reports import (
    CameraDoubted,
    CandidateFound,
    ClosureAccepted,
    ClosureRejected,
    ClosureWithdrawn,
    CorrectionApplied,
    Fact,
    KeyframeTaken,
    LeaderFollowed,
    LeaderLost,
    NeighbourDown,
    NeighbourUp,
    RoundSolved,
)
from flocc_agent.geometry import pose_from_tq
from flocc_agent.runtime.event_lines import Reported, is_of
from flocc_agent.runtime.facts import AccountKept, AgentDied, AgentStopped, BytesCounted
from flocc_launch.dashboard.snapshot import ClosureView, LinkView, MapGroup, RobotView, RoundView, Said, Snapshot
from flocc_launch.dashboard.words import sentence_of
from flocc_protocol.ids import KeyframeId

Float = NDArray[np.float64]

RECENT_MAX = 60
PATH_POINTS_MAX = 600
KEYFRAMES_MAX = 200_000
CLOSURES_MAX = 2000
SILENT_S = 20.0
COUNTED_ONLY = ClosureRejected
"""Facts whose number is shown, since there are so many of them."""


@dataclass(slots=True)
class RobotState:
    """One robot as its own events tell it."""

    leader: str | None = None
    term: int | None = None
    neighbours: set[str] = field(default_factory=set)
    map_frame: str | None = None
    T_map_odom: Float = field(default_factory=lambda: np.eye(4))
    positions_odom_m: dict[int, Float] = field(default_factory=dict)
    corrected_m: dict[int, Float] = field(default_factory=dict)
    incarnation: int = 0
    candidates: int = 0
    camera: dict[str, CameraDoubted] = field(default_factory=dict)
    accepted: int = 0
    rejected: int = 0
    sent: Mapping[str, int] = field(default_factory=dict)
    received: Mapping[str, int] = field(default_factory=dict)
    sent_to: dict[str, int] = field(default_factory=dict)
    received_from: dict[str, int] = field(default_factory=dict)
    loss: Mapping[str, float] = field(default_factory=dict)
    queues: Mapping[str, int] = field(default_factory=dict)
    last_s: float = 0.0
    end: str | None = None

    def path_m(self) -> Float:
        """Positions (N, 3) in the map frame of the last correction; in odom before the first.

        Where corrected positions of single keyframes are known, they stand in place of the others up to the last one.
        """
        last = max(self.corrected_m, default=-1)
        indices = sorted({*self.corrected_m, *(index for index in self.positions_odom_m if index > last)})
        found = [position for index in indices if (position := self.position_m(index)) is not None]
        return np.array(found) if found else np.zeros((0, 3))

    def position_m(self, index: int) -> Float | None:
        """Position of one keyframe in the map frame, None where it is not known."""
        if index in self.corrected_m:
            return self.corrected_m[index]
        odom_m = self.positions_odom_m.get(index)
        return None if odom_m is None else np.asarray(self.T_map_odom[:3, :3] @ odom_m + self.T_map_odom[:3, 3])

    def take(self, taken: KeyframeTaken) -> None:
        """One more keyframe; a robot that lost its disk begins anew."""
        keyframe = taken.keyframe
        if keyframe.log.incarnation != self.incarnation:
            self.positions_odom_m.clear()
            self.corrected_m.clear()
            self.incarnation = keyframe.log.incarnation
        if len(self.positions_odom_m) < KEYFRAMES_MAX:
            self.positions_odom_m[keyframe.index] = pose_from_tq(np.array(taken.T_odom_body))[:3, 3]
        self.end = None


class SwarmState:
    """Folds events; `snapshot` is what the page and the table show."""

    def __init__(self, robots: Iterable[str], servers: Iterable[str] = ()) -> None:
        """Know the robots that will be heard of.

        Args:
            robots: Their names; others may come.
            servers: Those without a camera, which are in no map.
        """
        self.robots = {robot: RobotState() for robot in sorted(robots)}
        self.servers = frozenset(servers)
        self.closures: dict[tuple[KeyframeId, KeyframeId], float | None] = {}
        self.recent: deque[Said] = deque(maxlen=RECENT_MAX)
        self.optimised: Reported[RoundSolved] | None = None
        self.t = 0.0

    def apply(self, event: Reported[Fact], by_itself: bool = True) -> None:
        """Take one event; those of one robot come in order.

        Args:
            event: What happened.
            by_itself: Whether the robot said or did it. A leader's correction also comes for robots that are gone.
        """
        robot = self.robots.setdefault(event.robot, RobotState())
        self.t = max(self.t, event.t)
        if by_itself:
            robot.last_s = event.t
        apply_to(robot, event.fact)
        if isinstance(event.fact, ClosureAccepted) and len(self.closures) < CLOSURES_MAX:
            self.closures[event.fact.query, event.fact.match] = event.fact.probability
        if isinstance(event.fact, ClosureWithdrawn):
            for ends in ((event.fact.query, event.fact.match), (event.fact.match, event.fact.query)):
                self.closures.pop(ends, None)
        if is_of(event, RoundSolved):
            self.optimised = event
        said = None if isinstance(event.fact, COUNTED_ONLY) else sentence_of(event)
        if said is not None:
            self.recent.append(Said(event.t, event.robot, said))

    def place(self, name: str, corrected_m: Mapping[int, Float]) -> None:
        """Corrected positions (3,) of single keyframes by their index, in the map frame of the last correction."""
        self.robots.setdefault(name, RobotState()).corrected_m = dict(corrected_m)

    def heard(self, name: str, t: float) -> None:
        """A robot was heard of, without an event."""
        self.robots.setdefault(name, RobotState()).last_s = t

    def snapshot(self, now_s: float | None, scenario: str, seen_by: str | None = None) -> Snapshot:
        """Everything that is to be shown.

        Args:
            now_s: Now on the run's clock; None for a run that is over.
            scenario: Of the run, or the swarm's name.
            seen_by: The robot whose view this is.
        """
        names = sorted(self.robots)
        here = ("running",) if now_s is not None else ("running", "stopped")
        living = {name: robot for name, robot in self.robots.items() if state_of(robot, now_s) in here}
        return Snapshot(
            scenario=scenario,
            seen_by=seen_by,
            t=self.t if now_s is None else now_s,
            running=now_s is not None,
            robots=[robot_view(name, self.robots[name], now_s, name in self.servers) for name in names],
            maps=groups([(name, self.robots[name].map_frame) for name in names if name not in self.servers]),
            ranges=ranges(living),
            leaders=sorted({robot.leader for robot in living.values() if robot.leader is not None}),
            closures=[closure_view(self, query, match) for query, match in self.closures],
            optimised=None if self.optimised is None else round_view(self.optimised),
            recent=list(self.recent)[::-1],
        )


def apply_to(robot: RobotState, fact: Fact) -> None:
    """What a fact changes of its robot."""
    match fact:
        case KeyframeTaken():
            robot.take(fact)
        case CorrectionApplied():
            robot.map_frame, robot.T_map_odom = fact.map_frame, pose_from_tq(np.array(fact.T_map_odom))
            robot.corrected_m = {}
        case LeaderFollowed():
            robot.leader, robot.term = fact.leader, fact.term
        case LeaderLost():
            robot.leader = None
        case NeighbourUp():
            robot.neighbours.add(fact.peer)
        case NeighbourDown():
            robot.neighbours.discard(fact.peer)
        case CandidateFound():
            robot.candidates += 1
        case ClosureAccepted():
            robot.accepted += 1
        case ClosureRejected():
            robot.rejected += 1
        case BytesCounted():
            robot.sent, robot.received = fact.sent, fact.received
            robot.loss, robot.queues = fact.loss, fact.queues
        case AccountKept():
            robot.sent_to, robot.received_from = totals(fact.sent_to), totals(fact.received_from)
        case CameraDoubted():
            robot.camera[fact.doubt] = fact
        case AgentDied():
            robot.end, robot.leader, robot.neighbours = "died", None, set()
        case AgentStopped():
            robot.end = "stopped"


def totals(links: Mapping[str, Mapping[str, int]]) -> dict[str, int]:
    """Bytes by peer, all kinds together."""
    return {peer: sum(kinds.values()) for peer, kinds in links.items()}


def state_of(robot: RobotState, now_s: float | None) -> str:
    """How a robot is: running, silent for a while, stopped or died."""
    if robot.end is not None:
        return robot.end
    if now_s is None or now_s - robot.last_s <= SILENT_S:
        return "running"
    return "silent"


def robot_view(name: str, robot: RobotState, now_s: float | None, server: bool) -> RobotView:
    """One robot; its path is thinned."""
    path = robot.path_m()
    step = max(1, -(-len(path) // PATH_POINTS_MAX))
    kept = path[::step] if step == 1 or not len(path) else np.vstack([path[::step], path[-1:]])
    return RobotView(
        robot=name,
        server=server,
        state=state_of(robot, now_s),
        leader=robot.leader,
        term=robot.term,
        neighbours=sorted(robot.neighbours),
        links=link_views(robot),
        queues=robot.queues,
        map_frame=robot.map_frame,
        keyframes=len(robot.positions_odom_m),
        candidates=robot.candidates,
        camera=list(robot.camera.values()),
        accepted=robot.accepted,
        rejected=robot.rejected,
        sent=dict(sorted(robot.sent.items())),
        sent_bytes=sum(robot.sent.values()),
        received_bytes=sum(robot.received.values()),
        last_s=robot.last_s,
        path_m=np.round(kept, 3).tolist(),
    )


def link_views(robot: RobotState) -> dict[str, LinkView]:
    """What a robot knows of its links, by peer."""
    peers = sorted({*robot.neighbours, *robot.sent_to, *robot.received_from})
    return {
        peer: LinkView(
            hears=peer in robot.neighbours,
            loss_ratio=robot.loss.get(peer) if peer in robot.neighbours else None,
            sent_bytes=robot.sent_to.get(peer),
            received_bytes=robot.received_from.get(peer),
        )
        for peer in peers
    }


def closure_view(state: SwarmState, query: KeyframeId, match: KeyframeId) -> ClosureView:
    """A closure with the places of its ends."""
    ends = [place_of(state, keyframe) for keyframe in (query, match)]
    return ClosureView(str(query), str(match), state.closures[query, match], ends)


def place_of(state: SwarmState, keyframe: KeyframeId) -> list[float] | None:
    """Position of a keyframe in its robot's map frame."""
    robot = state.robots.get(keyframe.log.robot)
    position_m = None if robot is None else robot.position_m(keyframe.index)
    return None if position_m is None else [round(float(v), 3) for v in position_m]


def groups(members: list[tuple[str, str | None]]) -> list[MapGroup]:
    """Robots by map frame; those without one last."""
    frames = Counter(frame for _, frame in members)
    ordered = sorted(frames, key=lambda frame: (frame is None, frame or ""))
    return [MapGroup(f, [name for name, frame in members if frame == f]) for f in ordered]


def ranges(robots: dict[str, RobotState]) -> list[list[str]]:
    """Groups of robots that hear each other, over others as well; two groups are a partition."""
    left = set(robots)
    found = []
    while left:
        reached, frontier = set(), {min(left)}
        while frontier:
            reached |= frontier
            heard = {peer for name in frontier for peer in robots[name].neighbours}
            hearing = {name for name in left if robots[name].neighbours & frontier}
            frontier = ((heard | hearing) & left) - reached
        found.append(sorted(reached))
        left -= reached
    return found


def round_view(event: Reported[RoundSolved]) -> RoundView:
    """The last optimisation."""
    solved = event.fact
    return RoundView(
        t=event.t,
        leader=event.robot,
        round=solved.round,
        cost=solved.cost,
        solve_s=solved.solve_s,
        closures_used=solved.closures_used,
        closures_rejected=solved.closures_rejected,
        warnings=solved.warnings,
    )
