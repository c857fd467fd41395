"""What a robot tells of the map that it opened: that it did, when it found itself in it, and who writes its logs."""

from collections.abc import Iterable, Mapping

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

    def state(self, best_similarities: Mapping[str, float], similarity_threshold: float) -> str:
        """Whether the robot is in the map, for people, and if not, how near it is to that.

        Args:
            best_similarities: Robot -> best similarity of its keyframes with one of this robot's.
            similarity_threshold: From which on two keyframes are registered.
        """
        frame = map_frame(self.saved.anchor)
        if self.found:
            return f"in {frame}"
        robots = {log.robot for log in self.saved.closed} | {str(log) for log in self.saved.closed}
        seen = [(best, robot) for robot, best in best_similarities.items() if robot in robots]
        if not seen:
            return f"not in {frame} yet: nothing compared so far"
        best, robot = max(seen)
        if best < similarity_threshold:
            return f"not in {frame} yet: best similarity {best:.3f}, with {robot}; {similarity_threshold:g} is needed"
        return f"not in {frame} yet: looks like {robot} ({best:.3f}); waits for closures that agree"

    def _opened(self) -> MapOpened:
        saved = self.saved
        logs = tuple(sorted(saved.closed))
        return MapOpened(
            map_frame=map_frame(saved.anchor), logs=logs, keyframes=saved.keyframes, is_fixed=saved.is_fixed
        )

    def _is_in_map(self, effect: Effect) -> bool:
        return isinstance(effect, Deliver) and effect.correction.anchor == self.saved.anchor
