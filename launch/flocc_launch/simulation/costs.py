"""Cheap and balanced: messages and work within stated bounds of the least that is possible, work where it is quick."""

from collections import Counter, defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field

from flocc_agent.core.effects import Broadcast, Effect, FetchLatent, Register, Report, Unicast
from flocc_agent.core.events import LatentFetched, LatentFetchFailed
from flocc_agent.core.latents import BACKLOG_MAX
from flocc_agent.core.reports import CandidateFound, NameTaken, NeighbourDown, NeighbourUp
from flocc_launch.simulation.invariants import Step, core
from flocc_launch.simulation.virtual_robot import Station
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import (
    Answer,
    CandidatePair,
    Coordinator,
    Election,
    Heartbeat,
    RecordRequest,
)

HEARTBEATS_PER_S_MAX = 2.1
"""One each half second, by a clock that may be 2 % fast; each new neighbour may be greeted with one more."""
WINDOW_S = 5.0
ELECTION_MAX = 60
"""Messages about leadership that one robot sends within `WINDOW_S`."""
ASKED_MAX = 12
"""How often one robot asks for the same place of a log within a second."""
SHARE_SIGMAS = 5.5
HEARD_S = 3.0
"""So long ago a robot may have said what others still know of it."""
SHARED_MIN = 32
"""Of so many pairs between two robots of one class each registers about half: by a coin, within so many deviations."""


@dataclass(slots=True)
class Cheap:
    """Nobody says, asks or fetches much more often than it must."""

    _heartbeats: dict[tuple[str, int], tuple[float, int]] = field(default_factory=dict)
    _greeted: Counter[tuple[str, int]] = field(default_factory=Counter)
    _elections: dict[str, deque[float]] = field(default_factory=lambda: defaultdict(deque))
    _asked: dict[tuple[str, LogId, int], deque[float]] = field(default_factory=lambda: defaultdict(deque))
    _fetching: dict[tuple[str, int, KeyframeId], tuple[str, float]] = field(default_factory=dict)

    def step(self, step: Step) -> Iterator[str]:
        """One message, request or fetch too many."""
        event, life = step.event, (step.station.name, step.station.life)
        if isinstance(event, LatentFetched | LatentFetchFailed):
            self._fetching.pop((*life, event.keyframe), None)
        for effect in step.effects:
            yield from self._done(step, life, effect)

    def _done(self, step: Step, life: tuple[str, int], effect: Effect) -> Iterator[str]:
        match effect:
            case Report(NeighbourUp()):
                self._greeted[life] += 1
            case Report(NeighbourDown(peer=peer)):
                self._fetching = {k: (holder, s) for k, (holder, s) in self._fetching.items() if holder != peer}
            case Broadcast(Heartbeat()):
                yield from self._beats(step, life)
            case Broadcast(Coordinator()) | Unicast(_, Election() | Answer()):
                if _often(self._elections[life[0]], step.at_s, WINDOW_S) > ELECTION_MAX:
                    yield f"{life[0]} sent {ELECTION_MAX} messages about leadership within {WINDOW_S:g} s"
            case Unicast(_, RecordRequest(positions)):
                for log, first in positions:
                    if _often(self._asked[life[0], log, first], step.at_s, 1.0) > ASKED_MAX:
                        yield f"{life[0]} asked {ASKED_MAX} times for {log} from {first} on within a second"
            case FetchLatent():
                yield from self._fetches(step, life, effect)

    def _beats(self, step: Step, life: tuple[str, int]) -> Iterator[str]:
        since_s, count = self._heartbeats.get(life, (step.at_s, 0))
        self._heartbeats[life] = since_s, count + 1
        at_most = HEARTBEATS_PER_S_MAX * (step.at_s - since_s) + 2 * self._greeted[life] + 3
        if count + 1 > at_most:
            yield f"{life[0]} sent {count + 1} heartbeats in {step.at_s - since_s:.1f} s"

    def _fetches(self, step: Step, life: tuple[str, int], fetch: FetchLatent) -> Iterator[str]:
        now_s = step.station.now_s()  # the robot gives a fetch up by its own clock, which may step
        is_here = fetch.keyframe in step.station.disk.latents and fetch.keyframe not in step.station.unheard
        if is_here and not core(step.station).assembly.withdrawals.is_withdrawn(fetch.keyframe):
            yield f"{life[0]} fetches {fetch.keyframe}, which it holds"
        _, until_s = self._fetching.get((*life, fetch.keyframe), ("", float("-inf")))
        if now_s < until_s - 0.5:
            yield f"{life[0]} fetches {fetch.keyframe} twice at one time"
        self._fetching[*life, fetch.keyframe] = fetch.holder, now_s + fetch.deadline_s


def _often(times_s: deque[float], now_s: float, window_s: float) -> int:
    """Note one more time; how many there are within the window."""
    times_s.append(now_s)
    while times_s[0] <= now_s - window_s:
        times_s.popleft()
    return len(times_s)


@dataclass(slots=True)
class Balanced:
    """Work goes to stronger robots in range that have not more than enough, and between equals each does about half.

    Attributes:
        classes: Compute class by robot name.
    """

    classes: dict[str, int]
    _near_since_s: dict[tuple[str, int], dict[str, float]] = field(default_factory=lambda: defaultdict(dict))
    _known_since_s: dict[tuple[str, int, CandidatePair], float] = field(default_factory=dict)
    _full_s: dict[str, float] = field(default_factory=dict)
    _shared: Counter[bool] = field(default_factory=Counter)

    def step(self, step: Step) -> Iterator[str]:
        """A registration that a stronger robot in range should do, or one owner that does most of the work.

        A name under which two robots seem to run is handed nothing, nor is it asked which of the two does its work.
        """
        life = step.station.name, step.station.life
        for effect in step.effects:
            match effect:
                case Broadcast(Heartbeat(load=load)) if load >= BACKLOG_MAX:
                    self._full_s[step.station.name] = step.at_s
                case Report(NeighbourUp(peer=peer)):
                    self._near_since_s[life][peer] = step.at_s
                case Report(NeighbourDown(peer=peer) | NameTaken(peer=peer)):
                    self._near_since_s[life].pop(peer, None)
                case Report(CandidateFound(query=query, match=match)):
                    self._known_since_s.setdefault((*life, CandidatePair.of(query, match)), step.at_s)
                case Register(pair) if self.classes.get(step.station.log.robot, 0) >= 0:
                    yield from self._registers(step.station, life, pair)

    def _registers(self, station: Station, life: tuple[str, int], pair: CandidatePair) -> Iterator[str]:
        """Robots that were near before the pair was found count; one that was found at a restart has no such time."""
        known_s = self._known_since_s.get((*life, pair), float("-inf"))
        near = {peer for peer, since_s in self._near_since_s[life].items() if since_s < known_s}
        own_class = station.compute_class
        stronger = sorted(peer for peer in near if self.classes.get(peer, 0) > own_class)
        if stronger and not any(self._full_s.get(peer, float("-inf")) > known_s - HEARD_S for peer in stronger):
            yield f"{station.name} registers {pair.low} {pair.high}, though {stronger[0]} is stronger and near"
        other = pair.high.log if station.log == pair.low.log else pair.low.log
        if (
            len(set(self.classes.values())) == 1
            and other.robot in near
            and station.log in (pair.low.log, pair.high.log)
        ):
            yield from self._share(station.log == pair.low.log)

    def _share(self, by_the_lower: bool) -> Iterator[str]:
        self._shared[by_the_lower] += 1
        pairs = self._shared.total()
        off = abs(self._shared[True] - pairs / 2)
        if pairs >= SHARED_MIN and off > SHARE_SIGMAS * 0.5 * pairs**0.5:
            yield f"the lower owner registers {self._shared[True]} of {pairs} pairs"
