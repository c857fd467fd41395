"""Latents: which are here, which are being fetched, and which are kept for robots that cannot reach their owner.

A latent out of reach is asked of relays: heartbeats carry what a robot wants, and neighbours that can reach the
owner fetch and hold it, or pass on that the owner has it no more. Failed fetches are tried again after growing pauses.
In a swarm with keys the owner's log says what a latent is, so that a relay cannot serve another one.
"""

from array import array
from bisect import insort
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

from flocc_agent.core.effects import Effect, FetchLatent
from flocc_agent.core.known_sets import KeyframeSet
from flocc_agent.core.parameters import LoopClosingParameters
from flocc_agent.core.pulls import remember
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import LatentRecord, Record

PAUSED_MAX = 1024
LOST_S = 30.0
"""A lost latent is told for this long after somebody wanted it last."""
WANTS_TURN_S = 10.0
WANTS_MAX = 8
"""Latents out of reach that are asked of relays at one time; a message carries 16."""
TOLD_AGAIN_S = 2.5
"""A wish or an offer is told again after so long only, or to a new neighbour: who hears it remembers it."""
HEARD_S = 3.0 * TOLD_AGAIN_S
"""So long an offer counts that was heard: two in a row may be lost."""
RELAYS_MAX = 16
"""Latents kept for others at one time: the wants of two robots."""
OFFERED_S = 20.0
"""A latent that is here for others is told of for so long after somebody wished for it, after it came, and after one
who wished came into range. Who lacks it still wishes again."""
WISHERS_MAX = 16
"""Robots of which it is remembered that they wished for one latent."""
FALSE_MAX = 64
"""Of so many latents it is remembered that one robot in range served something else in their place."""
BACKLOG_MAX = 64
"""A stronger robot with which so many pairs wait is handed no more: who found them begins with them."""
RETRY_S = 1.0
"""First pause after a failed fetch; it doubles up to `RETRY_MAX_S`."""
RETRY_MAX_S = 16.0
"""Longest pause between fetches of one latent: a robot that comes back is asked soon after."""


@dataclass(frozen=True, slots=True)
class Peer:
    """A robot in range, as loop closing needs it.

    Attributes:
        compute_class: 0 (small) to 9.
        load: Registrations that wait there.
        holds: Latents that it holds for others.
        log: The log that it writes.
    """

    compute_class: int
    load: int = 0
    holds: tuple[KeyframeId, ...] = ()
    log: LogId | None = None


class Reach:
    """Who is in range, and what can be had from whom."""

    def __init__(self) -> None:
        self._peers: dict[str, Peer] = {}
        self._holders: dict[KeyframeId, list[str]] = {}
        self._false: dict[str, dict[KeyframeId, None]] = {}
        self._handed: dict[str, int] = {}

    def __contains__(self, name: object) -> bool:
        return name in self._peers

    def __iter__(self) -> Iterator[str]:
        return iter(self._peers)

    def update(self, name: str, peer: Peer) -> bool:
        """Note a robot in range; whether that changes what can be had."""
        known, false = self._peers.get(name), self._false.get(name)
        peer = peer if false is None else replace(peer, holds=tuple(k for k in peer.holds if k not in false))
        self._peers[name] = peer
        self._handed.pop(name, None)
        if known is None or known.holds != peer.holds:
            self._note_holds(name, known.holds if known else (), peer.holds)
        return known is None or (known.compute_class, known.holds, known.log) != (
            peer.compute_class,
            peer.holds,
            peer.log,
        )

    def writes(self, log: LogId) -> bool:
        """Whether the writer of a log is in range; a robot that lost its disk writes another one."""
        peer = self._peers.get(log.robot)
        return peer is not None and peer.log in (None, log)

    def on_false(self, name: str, keyframe: KeyframeId) -> None:
        """What a robot holds for others is not what the owner made; others are asked until it is out of range."""
        if name in self._peers and name != keyframe.log.robot:
            remember(self._false.setdefault(name, {}), keyframe, None, FALSE_MAX)
            self.update(name, self._peers[name])

    def remove(self, name: str) -> None:
        """A robot is out of range."""
        self._false.pop(name, None)
        self._handed.pop(name, None)
        peer = self._peers.pop(name, None)
        if peer is not None:
            self._note_holds(name, peer.holds, ())

    def held_for_others(self) -> list[KeyframeId]:
        """Latents that robots in range hold for others."""
        return sorted(self._holders)

    def _note_holds(self, name: str, before: Iterable[KeyframeId], after: Iterable[KeyframeId]) -> None:
        for keyframe in before:
            self._holders[keyframe].remove(name)
            if not self._holders[keyframe]:
                del self._holders[keyframe]
        for keyframe in after:
            insort(self._holders.setdefault(keyframe, []), name)

    def stronger(self, compute_class: int) -> str | None:
        """The neighbour of the highest compute class above this one, the least loaded of several."""
        better = [
            (-peer.compute_class, peer.load, name)
            for name, peer in self._peers.items()
            if peer.compute_class > compute_class
        ]
        return min(better)[2] if better else None

    def is_full(self, name: str) -> bool:
        """Whether a robot in range has more than enough pairs to register."""
        peer = self._peers.get(name)
        return peer is not None and peer.load >= BACKLOG_MAX

    def room(self, name: str) -> int:
        """How many more pairs may be handed to a robot until it says again how many wait there: all here may do so."""
        peer = self._peers[name]
        return max(0, -(-(BACKLOG_MAX - peer.load) // len(self._peers)) - self._handed.get(name, 0))

    def on_handed(self, name: str, pairs: int) -> None:
        """So many pairs were handed to a robot."""
        self._handed[name] = self._handed.get(name, 0) + pairs

    def holder(self, keyframe: KeyframeId) -> str | None:
        """Who in range can give a latent: its owner, or a robot that holds it."""
        if keyframe.log.robot in self._peers:
            return keyframe.log.robot
        holders = self._holders.get(keyframe)
        return holders[0] if holders else None


@dataclass(slots=True)
class _Fetch:
    """The state of one wanted latent: in flight until then, or paused until then."""

    holder: str = ""
    in_flight_until_s: float | None = None
    not_before_s: float = float("-inf")
    pause_s: float = 0.0

    def due_s(self) -> float:
        """When something is to be done about it."""
        return self.not_before_s if self.in_flight_until_s is None else self.in_flight_until_s


@dataclass(slots=True)
class Relayed:
    """A latent that others wished for.

    Attributes:
        wished_s: When somebody did so last.
        is_here: Whether it came.
        offered_until_s: Until when it is told of; None: from the next heartbeat on for `OFFERED_S`.
        wishers: Who wished for it.
    """

    wished_s: float
    is_here: bool
    offered_until_s: float | None = None
    wishers: dict[str, None] = field(default_factory=dict)

    def is_awaited(self, now: float) -> bool:
        """Whether it came, and somebody wished for it just now."""
        return self.is_here and now < self.wished_s + WANTS_TURN_S

    def is_offered(self, now: float) -> bool:
        """Whether a heartbeat tells of it."""
        if self.is_here and self.offered_until_s is None:
            self.offered_until_s = now + OFFERED_S
        return self.is_here and self.offered_until_s is not None and now < self.offered_until_s


class ToldNowAndThen:
    """Which of a robot's wishes, or of its offers, a heartbeat tells."""

    def __init__(self) -> None:
        self._told_s: dict[KeyframeId, float] = {}

    def on_reached(self) -> None:
        """A robot came into range, and heard none."""
        self._told_s.clear()

    def due(self, latents: Sequence[KeyframeId], now: float) -> tuple[KeyframeId, ...]:
        """Those that were not told for a while."""
        due = tuple(k for k in latents if self._told_s.get(k, float("-inf")) + TOLD_AGAIN_S <= now)
        self._told_s = {**{k: self._told_s[k] for k in latents if k not in due}, **dict.fromkeys(due, now)}
        return due


class OffersHeard:
    """Latents that robots in range hold for others, as far as they said so a short while ago."""

    def __init__(self) -> None:
        self._until_s: dict[str, dict[KeyframeId, float]] = {}

    def hear(self, name: str, offers: Sequence[KeyframeId], now: float) -> tuple[KeyframeId, ...]:
        """A robot told some: all that count of it now, the newest `RELAYS_MAX` at most."""
        until_s = self._until_s.get(name)
        if until_s is None:
            if not offers:
                return ()
            until_s = self._until_s[name] = {}
        for keyframe in offers:
            until_s.pop(keyframe, None)
            remember(until_s, keyframe, now + HEARD_S, RELAYS_MAX)
        for keyframe in [k for k, end_s in until_s.items() if end_s <= now]:
            del until_s[keyframe]
        if not until_s:
            del self._until_s[name]
        return tuple(sorted(until_s))

    def on_lost(self, name: str) -> None:
        """A robot is out of range."""
        self._until_s.pop(name, None)


class LatentNames:
    """Where the logs say what a keyframe's latent is, as numbers of records; 0 where they do not."""

    def __init__(self) -> None:
        self.record_at: Callable[[LogId, int], Record] | None = None
        self._numbers: dict[LogId, array[int]] = {}

    def add(self, keyframe: KeyframeId, number: int) -> None:
        """A record says it, after its keyframe's; the last one of a keyframe counts, whose latent was made anew."""
        numbers = self._numbers.setdefault(keyframe.log, array("I"))
        if keyframe.index > number:
            return
        numbers.extend([0] * (keyframe.index + 1 - len(numbers)))
        numbers[keyframe.index] = number

    def forget(self, log: LogId) -> None:
        """A log is held no more."""
        self._numbers.pop(log, None)

    def of(self, keyframe: KeyframeId) -> LatentRecord | None:
        """What a latent is."""
        numbers = self._numbers.get(keyframe.log, ())
        number = numbers[keyframe.index] if keyframe.index < len(numbers) else 0
        record = self.record_at(keyframe.log, number) if number and self.record_at is not None else None
        return record if isinstance(record, LatentRecord) else None


class Latents:
    """The latents of one robot's store, fetches under way, and wishes of others."""

    def __init__(self, own: LogId, parameters: LoopClosingParameters) -> None:
        self.names = LatentNames()
        self._own = own
        self._parameters = parameters
        self._held = KeyframeSet()
        self._fetches: dict[KeyframeId, _Fetch] = {}
        self._relayed: dict[KeyframeId, Relayed] = {}
        self._wished_s: dict[KeyframeId, float] = {}
        self._lost_until_s: dict[KeyframeId, float] = {}
        self._outdated: dict[KeyframeId, None] = {}

    def __contains__(self, keyframe: object) -> bool:
        return keyframe in self._held

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return {
            "relayed": (len(self._relayed), RELAYS_MAX),
            "wished for": (len(self._wished_s), PAUSED_MAX),
            "lost": (len(self._lost_until_s), RELAYS_MAX),
            "fetches": (len(self._fetches), PAUSED_MAX + self._parameters.fetches_max),
            "outdated fetches": (len(self._outdated), PAUSED_MAX),
        }

    def add(self, keyframe: KeyframeId) -> None:
        """A latent is in this robot's store."""
        self._held.add(keyframe)
        self._fetches.pop(keyframe, None)
        relayed = self._relayed.get(keyframe)
        if relayed is not None:
            relayed.is_here, relayed.offered_until_s = True, None

    def remove(self, keyframe: KeyframeId) -> None:
        """The store evicted a latent."""
        self._held.discard(keyframe)
        if keyframe in self._relayed:
            self._relayed[keyframe].is_here = False

    def on_withdrawn(self, keyframe: KeyframeId) -> None:
        """A latent was made anew by its owner: it is fetched again, and what a fetch under way brings is old."""
        self.remove(keyframe)
        fetch = self._fetches.get(keyframe)
        if fetch is not None and fetch.in_flight_until_s is not None:
            remember(self._outdated, keyframe, None, PAUSED_MAX)

    def is_outdated(self, keyframe: KeyframeId) -> bool:
        """Whether what a fetch brought was made anew meanwhile; told once."""
        is_old = keyframe in self._outdated
        self._outdated.pop(keyframe, None)
        return is_old

    def on_failed(self, keyframe: KeyframeId, now: float) -> None:
        """Wait before the next try, longer each time."""
        self._outdated.pop(keyframe, None)
        fetch = self._fetches.get(keyframe)
        if fetch is not None:
            fetch.in_flight_until_s = None
            doubled = max(2 * fetch.pause_s, RETRY_S)
            fetch.pause_s = min(doubled, RETRY_MAX_S)
            fetch.not_before_s = now + fetch.pause_s

    def on_reached(self, name: str) -> None:
        """A robot came into range: what it holds is tried at once, and it hears of what is here for it."""
        for relayed in self._relayed.values():
            if name in relayed.wishers:
                relayed.offered_until_s = None
        for keyframe, fetch in self._fetches.items():
            if keyframe.log.robot == name and fetch.in_flight_until_s is None:
                fetch.not_before_s, fetch.pause_s = float("-inf"), 0.0

    def on_lost(self, name: str) -> None:
        """A robot is out of range: what it was to deliver may be fetched elsewhere."""
        for fetch in self._fetches.values():
            if fetch.holder == name:
                fetch.in_flight_until_s = None

    def on_gone(self, keyframe: KeyframeId, now: float) -> None:
        """A latent exists no more, its owner or a robot nearer to it says: whoever wanted it here is told."""
        if keyframe in self._relayed:
            del self._relayed[keyframe]
            remember(self._lost_until_s, keyframe, now + LOST_S, RELAYS_MAX)

    def lost(self, now: float) -> tuple[KeyframeId, ...]:
        """Latents that neighbours want and that exist no more."""
        for keyframe in [k for k, until_s in self._lost_until_s.items() if until_s <= now]:
            del self._lost_until_s[keyframe]
        return tuple(self._lost_until_s)

    def on_wants(self, peer: str, wants: Iterable[KeyframeId], now: float) -> bool:
        """Latents that a neighbour cannot reach: hold them for it, newest wish last. Whether one was new.

        What came is held for a while, however many others are wished for, until who wished for it heard of it.
        """
        new = False
        for keyframe in wants:
            if keyframe in self._lost_until_s:
                self._lost_until_s[keyframe] = now + LOST_S
            elif keyframe.log != self._own:
                relayed = self._relayed.pop(keyframe, None)
                if relayed is None:
                    new, relayed = True, Relayed(now, keyframe in self._held)
                relayed.wished_s, relayed.offered_until_s = now, None
                remember(relayed.wishers, peer, None, WISHERS_MAX)
                self._relayed[keyframe] = relayed
        while len(self._relayed) > RELAYS_MAX:
            oldest = next(iter(self._relayed))
            del self._relayed[next((k for k, each in self._relayed.items() if not each.is_awaited(now)), oldest)]
        return new

    def wants(
        self, needed: Iterable[KeyframeId], reach: Reach, now: float, still: tuple[KeyframeId, ...] = ()
    ) -> tuple[KeyframeId, ...]:
        """A few of the needed latents, and of those relayed, that nobody in range can give.

        Those that are wished for `still`, then those whose last turn was longest ago: others have theirs every
        `WANTS_TURN_S`, so that latents which nobody can bring do not keep them waiting.
        """
        wanted = dict.fromkeys(k for k in (*needed, *self._relayed) if self.is_out_of_reach(k, reach))
        others = [keyframe for keyframe in wanted if keyframe not in still]
        others.sort(key=lambda keyframe: self._wished_s.get(keyframe, float("-inf")))
        wishes = (*still, *others)[:WANTS_MAX]
        for keyframe in wishes:
            remember(self._wished_s, keyframe, now, PAUSED_MAX)
        return wishes

    def is_out_of_reach(self, keyframe: KeyframeId, reach: Reach) -> bool:
        """Whether a latent is not here and nobody in range can give it."""
        return keyframe not in self._held and keyframe.log != self._own and reach.holder(keyframe) is None

    def holds(self, now: float) -> tuple[KeyframeId, ...]:
        """Latents of others that this robot holds because somebody wanted them, as far as that is to be told now."""
        return tuple(k for k, relayed in self._relayed.items() if relayed.is_offered(now))

    def free(self) -> int:
        """How many more fetches may start."""
        return self._parameters.fetches_max - sum(f.in_flight_until_s is not None for f in self._fetches.values())

    def fetch(self, needed: Iterable[KeyframeId], reach: Reach, now: float) -> list[Effect]:
        """Start fetches, in the given order and relayed ones last, as many as may be in flight."""
        free = self.free()
        effects: list[Effect] = []
        for_others = (k for k, relayed in self._relayed.items() if not relayed.is_here)
        for keyframe in chain(needed, for_others) if free > 0 else ():
            if len(effects) >= free:
                break
            holder = self._may_fetch(keyframe, reach, now)
            if holder is not None:
                fetch = self._fetches.setdefault(keyframe, _Fetch())
                fetch.holder, fetch.in_flight_until_s = holder, now + self._parameters.fetch_timeout_s
                effects.append(FetchLatent(keyframe, holder, self._parameters.fetch_timeout_s, self.names.of(keyframe)))
        self._forget_oldest()
        return effects

    def give_up(self, now: float) -> None:
        """Forget fetches that gave no answer, so that they are tried again."""
        for keyframe, fetch in self._fetches.items():
            if fetch.in_flight_until_s is not None and fetch.in_flight_until_s <= now:
                self.on_failed(keyframe, now)

    def due_s(self, now: float) -> float:
        """When a fetch ends or may be tried again."""
        times = (fetch.due_s() for fetch in self._fetches.values())
        return min((time for time in times if time > now), default=float("inf"))

    def _may_fetch(self, keyframe: KeyframeId, reach: Reach, now: float) -> str | None:
        """Whom to ask for a latent now, if anybody."""
        if keyframe in self._held or keyframe.log == self._own:
            return None
        fetch = self._fetches.get(keyframe)
        if fetch is not None and (fetch.in_flight_until_s is not None or fetch.not_before_s > now):
            return None
        return reach.holder(keyframe)

    def _forget_oldest(self) -> None:
        """Pauses of latents that nobody may need any more are not kept for ever."""
        idle = [k for k, fetch in self._fetches.items() if fetch.in_flight_until_s is None]
        for keyframe in idle[: max(0, len(idle) - PAUSED_MAX)]:
            del self._fetches[keyframe]
