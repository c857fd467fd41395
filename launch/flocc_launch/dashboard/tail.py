"""Read a run's events while they are written."""

from pathlib import Path

from flocc_agent.core.reports import Fact
from flocc_agent.runtime.event_lines import Reported
from flocc_launch.runs.run_folder import RunFolderError, event_from_line

CHUNK_BYTES_MAX = 8_000_000


class LineTail:
    """New whole lines of one growing file; a last line without its end waits."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._offset = 0
        self._torn = b""
        self._number = 0

    def events(self) -> list[Reported[Fact]]:
        """What was written since the last call; lines that cannot be read are left out."""
        if not self.path.exists():
            return []
        with self.path.open("rb") as file:
            file.seek(self._offset)
            data = file.read(CHUNK_BYTES_MAX)
        self._offset += len(data)
        *lines, self._torn = (self._torn + data).split(b"\n")
        return [event for line in lines if (event := self._event(line)) is not None]

    def _event(self, line: bytes) -> Reported[Fact] | None:
        self._number += 1
        try:
            return event_from_line(line.decode("utf-8"), f"{self.path}:{self._number}")
        except (UnicodeDecodeError, RunFolderError):
            return None


class RunTail:
    """Events of all robots of a run folder: each robot's own file while it runs, the merged one afterwards."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._tails: dict[Path, LineTail] = {}
        self._merged: LineTail | None = None

    def poll(self) -> tuple[bool, list[Reported[Fact]]]:
        """What is new, in order of time.

        Returns:
            Whether everything before is void, because the merged file has come and is read from its start; and the
            new events.
        """
        merged = self._path / "events.jsonl"
        if self._merged is None and merged.exists():
            self._merged = LineTail(merged)
            return True, self._merged.events()
        if self._merged is not None:
            return False, self._merged.events()
        for path in sorted(self._path.glob("*.events.jsonl")) + sorted(self._path.glob("robots/*/events.jsonl")):
            self._tails.setdefault(path, LineTail(path))
        found = [event for path in sorted(self._tails) for event in self._tails[path].events()]
        return False, sorted(found, key=lambda event: event.t)
