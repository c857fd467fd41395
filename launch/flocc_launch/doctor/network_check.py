"""Findings of the network: ports, and whether zenoh peers on this machine find each other in every way flocc uses."""

import socket
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from typing import Any

from flocc_agent.config import TransportConfig
from flocc_launch.doctor.finding import Finding, Severity, good
from flocc_protocol.errors import FloccError

DISCOVERY_S_MAX = 5.0


def ports(config: TransportConfig) -> list[Finding]:
    """Whether the ports to listen on are free."""
    found: list[Finding] = []
    for endpoint in (*config.control_listen, *config.bulk_listen):
        host, _, port = endpoint.rpartition("/")[2].rpartition(":")
        if endpoint.startswith(("tcp/", "tls/")) and port.isdigit() and int(port):
            problem = port_problem(host.strip("[]"), int(port))
            advice = "Stop the program that listens there, or choose another port in the agent's configuration."
            if problem is not None:
                found.append(Finding("port", Severity.BLOCKS, f"{endpoint} cannot be listened on: {problem}.", advice))
    return found or [good("port", "The ports to listen on are free.")]


def configured_network(config: TransportConfig) -> list[Finding]:
    """Whether the interfaces and hosts that the configuration names are there, and its certificates hold."""
    from flocc_agent.runtime.certificate_faults import certificate_faults
    from flocc_agent.runtime.network_faults import network_faults

    keys = "Make it with 'flocc keys' where the swarm's authority is, and bring it here."
    advice = "Bring it up, or change it in [transport] of the agent's configuration; an agent goes on trying meanwhile."
    keyless = config.model_copy(update={"tls": None})
    return [
        *(Finding("certificate", Severity.HINDERS, _said(fault), keys) for fault in certificate_faults(config.tls)),
        *(Finding("network", Severity.HINDERS, _said(fault), advice) for fault in network_faults(keyless, "")),
    ]


def _said(fault: str) -> str:
    return f"{fault[0].upper()}{fault[1:]}."


def port_problem(host: str, port: int) -> str | None:
    """Why a TCP port cannot be bound; None where it can."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            return error.strerror or str(error)
    return None


def discovery(config: TransportConfig) -> list[Finding]:
    """Whether zenoh peers on this machine find each other: by multicast, by gossip of a third, by an endpoint.

    Without keys: it is the machine's network that is asked, and the peers are of no swarm that a list of members names.
    """
    found = []
    config = config.model_copy(update={"tls": None})
    if config.multicast:
        took_s = seconds_until(lambda: two_peers(config, by_multicast=True))
        advice = (
            "Many Wi-Fi access points and containers drop multicast: list the robots under [transport.roster], or set "
            "transport.interface."
        )
        found.append(discovered("multicast", "by multicast", took_s, Severity.HINDERS, advice))
    if config.gossip:
        took_s = seconds_until(lambda: by_gossip(config))
        advice = "List all robots under [transport.roster]; gossip alone does not join them on this machine."
        found.append(discovered("gossip", "through a third one that both know", took_s, Severity.HINDERS, advice))
    from flocc_agent.runtime.network_faults import loopback_fault

    fault = loopback_fault()
    advice = (
        "Look for a firewall on the loopback interface."
        if fault is None
        else f"127.0.0.1 cannot be reached ({fault}): bring the loopback interface up (ip link set lo up)."
    )
    took_s = seconds_until(lambda: two_peers(config, by_multicast=False))
    return [*found, discovered("endpoint", "by endpoint on 127.0.0.1", took_s, Severity.BLOCKS, advice)]


def discovered(cause: str, how: str, took_s: float | str, severity: Severity, advice: str) -> Finding:
    """What became of one way to find each other."""
    if isinstance(took_s, float):
        return good(cause, f"Two zenoh peers found each other {how} in {took_s:.2f} s.")
    return Finding(cause, severity, f"Two zenoh peers did not find each other {how}: {took_s}.", advice)


def seconds_until(connect: Callable[[], bool]) -> float | str:
    """How long connecting took, or why it failed."""
    began_s = time.monotonic()
    try:
        return time.monotonic() - began_s if connect() else f"nothing within {DISCOVERY_S_MAX:g} s"
    except FloccError as error:
        return str(error)


def two_peers(config: TransportConfig, by_multicast: bool) -> bool:
    """Open two sessions on this machine and wait until one sees the other.

    Raises:
        TransportError: A session cannot be opened.
    """
    port, other = free_port(), free_port()
    with ExitStack() as sessions:
        first = sessions.enter_context(peer(config, "a", port, [], by_multicast))
        second = sessions.enter_context(peer(config, "b", other, [] if by_multicast else [port], by_multicast))
        return sees(second, first)


def by_gossip(config: TransportConfig) -> bool:
    """Open two sessions that know a third one only, and wait until one sees the other.

    Raises:
        TransportError: A session cannot be opened.
    """
    known, left, right = free_port(), free_port(), free_port()
    with ExitStack() as sessions:
        sessions.enter_context(peer(config, "a", known, [], False))
        first = sessions.enter_context(peer(config, "b", left, [known], False))
        second = sessions.enter_context(peer(config, "c", right, [known], False))
        return sees(second, first)


def peer(config: TransportConfig, name: str, port: int, dialled: list[int], by_multicast: bool) -> "closing[Any]":
    """A session that listens on one port of this machine and dials others.

    Raises:
        TransportError: It cannot be opened.
    """
    from flocc_agent.runtime.zenoh_session import Plane, open_session, session_settings

    settings = session_settings(config, "doctor", name, Plane.CONTROL) | {
        "scouting/multicast/enabled": by_multicast,
        "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
        "connect/endpoints": [f"tcp/127.0.0.1:{dialled_port}" for dialled_port in dialled],
    }
    return closing(open_session(settings, "doctor"))


def sees(one: Any, other: Any) -> bool:
    """Wait until one session is linked to another."""
    deadline_s = time.monotonic() + DISCOVERY_S_MAX
    while time.monotonic() < deadline_s:
        if other.info.zid() in one.info.peers_zid():
            return True
        time.sleep(0.02)
    return False


def free_port() -> int:
    """A TCP port of 127.0.0.1 that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
