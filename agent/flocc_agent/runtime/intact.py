"""A small file beside the store that says how far the robot's own log and terms had come at least.

SQLite takes a cut or altered write-ahead log for one that ended earlier: a store goes back in time without an error.
This file is written in place after each own record and term, without waiting for the disk, so it is never ahead of
a sound store; a store that holds less than it says has lost something that others may have heard. While the file is
missing, the log must not be continued: it can be removed even when the disk is full.
"""

import logging
import os
import zlib
from dataclasses import dataclass
from pathlib import Path

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Reached:
    """How many records the own log had, and the highest term counter that the robot claimed."""

    records: int
    term_counter: int


class Intact:
    """The file `intact`; without a path it knows nothing."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._said = False

    def exists(self) -> bool:
        """Whether the log may be continued, as far as this file knows."""
        return self._path is not None and self._path.exists()

    def reached(self, log: str) -> Reached | None:
        """What this log had reached at least; None where the file does not say, or is damaged."""
        try:
            content = b"" if self._path is None else self._path.read_bytes()
        except OSError:
            return None
        fields = content[:41].split()
        if len(fields) != 3 or fields[2] != _checksum(log, content[:32]):
            return None
        return Reached(int(fields[0]), int(fields[1]))

    def write(self, log: str, reached: Reached) -> None:
        """Note what is safe on the disk by now; says once when it cannot."""
        if self._path is None:
            return
        numbers = b"%010d %020d " % (reached.records, reached.term_counter)
        try:
            file = os.open(self._path, os.O_WRONLY | os.O_CREAT, 0o644)
            try:
                os.pwrite(file, numbers + _checksum(log, numbers) + b"\n", 0)
            finally:
                os.close(file)
        except OSError as error:
            self._say("written", error)

    def remove(self) -> None:
        """The log must not be continued after this life."""
        try:
            if self._path is not None:
                self._path.unlink(missing_ok=True)
        except OSError as error:
            self._say("removed", error)

    def _say(self, what: str, error: OSError) -> None:
        if not self._said:
            logger.error("%s: cannot be %s: %s", self._path, what, error.strerror)
        self._said = True


def _checksum(log: str, numbers: bytes) -> bytes:
    return b"%08x" % zlib.crc32(numbers + log.encode())
