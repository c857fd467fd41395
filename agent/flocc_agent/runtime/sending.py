"""Messages on their way out: encoded, own records batched, in the order in which the core sent them."""

from collections.abc import Callable

from flocc_agent.core.robot import Robot
from flocc_agent.runtime.outbox import Outbox
from flocc_agent.runtime.punctuality import LongestGap
from flocc_agent.runtime.transport import Transport
from flocc_protocol.keys import Kind
from flocc_protocol.messages import Envelope, Message, RecordBatch, Records, encode, kind_of


class Sender:
    """Sends one robot's messages.

    Attributes:
        heartbeat_gap: How far own heartbeats were apart.
    """

    def __init__(self, robot: Robot, transport: Transport, clock_s: Callable[[], float]) -> None:
        self._robot = robot
        self._transport = transport
        self._clock_s = clock_s
        self._outbox = Outbox()
        self.heartbeat_gap = LongestGap()

    def broadcast(self, message: Message) -> None:
        """Send to everybody in range: own records now or with those that follow, before whatever else is sent."""
        match message:
            case Records(batches=(batch,)) if batch.log == self._robot.log:
                self._send_later(batch)
            case _:
                self.send_records()
                self._send(message, None)

    def unicast(self, to: str, message: Message) -> None:
        """Send to one robot."""
        self._send(message, to)

    def due_s(self) -> float:
        """When own records that wait are to be sent."""
        return self._outbox.due_s()

    def send_due_records(self) -> None:
        """Broadcast own records whose pause is over."""
        if self._outbox.due_s() <= self._clock_s():
            self.send_records()

    def send_records(self) -> None:
        """Broadcast own records that wait."""
        waiting = self._outbox.take(len(self._robot.neighbours.names()), self._clock_s())
        if waiting is not None:
            self._send(waiting, None)

    def _send_later(self, batch: RecordBatch) -> None:
        too_long = self._outbox.add(batch)
        if too_long is not None:
            self._send(too_long, None)
        self.send_due_records()

    def _send(self, message: Message, to: str | None) -> None:
        payload, kind = encode(Envelope(self._robot.log, message)), kind_of(message)
        if kind == Kind.HEARTBEAT.value:
            self.heartbeat_gap.mark(kind, self._clock_s())
        if to is None:
            self._transport.broadcast(kind, payload)
        else:
            self._transport.unicast(to, kind, payload)
