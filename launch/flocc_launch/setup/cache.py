"""Where generated data is kept, also for a user without a home."""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from flocc_protocol.errors import FloccError


class CacheError(FloccError):
    """There is no place for generated data."""


def cache_folder() -> Path:
    """FLOCC_CACHE, flocc's folder in the user's cache, else one in the temporary folder.

    Raises:
        CacheError: None of them can be written.
    """
    given = os.environ.get("FLOCC_CACHE")
    if given:
        if not can_be_written(Path(given)):
            raise CacheError(f"{given}: cannot be written; FLOCC_CACHE names this folder for what flocc generates")
        return Path(given)
    usual = next((folder for folder in _usual_caches() if can_be_written(folder)), None)
    if usual is not None:
        return usual
    own = Path(tempfile.gettempdir()) / f"flocc-{os.getuid()}"
    if not can_be_written(own) or own.stat().st_uid != os.getuid():
        raise CacheError(
            f"{own}: cannot be written, nor can a cache in the home folder: name a folder with FLOCC_CACHE"
        )
    return own


def _usual_caches() -> Iterator[Path]:
    """Where caches lie; a user without a home has none."""
    given = os.environ.get("XDG_CACHE_HOME")
    if given:
        yield Path(given) / "flocc"
    try:
        yield Path.home() / ".cache" / "flocc"
    except RuntimeError:
        return


def can_be_written(folder: Path) -> bool:
    """Whether a folder is there, or can be made, and takes files."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
