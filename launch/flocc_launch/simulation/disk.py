"""A simulated disk: what survives a robot's death, and how disks fail.

As in `runtime/store.py` and `runtime/persistence.py`, own records and terms are safe when they are written, copies of
others' records are written half a second's worth at a time; a full disk goes on in memory; each record has a checksum,
so that what a flipped bit spoils is left out with all that follows it in its log; and a robot whose own log lacks
anything comes back with another log. Only an older copy of everything cannot be told from the right one.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from flocc_agent.core.log_copy import EncodedRecords
from flocc_agent.core.restored import Restored
from flocc_agent.runtime.map_folder import MapFolder
from flocc_agent.runtime.persistence import COPIES_PERIOD_S, joined_logs
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import LogCorrection


@dataclass(frozen=True, slots=True)
class DiskContent:
    """Everything on a disk at one time."""

    own: LogId
    records: Mapping[LogId, tuple[bytes, ...]]
    latents: Mapping[KeyframeId, bytes]
    term_counter: int
    correction: LogCorrection | None
    frame_changed: bool


@dataclass(slots=True)
class Disk:
    """Records, latents, the claimed term and the applied correction of one robot.

    Attributes:
        own: The log that the robot writes.
        latent_bytes_max: Beyond this the oldest latents go first.
        opened: A saved map beside it, which is only read.
        map_fixed: The map does not move.
        slow_s: How long each write of the robot's own takes.
        whole: Nothing of the own log is missing; else the robot begins another one when it starts.
        went_back: The power went, or an older copy took its place: the robot may not know what it said last.
    """

    own: LogId
    latent_bytes_max: int = 2 * 1024**3
    records: dict[LogId, EncodedRecords] = field(default_factory=dict)
    latents: dict[KeyframeId, bytes] = field(default_factory=dict)
    term_counter: int = 0
    correction: LogCorrection | None = None
    frame_changed: bool = False
    latent_bytes: int = 0
    opened: MapFolder | None = None
    map_fixed: bool = False
    slow_s: float = 0.0
    whole: bool = True
    went_back: bool = False
    _waiting: dict[LogId, int] = field(default_factory=dict)
    _written_s: float = 0.0
    _full: DiskContent | None = None

    def put_record(self, log: LogId, number: int, data: bytes, now_s: float) -> None:
        """Append a record; the core never leaves a gap. Copies of others' wait a moment before they are written."""
        records = self.records.get(log)
        if records is None:
            records = self.records[log] = EncodedRecords()
        assert number == len(records), f"record {number} of {log} does not follow {len(records)}"
        records.append(data)
        if log == self.own or now_s >= self._written_s + COPIES_PERIOD_S:
            self._waiting.clear()
            self._written_s = now_s
        else:
            self._waiting[log] = self._waiting.get(log, 0) + 1

    def drop_log(self, log: LogId) -> None:
        """Keep nothing of another robot's log any more."""
        self.records.pop(log, None)
        self._waiting.pop(log, None)

    def put_latent(self, keyframe: KeyframeId, latent: bytes) -> None:
        """Keep a latent; the oldest make room."""
        self.latent_bytes += len(latent) - len(self.latents.pop(keyframe, b""))
        self.latents[keyframe] = latent
        while self.latent_bytes > self.latent_bytes_max and len(self.latents) > 1:
            oldest = next(iter(self.latents))
            self.latent_bytes -= len(self.latents.pop(oldest))

    def replace_latent(self, keyframe: KeyframeId, latent: bytes) -> None:
        """Keep another latent in the place of one that is there, where one is."""
        if keyframe in self.latents:
            self.latent_bytes += len(latent) - len(self.latents[keyframe])
            self.latents[keyframe] = latent

    def latent(self, keyframe: KeyframeId) -> bytes | None:
        """A latent of its own, or of the map."""
        data = self.latents.get(keyframe)
        return self.opened.latent(keyframe) if data is None and self.opened is not None else data

    def restored(self) -> Restored:
        """What a robot finds when it starts again."""
        held = {log: tuple(data) for log, data in self.records.items()}
        latents = set(self.latents)
        if self.opened is not None:
            held |= joined_logs(self.opened, held, None, None)
            latents |= set(self.opened.latent_keyframes())
        return Restored(
            tuple(sorted(held.items())),
            tuple(sorted(latents)),
            self.term_counter,
            self.correction,
            self.frame_changed,
            None if self.opened is None else self.opened.saved(self.map_fixed),
        )

    def begin(self, log: LogId) -> None:
        """Let another log be the robot's own; what was applied to the earlier one is of no use to it."""
        self.own, self.whole = log, True
        self.correction, self.frame_changed = None, False

    # How disks fail

    def lose_unwritten(self) -> None:
        """The robot's process died: what waited to be written, or was kept in memory as the disk was full, is gone."""
        for log, count in self._waiting.items():
            self.records[log].truncate(len(self.records[log]) - count)
        self._waiting.clear()
        if self._full is not None:
            self.restore(self._full)
            self.whole, self._full = False, None

    def fill(self, full: bool) -> None:
        """No room any more: what is written from now on stays in memory. Or room again: all of it is written."""
        self._full = self.content() if full else None

    def flip(self, number: int) -> None:
        """A bit of a record turned over, or of a latent where there is none."""
        places = [(log, k) for log, records in sorted(self.records.items()) for k in range(len(records))]
        if places:
            log, k = places[number % len(places)]
            self.records[log].truncate(k)
            self.whole &= log != self.own
        if self.latents:
            spoilt = sorted(self.latents)[number % len(self.latents)]
            self.latent_bytes -= len(self.latents.pop(spoilt))

    def content(self) -> DiskContent:
        """A copy of everything, for later."""
        records = {log: tuple(data) for log, data in self.records.items()}
        return DiskContent(
            self.own, records, dict(self.latents), self.term_counter, self.correction, self.frame_changed
        )

    def restore(self, content: DiskContent) -> None:
        """Put a copy of an earlier time in the place of everything."""
        self.own, self.term_counter = content.own, content.term_counter
        self.records = {log: EncodedRecords(data) for log, data in content.records.items()}
        self.latents = dict(content.latents)
        self.latent_bytes = sum(map(len, self.latents.values()))
        self.correction, self.frame_changed = content.correction, content.frame_changed
        self._waiting.clear()
