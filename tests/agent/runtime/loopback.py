"""Transports on this machine: free ports, a roster, and waiting for what the network does."""

import asyncio
import socket
from collections.abc import Callable, Iterable
from typing import Any

from flocc_agent.config import PeerEndpoints, TransportConfig


def free_ports(count: int) -> list[int]:
    """Ports of 127.0.0.1 that were free a moment ago."""
    sockets = [socket.socket() for _ in range(count)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


def loopback_configs(robots: Iterable[str], **options: Any) -> dict[str, TransportConfig]:
    """One configuration per robot; they know each other's endpoints and use neither multicast nor gossip."""
    names = list(robots)
    protocol = "tls" if options.get("tls") else "tcp"
    ports = iter(free_ports(2 * len(names)))
    roster = {
        name: PeerEndpoints(
            control=(f"{protocol}/127.0.0.1:{next(ports)}",), bulk=(f"{protocol}/127.0.0.1:{next(ports)}",)
        )
        for name in names
    }
    options = {"multicast": False, "gossip": False} | options
    return {
        name: TransportConfig(
            control_listen=roster[name].control, bulk_listen=roster[name].bulk, roster=roster, **options
        )
        for name in names
    }


async def until(is_true: Callable[[], bool], timeout_s: float = 10.0, act: Callable[[], None] | None = None) -> None:
    """Wait until something is true, doing something again and again; TimeoutError otherwise."""
    async with asyncio.timeout(timeout_s):
        while not is_true():
            if act is not None:
                act()
            await asyncio.sleep(0.02)
