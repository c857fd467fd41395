"""Who is in range: robots whose heartbeats were heard lately. Heartbeats, not the transport, are the truth."""

from dataclasses import dataclass

from flocc_agent.core.effects import Effect, Report
from flocc_agent.core.parameters import NeighbourParameters
from flocc_agent.core.reports import NameTaken, NeighbourRestarted, NeighbourUp, PeerRefused
from flocc_protocol.ids import LogId, Term
from flocc_protocol.messages import HOPS_MAX, Heartbeat

LOSS_WEIGHT = 0.05
"""How much one heartbeat weighs in the running share of lost ones: about the last twenty count."""

SETTLED_S = 1.0
"""A robot that came into range less than this ago wrote most of what it has before it could be heard."""


@dataclass(slots=True)
class Neighbour:
    """A robot in range: its log, its last heartbeat and when it came, since when, and the share of heartbeats lost."""

    log: LogId
    heartbeat: Heartbeat
    heard_s: float
    since_s: float
    previous_boot: int | None = None
    loss_ratio: float = 0.0

    def count_lost(self, heartbeat: Heartbeat) -> None:
        """Weigh in what the numbers of two heartbeats of one start show; one that came late or twice shows nothing."""
        missing = heartbeat.sequence - self.heartbeat.sequence - 1
        if heartbeat.boot == self.heartbeat.boot and missing >= 0:
            kept = (1.0 - LOSS_WEIGHT) ** missing
            self.loss_ratio = (1.0 - LOSS_WEIGHT) * (1.0 - kept * (1.0 - self.loss_ratio))


def _hops(neighbour: Neighbour, term: Term) -> int:
    """Robots between a neighbour and the leader of a term; more than there may be where it follows another one."""
    if neighbour.log == term.leader:
        return -1
    advert = neighbour.heartbeat.leader
    return advert.hops if advert is not None and advert.term == term else HOPS_MAX + 1


class Neighbours:
    """The table of robots in range, by name."""

    def __init__(self, own: LogId, boot: int, parameters: NeighbourParameters) -> None:
        self._own = own
        self._boot = boot
        self._parameters = parameters
        self._by_name: dict[str, Neighbour] = {}
        self._duplicates: set[str] = set()
        self._due_s = float("inf")

    def __len__(self) -> int:
        return len(self._by_name)

    def __contains__(self, name: str) -> bool:
        return name in self._by_name

    def get(self, name: str) -> Neighbour | None:
        """The neighbour of that name, or None where it is not in range."""
        return self._by_name.get(name)

    def was_near(self, name: str, now: float) -> bool:
        """Whether a robot was in range already before what it broadcasts now can have been lost on the way."""
        known = self._by_name.get(name)
        return known is not None and known.since_s + SETTLED_S <= now

    def towards(self, term: Term) -> list[str]:
        """Robots in range: the leader of a term, those that follow it over ever more robots, then all others."""
        away = {name: _hops(neighbour, term) for name, neighbour in self._by_name.items()}
        return sorted(away, key=lambda name: (away[name], name))

    def is_double(self, name: str) -> bool:
        """Whether two robots were heard under this name."""
        return name in self._duplicates

    def doubles(self) -> tuple[str, ...]:
        """Names under which two robots were heard, this robot's own among them, sorted."""
        return tuple(sorted(self._duplicates))

    def names(self) -> list[str]:
        """Names of all robots in range, sorted."""
        return sorted(self._by_name)

    def loss_ratios(self) -> dict[str, float]:
        """Share of the last heartbeats of each robot in range that did not arrive, by name."""
        return {name: self._by_name[name].loss_ratio for name in self.names()}

    def on_heartbeat(self, sender: LogId, heartbeat: Heartbeat, now: float) -> list[Effect]:
        """Note a heartbeat; report a new neighbour, a restarted one, or two robots that share a name."""
        if sender.robot == self._own.robot:
            return self._name_taken(sender, heartbeat)
        known = self._by_name.get(sender.robot)
        if known is None:
            if len(self._by_name) >= self._parameters.neighbours_max:
                return [Report(PeerRefused(peer=sender.robot, reason="too many neighbours"))]
            self._by_name[sender.robot] = Neighbour(sender, heartbeat, now, now)
            self._due_s = min(self._due_s, self._expires_s(sender.robot))
            return [Report(NeighbourUp(peer=sender.robot, log=sender))]
        effects = self._restarted(known, sender, heartbeat)
        known.count_lost(heartbeat)
        known.log, known.heartbeat, known.heard_s = sender, heartbeat, now
        return effects

    def tick(self, now: float) -> list[str]:
        """Drop robots that were silent for too long; their names, sorted."""
        if now < self._due_s:
            return []
        gone = [name for name in self.names() if self._expires_s(name) <= now]
        for name in gone:
            del self._by_name[name]
            self._duplicates.discard(name)
        self._due_s = min((self._expires_s(name) for name in self._by_name), default=float("inf"))
        return gone

    def deadline(self) -> float:
        """When a neighbour may have to be dropped; one that was heard meanwhile stays."""
        return self._due_s

    def _expires_s(self, name: str) -> float:
        return self._by_name[name].heard_s + self._parameters.timeout_s

    def _restarted(self, known: Neighbour, sender: LogId, heartbeat: Heartbeat) -> list[Effect]:
        """A new boot is a restart; the old boot heard once more means that two robots share the name."""
        if heartbeat.boot == known.heartbeat.boot:
            return []
        returns = heartbeat.boot == known.previous_boot
        known.previous_boot = known.heartbeat.boot
        if not returns:
            return [Report(NeighbourRestarted(peer=sender.robot, log=sender))]
        return self._report_duplicate(sender, "two robots run with this name")

    def _name_taken(self, sender: LogId, heartbeat: Heartbeat) -> list[Effect]:
        if heartbeat.boot == self._boot:
            return []
        return self._report_duplicate(sender, "another robot runs with this robot's name")

    def _report_duplicate(self, sender: LogId, sentence: str) -> list[Effect]:
        if sender.robot in self._duplicates:
            return []
        self._duplicates.add(sender.robot)
        return [Report(NameTaken(peer=sender.robot, log=sender, reason=sentence))]
