"""A passive observer on zenoh: a session that subscribes to what robots broadcast, and does nothing else.

It listens nowhere, publishes nothing, asks nothing and shows no liveliness token, so that no robot takes it for a peer.
What it costs is one more copy of each broadcast on the wire (docs/doctor.md has the figures). Its queue is bounded; an
observer that is too slow loses the oldest messages, never the robots theirs.
"""

import threading
from collections import deque
from types import TracebackType

import zenoh

from flocc_agent.config import TransportConfig
from flocc_agent.runtime.zenoh_admin import OPERATOR, endpoints_to_dial
from flocc_agent.runtime.zenoh_session import Plane, open_session, session_settings
from flocc_protocol import keys
from flocc_protocol.errors import DecodeError
from flocc_protocol.messages import Envelope, decode, kind_of

WAITING_MAX = 8192
KINDS = (keys.Kind.HEARTBEAT, keys.Kind.RECORDS, keys.Kind.CORRECTION)


class Observer:
    """Hears a swarm's broadcasts; use it as a context manager.

    Attributes:
        swarm: Name of the swarm.
        signed: Whether records end in a signature.
        payload_bytes: What robots sent it so far; their whole cost of being watched.
    """

    def __init__(self, config: TransportConfig, swarm: str, kinds: tuple[keys.Kind, ...] = KINDS) -> None:
        """Prepare.

        Args:
            config: How to reach the swarm: its roster, or scouting; with TLS the operator's folder.
            swarm: Name of the swarm.
            kinds: What to listen to.
        """
        self.swarm = swarm
        self.signed = config.tls is not None
        self.payload_bytes = 0
        self._config = config
        self._kinds = kinds
        self._waiting: deque[tuple[str, str, bytes]] = deque(maxlen=WAITING_MAX)
        self._lock = threading.Lock()
        self._session: zenoh.Session | None = None

    def __enter__(self) -> "Observer":
        """Join.

        Raises:
            TransportError: The network cannot be used as configured.
        """
        settings = session_settings(self._config, self.swarm, OPERATOR, Plane.CONTROL, dials_all=True)
        dialled = endpoints_to_dial(self._config, settings)
        self._session = open_session(settings | {"listen/endpoints": [], "connect/endpoints": dialled}, "observer")
        for kind in self._kinds:
            self._session.declare_subscriber(keys.kind_pattern(self.swarm, kind), self._enqueue)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Leave."""
        if self._session is not None:
            self._session.close()
            self._session = None

    def heard(self) -> list[Envelope]:
        """What was said since the last call; what cannot be read, or came under another's key, is left out."""
        with self._lock:
            waiting = list(self._waiting)
            self._waiting.clear()
        return [envelope for entry in waiting if (envelope := _read(*entry)) is not None]

    def _enqueue(self, sample: zenoh.Sample) -> None:
        try:
            address = keys.parse_message_key(str(sample.key_expr))
        except DecodeError:
            return
        payload = sample.payload.to_bytes()
        with self._lock:
            self.payload_bytes += len(payload)
            self._waiting.append((address.sender, address.kind, payload))


def _read(sender: str, kind: str, payload: bytes) -> Envelope | None:
    try:
        envelope = decode(payload)
    except DecodeError:
        return None
    return envelope if (envelope.sender.robot, kind_of(envelope.message)) == (sender, kind) else None
