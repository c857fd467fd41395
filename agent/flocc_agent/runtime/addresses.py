"""Addresses of this machine's interfaces, and when new ones are there: zenoh takes those of the moment it is opened.

Addresses that went and come back are no news, since sockets that were bound to them serve on; others are.
"""

import fcntl
import ipaddress
import socket
import struct
from pathlib import Path
from typing import Any

_SIOCGIFCONF = 0x8912
_ROW = struct.Struct("16s16s8x")
_ROWS_MAX = 256
_IPV6_TABLE = Path("/proc/net/if_inet6")

Addresses = frozenset[tuple[str, str]]
"""(interface, address) of each interface that is up, but for what every interface has by itself."""


def machine_addresses() -> Addresses:
    """What this machine has now; empty where the system does not tell."""
    found = {(name, address) for name, address in (*_ipv4(), *_ipv6()) if _counts(address)}
    return frozenset(found)


def at_addresses(settings: dict[str, Any], addresses: Addresses) -> dict[str, Any]:
    """Zenoh's settings with this machine's addresses in place of what stands for them.

    zenoh looks at interfaces once in the life of a process; a later session has to be told what is there now.
    """
    interface = settings["scouting/multicast/interface"]
    if is_address(interface):
        return settings
    here = sorted(address for name, address in addresses if interface in ("auto", name) and is_ipv4(address))
    if not here:
        return settings
    everywhere = sorted(address for _, address in addresses if is_ipv4(address))
    listened = [each for endpoint in settings["listen/endpoints"] for each in _spelt_out(endpoint, everywhere)]
    return settings | {"scouting/multicast/interface": ",".join(here), "listen/endpoints": listened}


def _spelt_out(endpoint: str, addresses: list[str]) -> list[str]:
    before, anywhere, after = endpoint.partition("/0.0.0.0:")
    return [f"{before}/{address}:{after}" for address in addresses] if anywhere else [endpoint]


class AddressWatch:
    """Says once that addresses are there which were not when the network was opened, as soon as they stay."""

    def __init__(self, opened_with: Addresses, interface: str = "auto") -> None:
        """Begin.

        Args:
            opened_with: What was there when the network was opened.
            interface: The only one that matters, by its name; `auto`: all do.
        """
        self._interface = interface
        self._known = self._of_interest(opened_with)
        self._last = self._known

    def news(self, now: Addresses) -> tuple[str, ...]:
        """Addresses that are new, and are the same as when it was asked last; they are known then."""
        current = self._of_interest(now)
        settled, self._last = current == self._last, current
        added = current - self._known
        if not settled or not added:
            return ()
        self._known = current
        return tuple(sorted(address for _, address in added))

    def _of_interest(self, addresses: Addresses) -> Addresses:
        named = any(self._interface == name for name, _ in addresses) or not is_address(self._interface)
        if self._interface == "auto" or not named:
            return addresses
        return frozenset(each for each in addresses if each[0] == self._interface)


def is_address(text: str) -> bool:
    """Whether a text is an IP address, and not the name of an interface."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def is_ipv4(address: str) -> bool:
    """Whether an address is one of IPv4."""
    return ":" not in address


def _counts(address: str) -> bool:
    """Every interface has an IPv6 address of its link; containers make interfaces all the time."""
    parsed = ipaddress.ip_address(address)
    return not parsed.is_loopback and not (parsed.version == 6 and parsed.is_link_local)


def _ipv4() -> list[tuple[str, str]]:
    buffer = bytearray(_ROW.size * _ROWS_MAX)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        pointer = (_address_of(buffer), len(buffer))
        try:
            answer = fcntl.ioctl(probe, _SIOCGIFCONF, struct.pack("iL", pointer[1], pointer[0]))
        except OSError:
            return []
    (length,) = struct.unpack_from("i", answer)
    rows = [_ROW.unpack_from(buffer, at) for at in range(0, length, _ROW.size)]
    return [(name.partition(b"\0")[0].decode(errors="replace"), socket.inet_ntoa(row[4:8])) for name, row in rows]


def _address_of(buffer: bytearray) -> int:
    import ctypes

    return ctypes.addressof(ctypes.c_char.from_buffer(buffer))


def _ipv6() -> list[tuple[str, str]]:
    try:
        rows = [line.split() for line in _IPV6_TABLE.read_text(encoding="ascii").splitlines()]
    except OSError:
        return []
    return [(row[5], str(ipaddress.IPv6Address(bytes.fromhex(row[0])))) for row in rows if len(row) == 6]
