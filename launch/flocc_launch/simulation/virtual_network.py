"""The links between simulated robots: every message is encoded, priced by its size, carried by the radio, decoded."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from flocc_agent.radio import Radio
from flocc_launch.simulation.agenda import Agenda
from flocc_protocol.messages import Envelope, decode, encode, kind_of

Receive = Callable[[str, Envelope], bool]
"""Hands a message to a station; whether it was switched on."""

Link = tuple[str, str, str]
"""Sender, receiver and kind of message."""


@dataclass(slots=True)
class RobotTraffic:
    """Bytes of one robot by kind, since the run began; a broadcast counts once."""

    sent: Counter[str] = field(default_factory=Counter)
    received: Counter[str] = field(default_factory=Counter)


@dataclass(slots=True)
class LinkCounts:
    """Payload bytes of one kind on one link.

    At every moment `sent + repeated == received + lost + under_way`.

    Attributes:
        sent: Given to the radio for one receiver; a broadcast counts once per receiver.
        received: Reached a robot.
        lost: Lost by the radio, or arrived where nobody was switched on.
        repeated: Copies that the radio made.
        under_way: Has left and is to arrive.
    """

    sent: int = 0
    received: int = 0
    lost: int = 0
    repeated: int = 0
    under_way: int = 0

    def leave(self, payload_bytes: int, arrivals: int) -> None:
        """Something was given to the radio, and will arrive so many times."""
        self.sent += payload_bytes
        if arrivals == 1:
            self.under_way += payload_bytes
        elif arrivals == 0:
            self.lost += payload_bytes
        else:
            self.under_way += payload_bytes * arrivals
            self.repeated += payload_bytes * (arrivals - 1)

    def arrive(self, payload_bytes: int, taken: bool) -> None:
        """Something arrived; whether somebody was there."""
        self.under_way -= payload_bytes
        if taken:
            self.received += payload_bytes
        else:
            self.lost += payload_bytes


@dataclass(slots=True)
class LinkTraffic:
    """Payload bytes on all links, since the run began."""

    counts: dict[Link, LinkCounts] = field(default_factory=dict)

    def of(self, link: Link) -> LinkCounts:
        """What one link carried of one kind."""
        counts = self.counts.get(link)
        if counts is None:
            counts = self.counts[link] = LinkCounts()
        return counts

    def tables(self, robot: str) -> dict[str, dict[str, dict[str, int]]]:
        """One robot's account, as an agent of its own would keep it: by table, peer and kind."""
        tables: dict[str, dict[str, dict[str, int]]] = {
            table: {} for table in ("sent_to", "received_from", "lost_from", "repeated_from")
        }
        for (sender, receiver, kind), counts in sorted(self.counts.items()):
            if sender == robot:
                _note(tables["sent_to"], receiver, kind, counts.sent)
            if receiver == robot:
                _note(tables["received_from"], sender, kind, counts.received)
                _note(tables["lost_from"], sender, kind, counts.lost)
                _note(tables["repeated_from"], sender, kind, counts.repeated)
        return tables


def _note(table: dict[str, dict[str, int]], peer: str, kind: str, count: int) -> None:
    if count:
        table.setdefault(peer, {})[kind] = count


class Network:
    """Carries messages between stations. A station is one running robot; two may share a robot's name.

    Attributes:
        traffic: By station.
        links: By link and kind.
        muted: Kind of message -> probability that the air swallows it, on top of the radio's losses.
    """

    def __init__(self, agenda: Agenda, radio: Radio, receive: Receive, rng: np.random.Generator) -> None:
        self.traffic: dict[str, RobotTraffic] = {}
        self.links = LinkTraffic()
        self.muted: dict[str, float] = {}
        self._rng = rng
        self._agenda = agenda
        self._radio = radio
        self._receive = receive

    def send(self, sender: str, envelope: Envelope, receivers: Iterable[str]) -> None:
        """Send one message to several stations; the bytes are decoded once, since they are the same for all."""
        data = encode(envelope)
        kind, size = kind_of(envelope.message), len(data)
        self._traffic(sender).sent[kind] += size
        packet = _Packet(data, kind)
        arrivals: dict[float, list[tuple[str, LinkCounts]]] = {}
        muted = self.muted.get(kind, 0.0)
        for receiver in receivers:
            counts = self.links.of((sender, receiver, kind))
            silenced = bool(muted) and self._rng.uniform() < muted
            times_s = [] if silenced else self._radio.transmit(sender, receiver, kind, size, self._agenda.now_s)
            counts.leave(size, len(times_s))
            for time_s in times_s:
                arrivals.setdefault(time_s, []).append((receiver, counts))
        for time_s, together in arrivals.items():
            self._agenda.at(time_s, partial(self._arrive, together, packet))

    def carry(
        self, sender: str, receiver: str, kind: str, payload_bytes: int, air_bytes: int, arrive: Callable[[], bool]
    ) -> None:
        """Carry something that is no message, such as a piece of a latent.

        Args:
            sender: Station that speaks.
            receiver: Station that may hear.
            kind: What it is.
            payload_bytes: What is counted.
            air_bytes: What the radio carries: the payload and what stands around it.
            arrive: Called at its arrival; whether somebody was there.
        """
        if payload_bytes:
            self._traffic(sender).sent[kind] += payload_bytes
        counts = self.links.of((sender, receiver, kind))
        times_s = self._radio.transmit(sender, receiver, kind, air_bytes, self._agenda.now_s)
        counts.leave(payload_bytes, len(times_s))
        for time_s in times_s:
            self._agenda.at(time_s, lambda: self._settle(receiver, kind, counts, payload_bytes, arrive()))

    def used_bytes(self, station: str) -> int:
        """What a robot used of its budget: its messages, sent and received, and the latents that it fetched."""
        traffic = self._traffic(station)
        return sum(traffic.received.values()) + sum(traffic.sent.values()) - traffic.sent["latent"]

    def lasts_s(self, sender: str, receiver: str, air_bytes: int) -> float:
        """How long a link is occupied by something at least."""
        rate = self._radio.parameters.of(sender, receiver).bandwidth_bytes_s
        return 0.0 if rate is None else air_bytes / rate

    def _arrive(self, together: list[tuple[str, LinkCounts]], packet: "_Packet") -> None:
        for receiver, counts in together:
            taken = self._receive(receiver, packet.envelope())
            self._settle(receiver, packet.kind, counts, len(packet.data), taken)

    def _settle(self, receiver: str, kind: str, counts: LinkCounts, payload_bytes: int, taken: bool) -> None:
        """Something arrived."""
        counts.arrive(payload_bytes, taken)
        if taken and payload_bytes:
            self._traffic(receiver).received[kind] += payload_bytes

    def _traffic(self, station: str) -> RobotTraffic:
        traffic = self.traffic.get(station)
        if traffic is None:
            traffic = self.traffic[station] = RobotTraffic()
        return traffic


@dataclass(slots=True)
class _Packet:
    """Bytes on the way, and what they say once somebody asked."""

    data: bytes
    kind: str
    decoded: Envelope | None = None

    def envelope(self) -> Envelope:
        if self.decoded is None:
            self.decoded = decode(self.data)
        return self.decoded
