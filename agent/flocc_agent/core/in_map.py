"""What a robot tells of the map that it opened: that it did, when it found itself in it, and who writes its logs."""

from collections.abc import Iterable

from flocc_agent.core.effects import Deliver, Effect, Report
from flocc_agent.core.pose_graph import map_frame
from flocc_agent.core.reports import FoundInMap, MapLogWritten, MapOpened
from flocc_agent.core.saved_map import SavedMap
from flocc_protocol.ids import LogId


class InMap:
    """One robot and its opened map.

    Attributes:
        saved: The map.
        found: Whether the robot has had a correction in the map's frame.
    """

    def __init__(self, saved: SavedMap, now: float) -> None:
        self.saved = saved
        self.found = False
        self._opened_s = now
        self._first_keyframe_s: float | None = None
        self._told = False
        self._writers: set[LogId] = set()

    def told(self, effects: Iterable[Effect], keyframes: int, now: float) -> list[Effect]:
        """What there is to tell after a step of the robot with these effects."""
        news: list[Effect] = [] if self._told else [Report(self._opened())]
        self._told = True
        if self._first_keyframe_s is None and keyframes:
            self._first_keyframe_s = now
        if not self.found and any(self._is_in_map(effect) for effect in effects):
            self.found = True
            since_s = now if self._first_keyframe_s is None else self._first_keyframe_s
            fact = FoundInMap(
                map_frame=map_frame(self.saved.anchor),
                keyframes=keyframes,
                after_start_s=round(now - self._opened_s, 3),
                after_keyframe_s=round(now - since_s, 3),
            )
            news.append(Report(fact))
        return news

    def on_heartbeat(self, sender: LogId) -> list[Effect]:
        """Say once of each robot in range that it writes one of the map's logs."""
        if sender not in self.saved.closed or sender in self._writers:
            return []
        self._writers.add(sender)
        return [Report(MapLogWritten(peer=sender.robot, log=sender))]

    def _opened(self) -> MapOpened:
        saved = self.saved
        logs = tuple(sorted(saved.closed))
        return MapOpened(
            map_frame=map_frame(saved.anchor), logs=logs, keyframes=saved.keyframes, is_fixed=saved.is_fixed
        )

    def _is_in_map(self, effect: Effect) -> bool:
        return isinstance(effect, Deliver) and effect.correction.anchor == self.saved.anchor
