"""Findings of an installation: what flocc needs of this machine, each with a figure that shows it."""

import importlib
import importlib.util
import locale
import os
import shutil
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from flocc_agent.config import Mast3rConfig, PerceptionConfig, TransportConfig
from flocc_agent.extras import to_install
from flocc_agent.perception.backends import OWN, PerceptionError, check_perception, methods
from flocc_launch.doctor.finding import Finding, Severity, good
from flocc_launch.doctor.network_check import configured_network, discovery, ports
from flocc_launch.setup.cache import CacheError, cache_folder
from flocc_protocol.errors import FloccError

DISK_FREE_BYTES_MIN = 2_000_000_000
CLOCK_YEAR_MIN = 2025
REQUIRED = {"zenoh": "eclipse-zenoh", "gtsam": "gtsam", "cv2": "opencv-python-headless", "scipy": "scipy"}
OPTIONAL = {
    "rosbags": "bags", "cryptography": "secure", "rerun": "view", "torch": "mast3r", "prometheus_client": "metrics",
    "xxhash": "ros2", "matplotlib": "figures", "evo": "eval", "foxglove": "mcap",
}  # fmt: skip


def check_installation(
    folder: Path | None = None, config: TransportConfig | None = None, perception: PerceptionConfig | None = None
) -> list[Finding]:
    """Check Python, packages, torch and checkpoints, disk, clock, ports, and whether zenoh peers find each other here.

    Args:
        folder: Where runs or the store will lie; the working folder where None.
        config: How this robot will reach others; the default where None.
        perception: What it will see with; the default where None.
    """
    transport = config or TransportConfig()
    return [
        *python_found(),
        *packages(),
        *networks(perception or PerceptionConfig()),
        *disk(folder or Path.cwd()),
        *surroundings(folder or Path.cwd()),
        *clock(time.time()),
        *ports(transport),
        *configured_network(transport),
        *discovery(transport),
    ]


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
    lacking = {extra: module for module, extra in OPTIONAL.items() if importlib.util.find_spec(module) is None}
    if lacking:
        named_ = ", ".join(f"{extra} ({module})" for extra, module in lacking.items())
        sentence = f"Extras that are not installed, and needed for what they are named after only: {named_}."
        found.append(Finding("extra", Severity.NOTE, sentence, f"{to_install(','.join(lacking))} brings them."))
    return found


def networks(config: PerceptionConfig) -> list[Finding]:
    """Torch and the checkpoints, where perception needs them."""
    try:
        check_perception(config)
    except PerceptionError as error:
        return [Finding("perception", Severity.BLOCKS, f"{error}.", "Install the package that brings it.")]
    if config.method not in OWN:
        return [good("perception", f"Perception '{config.method}' comes from {methods()[config.method]}.")]
    if config.method != "mast3r":
        return [good("checkpoint", f"Perception '{config.method}' needs neither torch nor checkpoints.")]
    problem = import_problem("torch")
    if problem is not None:
        advice = f"Install it: {to_install('mast3r')}."
        return [Finding("torch", Severity.BLOCKS, f"torch cannot be imported: {problem}.", advice)]
    return [*device(config.mast3r), *checkpoints(config.mast3r)]


def device(config: Mast3rConfig) -> list[Finding]:
    """Where the networks will run."""
    from flocc_agent.perception.mast3r.device import choose_compute
    from flocc_agent.perception.torch_device import DeviceError

    try:
        compute = choose_compute(config.device, config.dtype)
    except DeviceError as error:
        advice = "Set perception.mast3r.device to one that is there, or to auto."
        return [Finding("torch", Severity.BLOCKS, f"{str(error).rstrip('.').capitalize()}.", advice)]
    return [good("torch", f"torch {version_of('torch')} runs on {compute.device}, in {compute.dtype}.")]


def checkpoints(config: Mast3rConfig) -> list[Finding]:
    """Whether both checkpoints are there and whole."""
    found = []
    for key, path in (("weights", config.weights), ("place_weights", config.place_weights)):
        if path is None:
            advice = "See `flocc weights` on where to get it and under which licence."
            found.append(Finding("checkpoint", Severity.BLOCKS, f"perception.mast3r.{key} is not set.", advice))
        else:
            found.append(checkpoint(path))
    return found


def checkpoint(path: Path) -> Finding:
    """Whether one checkpoint is there, whole, and computes."""
    from flocc_launch.setup.weight_files import check

    try:
        checked = check(path)
    except FloccError as error:
        return Finding("checkpoint", Severity.BLOCKS, f"{str(error).rstrip('.')}.", "Fetch it again: `flocc weights`.")
    return good("checkpoint", f"{path} is {checked.kind}, {checked.network}, and passes its self-test.")


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


def surroundings(folder: Path) -> list[Finding]:
    """Whether this user may write where flocc writes, and whether names are UTF-8."""
    found = []
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not os.access(existing, os.W_OK):
        advice = "Run flocc in a folder of your own, or name one with --out."
        found.append(Finding("folder", Severity.HINDERS, f"{existing} cannot be written by this user.", advice))
    try:
        cache = cache_folder()
    except CacheError as error:
        advice = "Set FLOCC_CACHE to a folder that can be written."
        found.append(Finding("cache", Severity.BLOCKS, f"{str(error).rstrip('.')}.", advice))
    else:
        found.append(good("cache", f"Generated data is kept in {cache}."))
    if locale.getpreferredencoding(False).lower().replace("-", "") != "utf8":
        sentence = f"The locale's encoding is {locale.getpreferredencoding(False)}; flocc reads and writes UTF-8."
        found.append(Finding("locale", Severity.NOTE, sentence, "Set LC_ALL=C.UTF-8 for names with umlauts."))
    return found


def clock(now_s: float) -> list[Finding]:
    """Whether the wall clock was ever set; flocc needs it for names of new incarnations only."""
    year = time.gmtime(now_s).tm_year
    if year >= CLOCK_YEAR_MIN:
        return [good("clock", f"The clock says {time.strftime('%Y-%m-%d %H:%M UTC', time.gmtime(now_s))}.")]
    advice = "Set it (NTP, GPS): a robot that lost its disk names its new log after the time."
    return [Finding("clock", Severity.HINDERS, f"The clock says {year}, it was never set.", advice)]
