"""A file without a name, in which the core's old records and poses are while the process lives.

It is no second store: what a robot needs after its death is in `robot.sqlite`. The file is made when the first piece is
put, and vanishes with the process, however that ends. Where the disk, or so much of it as may be used, is full,
pieces stay in memory.
"""

import logging
import os
import tempfile
from pathlib import Path
from typing import IO

from flocc_agent.runtime.database import StoreError

logger = logging.getLogger(__name__)

BYTES_MAX = 1 << 30


class PageFile:
    """Pieces of bytes on a disk."""

    def __init__(self, folder: Path | None = None, bytes_max: int = BYTES_MAX) -> None:
        """Use a folder's disk, so much of it at most; without one, that of the system's temporary files."""
        self._folder = folder
        self._bytes_max = bytes_max
        self._file: IO[bytes] | None = None
        self._bytes = 0
        self._free: dict[int, list[int]] = {}
        self._is_full = False

    @property
    def _where(self) -> str:
        return str(self._folder or tempfile.gettempdir())

    @property
    def size_bytes(self) -> int:
        """How long the file is."""
        return self._bytes

    def put(self, piece: bytes) -> int | None:
        """Keep a piece: its place, or None where the disk takes no more."""
        if not self._free.get(len(piece)) and self._bytes + len(piece) > self._bytes_max:
            self._warn(f"they fill {self._bytes_max} bytes of {self._where}")
            return None
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(buffering=0, dir=self._folder)  # noqa: SIM115
            free = self._free.get(len(piece))
            written, place = 0, free[-1] if free else self._bytes
            while written < len(piece):
                written += os.pwrite(self._file.fileno(), piece[written:], place + written)
        except OSError as error:
            self._warn(str(error))
            return None
        if free:
            free.pop()
        else:
            self._bytes += len(piece)
        self._is_full = False
        return place

    def _warn(self, why: str) -> None:
        if not self._is_full:
            logger.warning("old records stay in memory: %s", why)
        self._is_full = True

    def free(self, place: int, size_bytes: int) -> None:
        """Let the next piece of this size take the room of one that is needed no more."""
        self._free.setdefault(size_bytes, []).append(place)

    def get(self, place: int, size_bytes: int) -> bytes:
        """A piece again.

        Raises:
            StoreError: The disk does not give it back.
        """
        try:
            data = b"" if self._file is None else os.pread(self._file.fileno(), size_bytes, place)
        except OSError as error:
            raise StoreError(f"old records cannot be read from {self._where}: {error}") from error
        if len(data) != size_bytes:
            raise StoreError(f"old records cannot be read from {self._where}: the file ends early")
        return data

    def close(self) -> None:
        """Let the file go."""
        if self._file is not None:
            self._file.close()
            self._file = None
