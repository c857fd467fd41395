"""What a robot finds on its disk when it starts."""

from dataclasses import dataclass

from flocc_agent.core.saved_map import SavedMap
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import LogCorrection


@dataclass(frozen=True, slots=True)
class Restored:
    """What a robot finds on its disk when it starts.

    Attributes:
        records: (log, encoded records in order) of every log, the own one included.
        latents: Keyframes whose latents are stored.
        term_counter: Highest term counter the robot claimed.
        correction: The correction it applied last.
        frame_changed: That correction changed the map frame, and nobody knows whether consumers heard of it.
        saved: The map that it opens; its logs are among the records, its latents among the latents.
        journeys: Earlier logs of its own that it goes on from.
    """

    records: tuple[tuple[LogId, tuple[bytes, ...]], ...] = ()
    latents: tuple[KeyframeId, ...] = ()
    term_counter: int = 0
    correction: LogCorrection | None = None
    frame_changed: bool = False
    saved: SavedMap | None = None
    journeys: frozenset[LogId] = frozenset()

    def closed(self) -> frozenset[LogId]:
        """Logs that nobody writes any more, and whose latents are on this robot's disk."""
        return self.journeys if self.saved is None else self.journeys | self.saved.closed

    def counter_max(self) -> int:
        """Highest term counter that the robot knew of: a term it claims must be above what it applied."""
        return max(self.term_counter, self.correction.term.counter if self.correction else 0)
