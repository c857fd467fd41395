"""What of a configured network is not there: interfaces and hosts. zenoh goes on trying without a word."""

import fcntl
import re
import socket
import struct
from collections.abc import Iterator
from typing import Any

from flocc_agent.config import TransportConfig
from flocc_agent.runtime.addresses import is_address, is_ipv4, machine_addresses
from flocc_agent.runtime.certificate_faults import certificate_faults

LOOPBACK_S = 5.0
ROUTE_PORT = 9
"""Discard; a route does not depend on the port, and nothing is sent."""
_SIOCGIFFLAGS = 0x8913
_UP, _LOOPBACK, _MULTICAST = 0x1, 0x8, 0x1000


def found_by(config: TransportConfig, swarm: str) -> str:
    """How a robot finds others of its swarm: the first line of its log."""
    ways = []
    if config.scouts(swarm):
        ways.append(f"by multicast ({config.multicast_address})")
    if config.roster:
        ways.append(f"at the addresses of {len(config.roster)} robots (transport.roster)")
    found = f"swarm {swarm}: " + (f"others are found {' and '.join(ways)}" if ways else "waits for others to dial it")
    if lacks_name(config, swarm):
        found += '; the swarm has no name (swarm = "..."), so that it looks for nobody by multicast'
    return found


def lacks_name(config: TransportConfig, swarm: str) -> bool:
    """Whether a robot that is to scout does not, since nobody named its swarm."""
    return config.multicast and not config.scouts(swarm)


def network_faults(config: TransportConfig, robot: str) -> list[str]:
    """One sentence for each part of a network that is not there now; asks the resolver, and may take seconds."""
    return [*certificate_faults(config.tls), *interface_faults(config), *host_faults(config, robot)]


def interface_faults(config: TransportConfig) -> Iterator[str]:
    """Interfaces that do not exist, and no interface for multicast but the machine's own."""
    there = {name: _flags(name) for _, name in socket.if_nameindex()}
    told = ", ".join(there) or "none"
    if config.multicast and is_address(config.interface):
        if not _is_ours(config.interface):
            yield f"transport.interface: no interface of this machine has the address {config.interface}"
    elif config.multicast and config.interface != "auto":
        if config.interface not in there:
            yield f"transport.interface: the interface {config.interface!r} does not exist; there is {told}"
        elif not there[config.interface] & _UP:
            yield f"transport.interface: the interface {config.interface!r} is down"
    elif config.multicast and not config.roster and not any(_carries_multicast(flags) for flags in there.values()):
        yield f"no interface for multicast is up (there is {told}); nobody is found until one is"
    elif config.multicast and not config.roster and not config.multicast_address.startswith("["):
        yield from _without_ipv4(config, {name for name, flags in there.items() if _carries_multicast(flags)})
    endpoints = (*config.control_listen, *config.bulk_listen)
    named = {found[1]: endpoint for endpoint in endpoints if (found := re.search(r"[#;]iface=([^;#]+)", endpoint))}
    for name, endpoint in named.items():
        if name not in there:
            yield f"{endpoint}: the interface {name!r} does not exist; there is {told}"


def _without_ipv4(config: TransportConfig, up: set[str]) -> Iterator[str]:
    """Interfaces that are up with addresses of IPv6 alone, such as those of a link: nobody can join a group of IPv4."""
    here = machine_addresses()
    if not any(name in up and is_ipv4(address) for name, address in here):
        group = config.multicast_address.rpartition(":")[0]
        yield (
            f"no interface has an IPv4 address (up: {', '.join(sorted(up))}), and the group {group} is one of IPv4; "
            f"nobody is found until one has, 169.254.X.Y of its link or another"
        )


def host_faults(config: TransportConfig, robot: str) -> Iterator[str]:
    """Hosts of the roster that this robot dials and that have no address, or to which no way leads from here."""
    asked: set[str] = set()
    for name, peer in sorted(config.roster.items()):
        for endpoint in (*peer.control, *peer.bulk):
            host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
            if name == robot or host in asked:
                continue
            asked.add(host)
            told = f"transport.roster.{name}: the host {host!r}"
            try:
                found = socket.getaddrinfo(host, ROUTE_PORT, type=socket.SOCK_DGRAM)
            except OSError as error:
                yield f"{told} is not known ({error.strerror or error}); it is dialled again and again"
                continue
            faults = [_no_way(family, address) for family, _, _, _, address in found]
            if found and None not in faults:
                yield f"{told} cannot be reached ({faults[0]}); it is dialled again and again"


def loopback_fault() -> str | None:
    """Why programs on this machine do not reach each other over 127.0.0.1; None where they do."""
    try:
        with socket.create_server(("127.0.0.1", 0)) as server:
            socket.create_connection(server.getsockname(), LOOPBACK_S).close()
    except OSError as error:
        return error.strerror or str(error)
    return None


def with_faults(sentence: str, config: TransportConfig) -> str:
    """A sentence that nobody was found, and what of the network is not there; asks the resolver."""
    return "; ".join((sentence, *network_faults(config, "")))


def _no_way(family: int, address: tuple[Any, ...]) -> str | None:
    """Why the machine has no route to an address; nothing is sent."""
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect(address)
    except OSError as error:
        return error.strerror or str(error)
    return None


def _is_ours(address: str) -> bool:
    """Whether a socket can be bound to an address, as only those of this machine's interfaces let one."""
    try:
        with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind((address, 0))
    except OSError:
        return False
    return True


def _carries_multicast(flags: int) -> bool:
    return bool(flags & _UP and flags & _MULTICAST and not flags & _LOOPBACK)


def _flags(name: str) -> int:
    """Flags of an interface; none where it went away."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            answer = fcntl.ioctl(probe, _SIOCGIFFLAGS, struct.pack("16sH14x", name.encode()[:15], 0))
        except OSError:
            return 0
    return int(struct.unpack_from("H", answer, 16)[0])
