"""What of a configured network is not there: interfaces and hosts. zenoh goes on trying without a word."""

import fcntl
import re
import socket
import struct
from collections.abc import Iterator

from flocc_agent.config import TransportConfig
from flocc_agent.runtime.addresses import is_address
from flocc_agent.runtime.certificate_faults import certificate_faults

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
    if config.multicast and config.interface != "auto" and not is_address(config.interface):
        if config.interface not in there:
            yield f"transport.interface: the interface {config.interface!r} does not exist; there is {told}"
        elif not there[config.interface] & _UP:
            yield f"transport.interface: the interface {config.interface!r} is down"
    elif config.multicast and not config.roster and not any(_carries_multicast(flags) for flags in there.values()):
        yield f"no interface for multicast is up (there is {told}); nobody is found until one is"
    endpoints = (*config.control_listen, *config.bulk_listen)
    named = {found[1]: endpoint for endpoint in endpoints if (found := re.search(r"[#;]iface=([^;#]+)", endpoint))}
    for name, endpoint in named.items():
        if name not in there:
            yield f"{endpoint}: the interface {name!r} does not exist; there is {told}"


def host_faults(config: TransportConfig, robot: str) -> Iterator[str]:
    """Hosts of the roster that this robot dials and that have no address."""
    asked: set[str] = set()
    for name, peer in sorted(config.roster.items()):
        for endpoint in (*peer.control, *peer.bulk):
            host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
            if name == robot or host in asked:
                continue
            asked.add(host)
            try:
                socket.getaddrinfo(host, None)
            except OSError as error:
                told = error.strerror or error
                yield f"transport.roster.{name}: the host {host!r} is not known ({told}); it is dialled again and again"


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
