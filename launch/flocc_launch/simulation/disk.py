"""A simulated disk: what survives a robot's death, unless the disk dies with it."""

from dataclasses import dataclass, field

from flocc_agent.core.robot import Restored
from flocc_agent.runtime.map_folder import MapFolder
from flocc_agent.runtime.persistence import joined_logs
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import LogCorrection


@dataclass(slots=True)
class Disk:
    """Records, latents, the claimed term and the applied correction of one robot.

    Attributes:
        latent_bytes_max: Beyond this the oldest latents go first.
        opened: A saved map beside it, which is only read.
        map_fixed: The map does not move.
    """

    latent_bytes_max: int = 2 * 1024**3
    records: dict[LogId, list[bytes]] = field(default_factory=dict)
    latents: dict[KeyframeId, bytes] = field(default_factory=dict)
    term_counter: int = 0
    correction: LogCorrection | None = None
    frame_changed: bool = False
    latent_bytes: int = 0
    opened: MapFolder | None = None
    map_fixed: bool = False

    def put_record(self, log: LogId, number: int, data: bytes) -> None:
        """Append a record; the core never leaves a gap."""
        records = self.records.setdefault(log, [])
        assert number == len(records), f"record {number} of {log} does not follow {len(records)}"
        records.append(data)

    def put_latent(self, keyframe: KeyframeId, latent: bytes) -> None:
        """Keep a latent; the oldest make room."""
        self.latent_bytes += len(latent) - len(self.latents.pop(keyframe, b""))
        self.latents[keyframe] = latent
        while self.latent_bytes > self.latent_bytes_max and len(self.latents) > 1:
            oldest = next(iter(self.latents))
            self.latent_bytes -= len(self.latents.pop(oldest))

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
