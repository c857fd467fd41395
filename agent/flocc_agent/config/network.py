"""Addresses: where a robot listens, whom it dials, with which keys, and where its figures are served."""

import re
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, model_validator

from flocc_agent.config.section import ConfigError, Section, inner
from flocc_protocol.ids import NAME_PATTERN

ENDPOINT_PATTERN = re.compile(r"(tcp|tls|quic|udp)/(\[[0-9a-fA-F:.]+\]|[^/:#?\s]+):([0-9]{1,5})([#?]\S*)?")


PORT_MAX = 65535


def checked_endpoint(text: str) -> str:
    """Return the endpoint, or say how one looks.

    Raises:
        ValueError: Not PROTOCOL/HOST:PORT.
    """
    match = ENDPOINT_PATTERN.fullmatch(text)
    if match is None or int(match[3]) > PORT_MAX:
        raise ValueError(f"{text!r} is no endpoint; one looks like tcp/10.0.0.7:7447 or tls/[::]:0#iface=wlan0")
    return text


Endpoint = Annotated[str, AfterValidator(checked_endpoint)]


def checked_group(text: str) -> str:
    """Return the address of a multicast group, or say how one looks.

    Raises:
        ValueError: Not GROUP:PORT, or there is no next port.
    """
    group, _, port = text.rpartition(":")
    if not _is_multicast(group) or not port.isdecimal() or not 1 <= int(port) < PORT_MAX:
        raise ValueError(f"{text!r} is no multicast address; one looks like 224.0.0.224:7446")
    return text


def _is_multicast(group: str) -> bool:
    try:
        return ip_address(group.removeprefix("[").removesuffix("]")).is_multicast
    except ValueError:
        return False


UNNAMED_SWARM = "swarm"
"""What a swarm is called that nobody gave a name."""


class PeerEndpoints(Section):
    """Where one known robot listens."""

    control: tuple[Endpoint, ...] = ()
    """Its control session: heartbeats, records, elections, corrections."""
    bulk: tuple[Endpoint, ...] = ()
    """Its bulk session: latents."""


class TlsConfig(Section):
    """Mutual TLS, one writer per key, and signed records: with the folder that `flocc keys` made for this robot."""

    folder: Path
    """Holds ca.crt, robot.crt, robot.key, signing.key and members.json."""


class TransportConfig(Section):
    """How a robot reaches others over zenoh. Latents have their own session, so that they never delay heartbeats."""

    control_listen: tuple[Endpoint, ...] = ("tcp/0.0.0.0:0",)
    """Where this robot listens for control; port 0 takes a free one, for which scouting must be on. With tls: tls/."""
    bulk_listen: tuple[Endpoint, ...] = ("tcp/0.0.0.0:0",)
    """Where this robot listens for latents."""
    roster: dict[str, PeerEndpoints] = Field(default_factory=dict)
    """Known robots by name. Of each pair the higher name dials, for ever, also after a partition."""
    multicast: bool = True
    """Find robots of the same network by multicast, once `swarm` has a name; many Wi-Fi access points drop it."""
    multicast_address: Annotated[str, AfterValidator(checked_group)] = "224.0.0.224:7446"
    """Group and port for finding control sessions, bulk is at the next port; swarms on one network may differ."""
    interface: str = "auto"
    """Network interface of multicast: auto, or one such as wlan0 (lo on a single machine)."""
    gossip: bool = True
    """Learn robots from robots; such links are not dialled again after a cut, the roster's are."""
    lease_s: float = Field(3.0, ge=1.0)
    """A silent TCP link is given up after this; at least twice the outage to ride through, more under load."""
    bulk_send_buffer_bytes: int = inner(65536, ge=4096)
    """Kernel buffer of the bulk session; larger is faster on long links and delays control more on slow ones."""
    message_bytes_max: int = inner(1024 * 1024, ge=1024)
    """Larger messages are neither sent nor accepted; latents have their own limit."""
    latent_bytes_max: int = inner(8 * 1024 * 1024, ge=1024)
    """Larger latents are neither served nor fetched."""
    chunk_bytes: int = inner(256 * 1024, ge=1024, le=4 * 1024 * 1024)
    """A latent travels in pieces of this size; a fetch that was cut goes on with the piece that is missing."""
    inbox_messages_max: int = inner(4096, ge=16)
    """Messages of one kind that wait for the robot; the oldest is dropped for a new one."""
    peers_max: int = inner(256, ge=1)
    """Different senders; messages of any further one are dropped."""
    peer_messages_per_s: float = inner(2000.0, gt=0)
    """What one sender may sustain, with bursts of two seconds' worth; the rest is dropped and counted."""
    peer_bytes_per_s: float = inner(16.0 * 1024 * 1024, gt=0)
    """The same in bytes."""
    tls: TlsConfig | None = None
    """Mutual TLS and one writer per key; None is for trusted networks and emulation."""
    chaos: bool = False
    """Take orders of `flocc chaos`: partitions, loss, kills. For tests; without tls anybody in reach may order."""

    def scouts(self, swarm: str) -> bool:
        """Whether others are looked for by multicast: two teams that nobody named must not become one.

        With keys they cannot.
        """
        return self.multicast and (swarm != UNNAMED_SWARM or self.tls is not None)

    def multicast_group(self, control: bool) -> str:
        """Where control sessions, or bulk sessions, find each other."""
        group, _, port = self.multicast_address.rpartition(":")
        return self.multicast_address if control else f"{group}:{int(port) + 1}"

    @model_validator(mode="before")
    @classmethod
    def _listens_as_tls_asks(cls, given: Any) -> Any:
        """Where tls is asked for and no endpoint is named, the usual ones are of tls."""
        if not isinstance(given, dict) or given.get("tls") is None:
            return given
        return {"control_listen": ("tls/0.0.0.0:0",), "bulk_listen": ("tls/0.0.0.0:0",), **given}

    @model_validator(mode="after")
    def _is_consistent(self) -> "TransportConfig":
        misnamed = [name for name in self.roster if not NAME_PATTERN.fullmatch(name)]
        if misnamed:
            raise ValueError(f"the roster's {misnamed[0]!r} cannot be a robot's name")
        endpoints = [*self.control_listen, *self.bulk_listen]
        twice = [e for e in endpoints if endpoints.count(e) > 1 and not e.endswith(":0")]
        if twice:
            raise ValueError(f"{twice[0]!r} is listened at twice; control and bulk have sessions of their own")
        endpoints += [e for peer in self.roster.values() for e in (*peer.control, *peer.bulk)]
        wrong = [e for e in endpoints if not e.startswith("tls/")] if self.tls else []
        if wrong:
            raise ValueError(f"with tls every endpoint begins with tls/, but there is {wrong[0]!r}")
        return self


class MetricsConfig(Section):
    """Figures for Prometheus (docs/metrics.md); needs the extra `metrics`."""

    port: int | None = Field(None, ge=1, le=PORT_MAX)
    """Where `/metrics` is served over HTTP; None serves nothing."""
    host: str = "127.0.0.1"
    """Address that is listened on; 0.0.0.0 lets other machines scrape. There is neither encryption nor a password."""

    @classmethod
    def at(cls, text: str, robots: int = 1) -> "tuple[MetricsConfig, ...]":
        """Read [HOST:]PORT, and take one port after the other for several robots.

        Raises:
            ConfigError: It is not that, or the ports do not suffice.
        """
        host, _, port = text.rpartition(":")
        if not port.isdecimal() or not 1 <= int(port) <= PORT_MAX:
            raise ConfigError(f"metrics: {text!r} is not [HOST:]PORT, such as 9100 or 0.0.0.0:9100")
        if int(port) + robots - 1 > PORT_MAX:
            raise ConfigError(f"metrics: from port {port} there are no ports for {robots} robots")
        known = {"host": host.strip("[]")} if host else {}
        return tuple(cls(port=int(port) + k, **known) for k in range(robots))
