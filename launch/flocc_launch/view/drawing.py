"""What a run does, drawn into a rerun recording event by event: the same for a run that is over and one that goes on.

live/ROBOT          its odom frame in the map, below it its odometry and where it is now, with a star where it leads
links               robots that hear each other, in both directions
closures            accepted closures, from blue (probability 0) to yellow (1)
closure/...         the images of a closure when it was accepted
solver/...          cost, closures used and rejected, of each round
events              sentences
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.reports import (
    ClosureAccepted,
    CorrectionApplied,
    Fact,
    KeyframeTaken,
    LeaderFollowed,
    LeaderLost,
    NeighbourDown,
    NeighbourUp,
    RoundSolved,
)
from flocc_agent.geometry import pose_from_tq
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.facts import AgentDied, AgentStopped
from flocc_agent.runtime.recording import Frame, Recording
from flocc_launch.dashboard.state import RobotState, SwarmState, place_of
from flocc_launch.dashboard.words import sentence_of
from flocc_protocol.ids import KeyframeId

Float = NDArray[np.float64]
Colour = tuple[int, int, int]

TIMELINE = "run"
IMAGES_MAX = 200
ROBOTS_MAX = 256
CHUNK_POINTS = 64
CLOSURES_DRAWN_MAX = 1000
CLOSURES_PERIOD_S = 1.0
COLOURS: tuple[Colour, ...] = (
    (0, 114, 178), (213, 94, 0), (0, 158, 115), (181, 80, 143), (201, 138, 0), (58, 155, 217), (107, 95, 199)
)  # fmt: skip
GREY: Colour = (130, 138, 146)
GREEN: Colour = (0, 158, 115)


class Drawing:
    """Takes events in order of time and logs what they change; all sizes are bounded."""

    def __init__(self, rr: Any, recording: Any, robots: list[str], images: Mapping[str, Recording]) -> None:
        """Begin with an empty picture.

        Args:
            rr: The rerun package.
            recording: Where to log.
            robots: Names, for their colours.
            images: Recordings of the robots whose images are at hand.
        """
        self._rr = rr
        self._recording = recording
        self._robots = sorted(robots)
        self._images = images
        self._state = SwarmState(self._robots)
        self._chunks: dict[str, list[Float]] = {}
        self._stamps_s: dict[KeyframeId, float] = {}
        self._images_drawn = 0
        self._closures_due_s = 0.0
        self._closures_changed = False

    def take(self, event: Reported[Fact]) -> None:
        """Draw what one event changes."""
        self._state.apply(event)
        self._recording.set_time(TIMELINE, duration=event.t)
        fact = event.fact
        match fact:
            case KeyframeTaken():
                self._odometry(event.robot, fact)
            case CorrectionApplied():
                T = pose_from_tq(np.array(fact.T_map_odom))
                transform = self._rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])
                self._recording.log(f"live/{event.robot}", transform)
                self._closures_changed = True
                self._links()
            case ClosureAccepted():
                self._closures_changed = True
                if fact.probability is not None:
                    self._recording.log("closure/probability", self._rr.Scalars(fact.probability))
                self._closure_images(fact)
            case NeighbourUp() | NeighbourDown() | AgentDied() | AgentStopped():
                self._links()
            case LeaderFollowed() | LeaderLost():
                self._here(event.robot)
            case RoundSolved():
                self._solver(fact)
        self._closures(event.t)
        said = sentence_of(event)
        if said is not None:
            text = self._rr.TextLog(f"{event.robot}: {said}", color=self.colour(event.robot))
            self._recording.log("events", text)

    def colour(self, robot: str) -> Colour:
        """A robot's colour, as in the report; of one that was not known before, the next one."""
        if robot not in self._robots and len(self._robots) < ROBOTS_MAX:
            self._robots.append(robot)
        return COLOURS[self._robots.index(robot) % len(COLOURS)] if robot in self._robots else GREY

    def _odometry(self, robot: str, taken: KeyframeTaken) -> None:
        """One more keyframe: the open piece of the line is logged anew, so that a long walk is not."""
        self._stamps_s[taken.keyframe] = taken.stamp_s
        piece = self._chunks.setdefault(robot, [])
        piece.append(np.array(taken.T_odom_body[:3]))
        number = taken.keyframe.index // CHUNK_POINTS
        strip = self._rr.LineStrips3D([np.array(piece)], colors=[self.colour(robot)])
        self._recording.log(f"live/{robot}/odometry/{number}", strip)
        if len(piece) > CHUNK_POINTS:
            self._chunks[robot] = piece[-1:]
        self._here(robot)

    def _here(self, robot: str) -> None:
        """Where a robot is, and whether it leads."""
        state = self._state.robots[robot]
        if not state.positions_odom_m:
            return
        here_m = state.positions_odom_m[max(state.positions_odom_m)]
        leads = state.leader == robot
        point = self._rr.Points3D(
            [here_m], colors=[self.colour(robot)], radii=[0.3 if leads else 0.15], labels=[f"{robot}{' ★' * leads}"]
        )
        self._recording.log(f"live/{robot}/here", point)

    def _links(self) -> None:
        """Lines between robots of one map that hear each other."""
        strips = list(self._heard_both_ways())
        self._recording.log(
            "links", self._rr.LineStrips3D(strips, colors=[GREEN] * len(strips), radii=[0.03] * len(strips))
        )

    def _heard_both_ways(self) -> Iterator[Float]:
        robots = self._state.robots
        for name, robot in sorted(robots.items()):
            for peer in sorted(robot.neighbours):
                other = robots.get(peer)
                if other is None or not name < peer or name not in other.neighbours:
                    continue
                ends = [place(robot), place(other)]
                if robot.map_frame is not None and robot.map_frame == other.map_frame and None not in ends:
                    yield np.array(ends)

    def _closures(self, t: float) -> None:
        """All closures with both ends in one map, where they changed; at most once a second."""
        if not self._closures_changed or t < self._closures_due_s:
            return
        self._closures_changed, self._closures_due_s = False, t + CLOSURES_PERIOD_S
        drawn = list(self._joined())[-CLOSURES_DRAWN_MAX:]
        strips = self._rr.LineStrips3D([ends for ends, _ in drawn], colors=[colour for _, colour in drawn])
        self._recording.log("closures", strips)

    def _joined(self) -> Iterator[tuple[Float, Colour]]:
        for keyframes, probability in self._state.closures.items():
            frames = {self._state.robots[k.log.robot].map_frame for k in keyframes if k.log.robot in self._state.robots}
            ends = [place_of(self._state, keyframe) for keyframe in keyframes]
            if len(frames) == 1 and None not in frames and None not in ends:
                yield np.array(ends), confidence_colour(probability)

    def _closure_images(self, closure: ClosureAccepted) -> None:
        """Both images of a closure, where they are at hand; at most `IMAGES_MAX` closures."""
        if self._images_drawn >= IMAGES_MAX:
            return
        found = {side: self._frame(keyframe) for side, keyframe in (("query", closure.query), ("match", closure.match))}
        self._images_drawn += any(frame is not None for frame in found.values())
        for side, frame in found.items():
            if frame is not None:
                pixels = frame[0].load_image(frame[1]).pixels
                self._recording.log(f"closure/{side}", self._rr.Image(pixels).compress(jpeg_quality=80))

    def _frame(self, keyframe: KeyframeId) -> tuple[Recording, Frame] | None:
        """The recording's frame that a keyframe was, None where it is not known."""
        source, stamp_s = self._images.get(keyframe.log.robot), self._stamps_s.get(keyframe)
        if source is None or stamp_s is None:
            return None
        return source, min(source.frames, key=lambda frame: abs(frame.stamp_s - stamp_s))

    def _solver(self, solved: RoundSolved) -> None:
        """How well each round's graph fits together: what is left of all residuals, and what was thrown out."""
        for name, value in (
            ("cost", solved.cost),
            ("closures_used", solved.closures_used),
            ("closures_rejected", solved.closures_rejected),
        ):
            if value is not None:
                self._recording.log(f"solver/{name}", self._rr.Scalars(float(value)))


def place(robot: RobotState) -> list[float] | None:
    """Where a robot was last, in its map frame."""
    position_m = robot.position_m(max(robot.positions_odom_m, default=-1))
    return None if position_m is None else [float(v) for v in position_m]


def confidence_colour(probability: float | None) -> Colour:
    """From blue (0) to yellow (1)."""
    p = 0.5 if probability is None else probability
    return int(254 * p), int(34 + 198 * p), 78
