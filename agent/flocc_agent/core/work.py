"""Pairs that this robot registers: which is next, what each lacks, and what would help.

Every table is kept up to date by the event that changes it, so that no step looks through all pairs: a robot may have
thousands that wait for latents out of reach.
"""

import heapq
from bisect import bisect_left, insort
from collections import Counter
from collections.abc import Callable, Container, Iterator, Sequence, Set
from dataclasses import dataclass, field

from flocc_agent.core.known_sets import is_beside
from flocc_agent.core.place_recognition import Candidate
from flocc_agent.core.spared import STRETCH
from flocc_protocol.codec import Pose7
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair

OdometryPairOf = Callable[[KeyframeId], tuple[KeyframeId, Pose7] | None]
"""Gives a keyframe's neighbour in its log and `T_neighbour_query`, or None while it has none."""

Order = tuple[float, CandidatePair]
"""The most similar pair first."""


@dataclass(slots=True)
class Work:
    """A pair that this robot registers; the query is its own keyframe, or the one that has an odometry pair.

    Attributes:
        order: Its place among all pairs.
        query: Keyframe whose log gives the odometry pair.
        match: The other one.
        odometry: The query's neighbour and `T_neighbour_query`, None while there is none.
        lacking: Latents that it needs and that are not here.
        registering_until_s: When the registration under way is given up; None where none is.
    """

    order: Order
    query: KeyframeId
    match: KeyframeId
    odometry: tuple[KeyframeId, Pose7] | None = None
    lacking: list[KeyframeId] = field(default_factory=list)
    registering_until_s: float | None = None

    @property
    def pair(self) -> CandidatePair:
        """The pair."""
        return self.order[1]

    @property
    def is_ready(self) -> bool:
        """Whether it can be registered now."""
        return self.odometry is not None and not self.lacking and self.registering_until_s is None

    def needs(self) -> list[KeyframeId]:
        """Latents that it needs: of the match, the query and the query's neighbour."""
        return [self.match, self.query, *([self.odometry[0]] if self.odometry else [])]

    def absent(self) -> tuple[str, ...]:
        """Robots whose latents it lacks."""
        return tuple(sorted({keyframe.log.robot for keyframe in self.lacking}))


class WorkTable:
    """All such pairs.

    Attributes:
        lacking: Latents to fetch, by the robot that owns them, each with the order of the best pair that needed it.
    """

    def __init__(self, own: LogId, held: Container[KeyframeId], odometry_pair: OdometryPairOf) -> None:
        self.lacking: dict[str, dict[KeyframeId, Order]] = {}
        self._own = own
        self._held = held
        self._odometry_pair = odometry_pair
        self._by_pair: dict[CandidatePair, Work] = {}
        self._order: list[Order] = []
        self._ready: list[Order] = []
        self._users: dict[KeyframeId, set[CandidatePair]] = {}
        self._without_odometry: dict[LogId, set[CandidatePair]] = {}
        self._absent: Counter[tuple[str, ...]] = Counter()
        self._registering: dict[CandidatePair, None] = {}

    def __len__(self) -> int:
        return len(self._by_pair)

    def __contains__(self, pair: CandidatePair) -> bool:
        return pair in self._by_pair

    def __iter__(self) -> Iterator[Work]:
        """The most similar first."""
        return (self._by_pair[pair] for _, pair in self._order)

    def get(self, pair: CandidatePair) -> Work | None:
        """A pair's entry, None where this robot does not register it."""
        return self._by_pair.get(pair)

    def pairs(self) -> list[CandidatePair]:
        """All pairs."""
        return list(self._by_pair)

    def load(self, reachable: Container[str]) -> int:
        """Pairs that can be done, with latents that are here or with robots that are in reach."""
        return sum(n for absent, n in self._absent.items() if all(robot in reachable for robot in absent))

    def add(self, candidate: Candidate) -> None:
        """Take a pair on."""
        query, match = candidate.pair.low, candidate.pair.high
        if match.log == self._own:
            query, match = match, query
        work = Work((-candidate.similarity, candidate.pair), query, match)
        self._by_pair[candidate.pair] = work
        insort(self._order, work.order)
        for keyframe in work.needs():
            self._need(work, keyframe)
        self._find_odometry(work)

    def remove(self, pair: CandidatePair) -> None:
        """A pair is done, or another robot's."""
        work = self._by_pair.pop(pair, None)
        if work is None:
            return
        del self._order[bisect_left(self._order, work.order)]
        self._registering.pop(pair, None)
        self._uncount(work)
        for log in {pair.low.log, pair.high.log} if work.odometry is None else ():
            _discard(self._without_odometry, log, pair)
        for keyframe in work.needs():
            if _discard(self._users, keyframe, pair):
                self._no_longer_lacking(keyframe)

    def drop_worst(self) -> None:
        """Forget the least similar pair that is not under way."""
        worst = next((order[1] for order in reversed(self._order) if order[1] not in self._registering), None)
        if worst is not None:
            self.remove(worst)

    def using(self, keyframe: KeyframeId) -> list[CandidatePair]:
        """Pairs that need a latent, the most similar first."""
        return [order[1] for order in sorted(self._by_pair[pair].order for pair in self._users.get(keyframe, ()))]

    def waiting(self, keyframe: KeyframeId) -> list[Order]:
        """Pairs that need a latent and are not under way."""
        found = (pair for pair in self._users.get(keyframe, ()) if pair not in self._registering)
        return sorted(self._by_pair[pair].order for pair in found)

    def beside(self, closure: CandidatePair) -> list[Order]:
        """Pairs of the same stretches as a closure that are not under way."""
        found: set[CandidatePair] = set()
        first, last = max(closure.low.index - STRETCH, 0), closure.low.index + STRETCH
        for index in range(first, last + 1):
            found.update(self._users.get(KeyframeId(closure.low.log, index), ()))
        logs = closure.low.log, closure.high.log
        near = (pair for pair in found if (pair.low.log, pair.high.log) == logs and is_beside(closure, pair, STRETCH))
        return sorted(self._by_pair[pair].order for pair in near if pair not in self._registering)

    def on_keyframe(self, log: LogId) -> bool:
        """A log grew: its keyframes may have got the neighbour that they lacked. Whether one did."""
        waiting = self._without_odometry.get(log)
        if waiting is None:
            return False
        found = [self._find_odometry(self._by_pair[pair]) for pair in sorted(waiting)]
        return any(found)

    def on_held(self, keyframe: KeyframeId) -> None:
        """A latent is here."""
        if self._no_longer_lacking(keyframe):
            for pair in sorted(self._users.get(keyframe, ())):
                work = self._by_pair[pair]
                self._uncount(work)
                work.lacking.remove(keyframe)
                self._count(work)

    def on_evicted(self, keyframe: KeyframeId) -> None:
        """A latent is no longer here."""
        for pair in sorted(self._users.get(keyframe, ())):
            work = self._by_pair[pair]
            if keyframe not in work.lacking:
                self._uncount(work)
                self._lack(work, keyframe)
                self._count(work)

    @property
    def registering(self) -> int:
        """Registrations under way."""
        return len(self._registering)

    @property
    def under_way(self) -> Set[CandidatePair]:
        """The pairs whose registrations are."""
        return self._registering.keys()

    def start_next(self, until_s: float, chosen: Sequence[CandidatePair] = ()) -> Work | None:
        """Start a pair that is ready, if one is: the first of those chosen, or where none is the most similar."""
        work = next((work for pair in chosen if (work := self._by_pair.get(pair)) and work.is_ready), None)
        while work is None and self._ready and not chosen:
            found = self._by_pair.get(heapq.heappop(self._ready)[1])
            work = found if found is not None and found.is_ready else None
        if work is not None:
            work.registering_until_s = until_s
            self._registering[work.pair] = None
        return work

    def stop(self, pair: CandidatePair) -> None:
        """A registration came to nothing; it is to be tried again."""
        if pair in self._registering:
            del self._registering[pair]
            work = self._by_pair[pair]
            work.registering_until_s = None
            self._note_if_ready(work)

    def overdue(self, now: float) -> list[CandidatePair]:
        """Registrations that gave no answer in time."""
        return [pair for pair in self._registering if self._until_s(pair) <= now]

    def wait_longer(self, by_s: float) -> None:
        """Registrations under way may take so much longer."""
        for pair in self._registering:
            self._by_pair[pair].registering_until_s = self._until_s(pair) + by_s

    def due_s(self) -> float:
        """When a registration is given up."""
        return min(map(self._until_s, self._registering), default=float("inf"))

    def _until_s(self, pair: CandidatePair) -> float:
        until_s = self._by_pair[pair].registering_until_s
        assert until_s is not None, "it is under way"
        return until_s

    def _find_odometry(self, work: Work) -> bool:
        """The query's odometry pair; where a log has one keyframe only, the pair is taken the other way round."""
        odometry = self._odometry_pair(work.query)
        if odometry is None:
            odometry = self._odometry_pair(work.match)
            if odometry is None:
                for log in (work.query.log, work.match.log):
                    self._without_odometry.setdefault(log, set()).add(work.pair)
                return False
            work.query, work.match = work.match, work.query
        for log in (work.query.log, work.match.log):
            _discard(self._without_odometry, log, work.pair)
        work.odometry = odometry
        self._need(work, odometry[0])
        self._count(work)
        return True

    def _need(self, work: Work, keyframe: KeyframeId) -> None:
        self._users.setdefault(keyframe, set()).add(work.pair)
        if keyframe not in self._held and keyframe not in work.lacking:
            self._lack(work, keyframe)

    def _lack(self, work: Work, keyframe: KeyframeId) -> None:
        work.lacking.append(keyframe)
        of_robot = self.lacking.setdefault(keyframe.log.robot, {})
        of_robot[keyframe] = min(work.order, of_robot.get(keyframe, work.order))

    def _no_longer_lacking(self, keyframe: KeyframeId) -> bool:
        of_robot = self.lacking.get(keyframe.log.robot)
        if of_robot is None or of_robot.pop(keyframe, None) is None:
            return False
        if not of_robot:
            del self.lacking[keyframe.log.robot]
        return True

    def _count(self, work: Work) -> None:
        if work.odometry is not None:
            self._absent[work.absent()] += 1
            self._note_if_ready(work)

    def _uncount(self, work: Work) -> None:
        if work.odometry is not None:
            absent = work.absent()
            self._absent[absent] -= 1
            if not self._absent[absent]:
                del self._absent[absent]

    def _note_if_ready(self, work: Work) -> None:
        if work.is_ready:
            heapq.heappush(self._ready, work.order)
            if len(self._ready) > 2 * len(self._by_pair) + 64:
                self._ready = sorted({other.order for other in self._by_pair.values() if other.is_ready})


def _discard(table: dict, key: object, pair: CandidatePair) -> bool:  # type: ignore[type-arg]
    """Take a pair out of one of a table's sets; whether that set is empty now."""
    members = table.get(key)
    if members is None:
        return False
    members.discard(pair)
    if members:
        return False
    del table[key]
    return True
