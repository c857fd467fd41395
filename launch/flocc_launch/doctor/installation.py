"""Findings of an installation: what flocc needs of this machine, each with a figure that shows it."""

import importlib
import importlib.util
import shutil
import socket
import sys
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from flocc_agent.config import TransportConfig
from flocc_launch.doctor.finding import Finding, Severity
from flocc_protocol.errors import FloccError

DISK_FREE_BYTES_MIN = 2_000_000_000
CLOCK_YEAR_MIN = 2025
DISCOVERY_S_MAX = 5.0
REQUIRED = {"zenoh": "eclipse-zenoh", "gtsam": "gtsam", "cv2": "opencv-python-headless", "scipy": "scipy"}
OPTIONAL = {"torch": "mast3r", "rerun": "view", "evo": "eval"}


def check_installation(folder: Path | None = None, config: TransportConfig | None = None) -> list[Finding]:
    """Check Python, packages, disk, clock, ports, and whether two zenoh peers find each other here.

    Args:
        folder: Where runs or the store will lie; the working folder where None.
        config: How this robot will reach others; the default where None.
    """
    transport = config or TransportConfig()
    return [
        *python_found(),
        *packages(),
        *disk(folder or Path.cwd()),
        *clock(time.time()),
        *ports(transport),
        *discovery(transport),
    ]


def good(cause: str, sentence: str) -> Finding:
    """A finding that all is well."""
    return Finding(cause, Severity.GOOD, sentence)


def python_found() -> list[Finding]:
    """Which Python runs."""
    return [good("python", f"Python {sys.version.split()[0]}, {sys.platform}.")]


def packages() -> list[Finding]:
    """What is installed, and what an extra would add."""
    found = []
    for module, package in REQUIRED.items():
        problem = import_problem(module)
        if problem is None:
            found.append(good("package", f"{package} {version_of(package)}."))
        else:
            advice = f"Install it again: pip install --force-reinstall {package}."
            found.append(Finding("package", Severity.BLOCKS, f"{package} cannot be imported: {problem}.", advice))
    for module, extra in OPTIONAL.items():
        if importlib.util.find_spec(module) is None:
            sentence = f"{module} is not installed; it is needed for flocc[{extra}] only."
            found.append(Finding("extra", Severity.NOTE, sentence, f"pip install 'flocc[{extra}]' if you want it."))
    return found


def import_problem(module: str) -> str | None:
    """Why a module cannot be imported; None where it can."""
    try:
        importlib.import_module(module)
    except (ImportError, OSError) as error:
        return str(error).splitlines()[0]
    return None


def version_of(package: str) -> str:
    """Version of an installed package."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "of unknown version"


def disk(folder: Path) -> list[Finding]:
    """Room for keyframes and latents."""
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    sentence = f"{free / 1e9:.1f} GB are free on the disk of {folder}."
    if free >= DISK_FREE_BYTES_MIN:
        return [good("disk", sentence)]
    return [Finding("disk", Severity.HINDERS, sentence, "Free some, or lower the store's limits; latents take most.")]


def clock(now_s: float) -> list[Finding]:
    """Whether the wall clock was ever set; flocc needs it for names of new incarnations only."""
    year = time.gmtime(now_s).tm_year
    if year >= CLOCK_YEAR_MIN:
        return [good("clock", f"The clock says {time.strftime('%Y-%m-%d %H:%M UTC', time.gmtime(now_s))}.")]
    advice = "Set it (NTP, GPS): a robot that lost its disk names its new log after the time."
    return [Finding("clock", Severity.HINDERS, f"The clock says {year}, it was never set.", advice)]


def ports(config: TransportConfig) -> list[Finding]:
    """Whether the ports to listen on are free."""
    found = []
    for endpoint in (*config.control_listen, *config.bulk_listen):
        host, _, port = endpoint.rpartition("/")[2].rpartition(":")
        if endpoint.startswith("tcp/") and port.isdigit() and int(port):
            problem = port_problem(host.strip("[]"), int(port))
            advice = "Stop the program that listens there, or choose another port in the agent's configuration."
            found += (
                []
                if problem is None
                else [Finding("port", Severity.BLOCKS, f"{endpoint} cannot be listened on: {problem}.", advice)]
            )
    return found or [good("port", "The ports to listen on are free.")]


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
    """Whether two zenoh peers on this machine find each other: by multicast, and by an endpoint that one names."""
    found = []
    if config.multicast:
        took_s = seconds_until(lambda: two_peers(config, by_multicast=True))
        advice = (
            "Many Wi-Fi access points and containers drop multicast: list the robots under [transport.roster], or set "
            "transport.interface."
        )
        found.append(discovered("multicast", "by multicast", took_s, Severity.HINDERS, advice))
    advice = "Look for a firewall on the loopback interface."
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
    from flocc_agent.runtime.zenoh_session import Plane, open_session, session_settings

    port, other = free_port(), free_port()
    settings = session_settings(config, "doctor", "a", Plane.CONTROL) | {"scouting/multicast/enabled": by_multicast}
    listening = settings | {"listen/endpoints": [f"tcp/127.0.0.1:{port}"], "connect/endpoints": []}
    dialling = settings | {"listen/endpoints": [f"tcp/127.0.0.1:{other}"]}
    dialling["connect/endpoints"] = [] if by_multicast else [f"tcp/127.0.0.1:{port}"]
    first = open_session(listening, "doctor")
    try:
        second = open_session(dialling, "doctor")
        try:
            deadline_s = time.monotonic() + DISCOVERY_S_MAX
            while time.monotonic() < deadline_s:
                if first.info.zid() in second.info.peers_zid():
                    return True
                time.sleep(0.02)
            return False
        finally:
            second.close()
    finally:
        first.close()


def free_port() -> int:
    """A TCP port of 127.0.0.1 that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
