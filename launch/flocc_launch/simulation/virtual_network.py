"""The links between simulated robots: every message is encoded, priced by its size, carried by the radio, decoded."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

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
class LinkTraffic:
    """Payload bytes on all links, since the run began.

    On each link `sent + repeated == received + lost + under way` at every moment.

    Attributes:
        sent: Given to the radio for one receiver; a broadcast counts once per receiver.
        received: Reached a robot.
        lost: Lost by the radio, or arrived where nobody was switched on.
        repeated: Copies that the radio made.
        under_way: Has left and is to arrive.
    """

    sent: Counter[Link] = field(default_factory=Counter)
    received: Counter[Link] = field(default_factory=Counter)
    lost: Counter[Link] = field(default_factory=Counter)
    repeated: Counter[Link] = field(default_factory=Counter)
    under_way: Counter[Link] = field(default_factory=Counter)

    def tables(self, robot: str) -> dict[str, dict[str, dict[str, int]]]:
        """One robot's account, as an agent of its own would keep it: by table, peer and kind."""
        heard = {"received_from": self.received, "lost_from": self.lost, "repeated_from": self.repeated}
        tables: dict[str, dict[str, dict[str, int]]] = {"sent_to": {}, **{table: {} for table in heard}}
        for (sender, receiver, kind), count in sorted(self.sent.items()):
            if sender == robot:
                tables["sent_to"].setdefault(receiver, {})[kind] = count
        for table, counted in heard.items():
            for (sender, receiver, kind), count in sorted(counted.items()):
                if receiver == robot:
                    tables[table].setdefault(sender, {})[kind] = count
        return tables


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
        kind = kind_of(envelope.message)
        self._traffic(sender).sent[kind] += len(data)
        packet = _Packet(data)
        arrivals: dict[float, list[str]] = {}
        muted = self.muted.get(kind, 0.0)
        for receiver in receivers:
            silenced = bool(muted) and self._rng.uniform() < muted
            for time_s in self._transmit((sender, receiver, kind), len(data), len(data), silenced):
                arrivals.setdefault(time_s, []).append(receiver)
        for time_s, together in arrivals.items():
            self._agenda.at(time_s, lambda together=together: self._arrive(sender, together, kind, packet))  # type: ignore[misc]

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
        link = (sender, receiver, kind)
        for time_s in self._transmit(link, payload_bytes, air_bytes):
            self._agenda.at(time_s, lambda: self._settle(link, payload_bytes, arrive()))

    def used_bytes(self, station: str) -> int:
        """What a robot used of its budget: its messages, sent and received, and the latents that it fetched."""
        traffic = self._traffic(station)
        return sum(traffic.received.values()) + sum(traffic.sent.values()) - traffic.sent["latent"]

    def lasts_s(self, sender: str, receiver: str, air_bytes: int) -> float:
        """How long a link is occupied by something at least."""
        rate = self._radio.parameters.of(sender, receiver).bandwidth_bytes_s
        return 0.0 if rate is None else air_bytes / rate

    def _transmit(self, link: Link, payload_bytes: int, air_bytes: int, silenced: bool = False) -> list[float]:
        """Ask the radio when something arrives, and keep account."""
        arrivals_s = [] if silenced else self._radio.transmit(*link, air_bytes, self._agenda.now_s)
        if payload_bytes:
            self.links.sent[link] += payload_bytes
            if not arrivals_s:
                self.links.lost[link] += payload_bytes
            else:
                self.links.under_way[link] += payload_bytes * len(arrivals_s)
                if len(arrivals_s) > 1:
                    self.links.repeated[link] += payload_bytes * (len(arrivals_s) - 1)
        return arrivals_s

    def _arrive(self, sender: str, receivers: list[str], kind: str, packet: "_Packet") -> None:
        for receiver in receivers:
            taken = self._receive(receiver, packet.envelope())
            self._settle((sender, receiver, kind), len(packet.data), taken)

    def _settle(self, link: Link, payload_bytes: int, taken: bool) -> None:
        """Something arrived."""
        if not payload_bytes:
            return
        self.links.under_way[link] -= payload_bytes
        if taken:
            self.links.received[link] += payload_bytes
            self._traffic(link[1]).received[link[2]] += payload_bytes
        else:
            self.links.lost[link] += payload_bytes

    def _traffic(self, station: str) -> RobotTraffic:
        traffic = self.traffic.get(station)
        if traffic is None:
            traffic = self.traffic[station] = RobotTraffic()
        return traffic


@dataclass(slots=True)
class _Packet:
    """Bytes on the way, and what they say once somebody asked."""

    data: bytes
    decoded: Envelope | None = None

    def envelope(self) -> Envelope:
        if self.decoded is None:
            self.decoded = decode(self.data)
        return self.decoded
