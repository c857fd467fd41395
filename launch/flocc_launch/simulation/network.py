"""The links between simulated robots: every message is encoded, priced by its size, carried by the radio, decoded."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from flocc_agent.radio import Radio
from flocc_launch.simulation.agenda import Agenda
from flocc_protocol.messages import Envelope, decode, encode, kind_of

Receive = Callable[[str, Envelope], None]


@dataclass(slots=True)
class Traffic:
    """Bytes of one robot by kind, since the run began."""

    sent: Counter[str] = field(default_factory=Counter)
    received: Counter[str] = field(default_factory=Counter)


class Network:
    """Carries messages between stations. A station is one running robot; two may share a robot's name.

    Attributes:
        traffic: By station.
        muted: Kind of message -> probability that the air swallows it, on top of the radio's losses.
    """

    def __init__(self, agenda: Agenda, radio: Radio, receive: Receive, rng: np.random.Generator) -> None:
        self.traffic: dict[str, Traffic] = {}
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
        now_s = self._agenda.now_s
        arrivals: dict[float, list[str]] = {}
        muted = self.muted.get(kind, 0.0)
        for receiver in receivers:
            if muted and self._rng.uniform() < muted:
                continue
            for time_s in self._radio.transmit(sender, receiver, kind, len(data), now_s):
                arrivals.setdefault(time_s, []).append(receiver)
        for time_s, together in arrivals.items():
            self._agenda.at(time_s, lambda together=together: self._arrive(together, kind, packet))  # type: ignore[misc]

    def carry(self, sender: str, receiver: str, kind: str, size_bytes: int, arrive: Callable[[], None]) -> None:
        """Carry something that is no message, such as a piece of a latent."""
        self._traffic(sender).sent[kind] += size_bytes
        for time_s in self._radio.transmit(sender, receiver, kind, size_bytes, self._agenda.now_s):
            self._agenda.at(time_s, lambda: self._carried(receiver, kind, size_bytes, arrive))

    def _carried(self, receiver: str, kind: str, size_bytes: int, arrive: Callable[[], None]) -> None:
        self._traffic(receiver).received[kind] += size_bytes
        arrive()

    def _arrive(self, receivers: list[str], kind: str, packet: "_Packet") -> None:
        for receiver in receivers:
            self._traffic(receiver).received[kind] += len(packet.data)
            self._receive(receiver, packet.envelope())

    def _traffic(self, station: str) -> Traffic:
        traffic = self.traffic.get(station)
        if traffic is None:
            traffic = self.traffic[station] = Traffic()
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
