"""Network namespaces for tests: one per robot, each with an address of its own, on one bridge. Needs root.

The kernel here has no netem: loss is made by iptables' statistic match on what comes in, a pulled cable by taking the
robot's port of the bridge down.
"""

import itertools
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

SUBNET = "10.77.33"
INTERFACE = "eth0"
BRIDGES = itertools.count()


def needs_namespaces(*tools: str) -> None:
    """Skip the test, with the reason, where namespaces cannot be made."""
    if os.geteuid() != 0:
        pytest.skip("needs root for network namespaces")
    missing = [tool for tool in ("ip", *tools) if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"needs {', '.join(missing)} (Debian packages iproute2, iptables)")
    probe = subprocess.run(
        ["ip", "netns", "add", f"fl{os.getpid()}-probe"], capture_output=True, text=True, check=False
    )
    if probe.returncode != 0:
        pytest.skip(f"network namespaces cannot be made here: {probe.stderr.strip()}")
    run("ip", "netns", "del", f"fl{os.getpid()}-probe")


def run(*command: str) -> None:
    """Run a command; its error output is in the exception."""
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    if finished.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}: {finished.stderr.strip()}")


class Host:
    """One namespace with one cable to the bridge."""

    def __init__(self, number: int, bridge: str) -> None:
        self.namespace = f"{bridge}-{number}"
        self.address = f"{SUBNET}.{number}"
        self._port = f"{bridge}p{number}"

    def connect(self, bridge: str) -> None:
        """Make the namespace and its cable."""
        inside = f"{self._port}i"
        run("ip", "netns", "add", self.namespace)
        run("ip", "link", "add", self._port, "type", "veth", "peer", "name", inside)
        run("ip", "link", "set", inside, "netns", self.namespace, "name", INTERFACE)
        run("ip", "link", "set", self._port, "master", bridge, "up")
        for command in (
            ("ip", "link", "set", "lo", "up"),
            ("ip", "address", "add", f"{self.address}/24", "dev", INTERFACE),
            ("ip", "link", "set", INTERFACE, "up"),
        ):
            run(*self.prefix, *command)

    @property
    def prefix(self) -> tuple[str, ...]:
        """What to write before a command so that it runs on this host."""
        return ("ip", "netns", "exec", self.namespace)

    def pull_cable(self) -> None:
        """Cut the host off."""
        run("ip", "link", "set", self._port, "down")

    def plug_cable(self) -> None:
        """Bring it back."""
        run("ip", "link", "set", self._port, "up")

    def lose_address(self) -> None:
        """Switch the interface off and take its address, as where Wi-Fi is not there yet."""
        run(*self.prefix, "ip", "address", "flush", "dev", INTERFACE)
        run(*self.prefix, "ip", "link", "set", INTERFACE, "down")

    def get_address(self, number: int, subnet: str = SUBNET, bits: int = 24) -> None:
        """Switch the interface on, with an address of the bridge's network, or of another one."""
        self.address = f"{subnet}.{number}"
        run(*self.prefix, "ip", "link", "set", INTERFACE, "up")
        run(*self.prefix, "ip", "address", "add", f"{self.address}/{bits}", "dev", INTERFACE)

    def lose(self, probability: float) -> None:
        """Lose this share of the packets that come in."""
        match = ("-m", "statistic", "--mode", "random", "--probability", str(probability))
        run(*self.prefix, "iptables", "-A", "INPUT", "-i", INTERFACE, *match, "-j", "DROP")

    def deafen(self, address: str) -> None:
        """Lose all that comes in from one address."""
        run(*self.prefix, "iptables", "-A", "INPUT", "-s", address, "-j", "DROP")

    def hear_all(self) -> None:
        """Take all losses back."""
        run(*self.prefix, "iptables", "-F", "INPUT")

    def remove(self) -> None:
        """Take the namespace away, and its cable with it."""
        for command in (["ip", "link", "del", self._port], ["ip", "netns", "del", self.namespace]):
            subprocess.run(command, capture_output=True, check=False)


@contextmanager
def hosts(count: int) -> Iterator[list[Host]]:
    """Hosts on one bridge, removed in the end."""
    bridge = f"fl{os.getpid() % 10_000}{chr(ord('a') + next(BRIDGES) % 26)}"
    made: list[Host] = []
    run("ip", "link", "add", bridge, "type", "bridge")
    try:
        run("ip", "link", "set", bridge, "up")
        made += [Host(number, bridge) for number in range(1, count + 1)]
        for host in made:
            host.connect(bridge)
        yield made
    finally:
        for host in made:
            host.remove()
        run("ip", "link", "del", bridge)
