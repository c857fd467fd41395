"""Readable traces: commands to a small swarm, each followed by what then happened.

    run 2
    ----
      1.50 r1 leads 1:r1

A trace is a text of such blocks, parted by blank lines; lines that start with `#` tell the story. `played` returns
the text with what really happened, so a test compares it with the file, or rewrites the file.

    robots r1 r2 server=9     switch robots on; =N is the compute class
    see r1 a b c              r1 takes keyframes of these places, two metres apart
    run 5                     let time pass, seconds
    partition r1 r2 | r3      these groups no longer hear each other
    deaf r1 r3                these two do not hear each other
    heal                      everybody hears everybody again
    mute correction           messages of this kind are swallowed
    unmute                    no longer
    kill r1                   the power is cut
    leave r1                  r1 stops in order
    start r1                  switch r1 on again, with its disk
    start r1 empty            switch r1 on again, without
    twin r1                   a second robot starts under the name r1
    replay r2                 the first correction for r2 arrives once more
    status                    whom each follows, in which frame, and what it holds
"""

from collections.abc import Callable
from dataclasses import replace
from typing import assert_never

import numpy as np

from flocc_agent.core.effects import (
    Broadcast,
    ChooseClosures,
    Deliver,
    DropLog,
    Effect,
    Encode,
    FetchLatent,
    Optimise,
    PersistCorrection,
    PersistRecord,
    PersistTerm,
    Register,
    Report,
    StepConsensus,
    Unicast,
)
from flocc_agent.core.events import Event, MessageReceived
from flocc_agent.core.interfaces import KeyframeLook, OdometryPair
from flocc_agent.core.pose_graph import map_frame
from flocc_agent.core.registration import Registration
from flocc_agent.core.reports import (
    Fact,
    LatentFailed,
    LatentLost,
    LeaderFollowed,
    LeaderLost,
    LogForked,
    LogGivenUp,
    NameTaken,
    NeighbourDown,
    NeighbourRestarted,
    NeighbourUp,
    PeerRefused,
    SolutionIgnored,
    name_of,
)
from flocc_agent.geometry import pose
from flocc_agent.radio import LinkOverride, LinkParameters, Partition, RadioParameters
from flocc_launch.scenarios.scenario import RobotScenario, Scenario, TracksScenario
from flocc_launch.simulation.rigid_alignment import align
from flocc_launch.simulation.swarm import Equipment, Swarm
from flocc_launch.simulation.virtual_playback import Capture, Playback
from flocc_launch.simulation.virtual_robot import Station
from flocc_protocol.arrays import Array
from flocc_protocol.errors import FloccError
from flocc_protocol.messages import CorrectionBatch, Envelope, Handover, LogCorrection

PLACES = "abcdefghijklmnopqrstuvwxyz"
APART_M = 2.0
NEVER_S = 1e9
SEED = 1


class TraceError(FloccError):
    """A trace that cannot be played; the message names the command."""


class PlaceEyes:
    """Perception that recognises places by their letter; every registration is perfect."""

    def watch(self, hidden: object) -> "PlaceEyes":  # noqa: ARG002
        """Sees no camera."""
        return self

    def look(self, capture: Capture, T_odom_camera: object) -> KeyframeLook:  # noqa: ARG002
        """A unit vector per place."""
        place = round(capture.stamp_s - NEVER_S)
        return KeyframeLook(Array.of(np.eye(len(PLACES))[place], "f4"), PLACES[place].encode())

    def register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Registration:  # noqa: ARG002
        """Both cameras stood at one place."""
        return Registration(np.eye(4), 100, 100, 1.0)

    def without(self, latent: bytes, hidden: object) -> bytes:  # noqa: ARG002
        """Nothing moves with the camera."""
        return latent


def played(text: str) -> str:
    """Play a trace from its beginning; the same text with what really happened."""
    blocks = [block for block in text.strip().split("\n\n") if block]
    trace: _Trace | None = None
    out: list[str] = []
    for block in blocks:
        lines = block.splitlines()
        story = [line for line in lines if line.startswith("#")]
        rest = [line for line in lines if not line.startswith("#")]
        if not rest:
            out.append("\n".join(story))
            continue
        trace = trace or _Trace(rest[0])
        happened = trace.execute(rest[0])
        out.append("\n".join([*story, rest[0], "----", *happened]))
    return "\n\n".join(out) + "\n"


class _Trace:
    """A swarm that commands act on."""

    def __init__(self, first: str) -> None:
        words = first.split()
        if not words or words[0] != "robots":
            raise TraceError(f"a trace begins with 'robots ...', not with {first!r}")
        classes = {name: int(value or 0) for name, _, value in (word.partition("=") for word in words[1:])}
        self._swarm = Swarm(_scenario(classes), {name: _places() for name in classes}, _equipment(), SEED)
        self._swarm.observers.append(self._observe)
        self._lines: list[str] = []
        self._corrections: dict[str, tuple[Station, LogCorrection]] = {}
        self._swarm.run_until(0.0)
        self._commands: dict[str, Callable[[list[str]], None]] = {
            "robots": lambda words: None,  # noqa: ARG005
            "see": self._see,
            "run": lambda words: self._swarm.run_until(self._swarm.agenda.now_s + float(words[0])),
            "partition": self._partition,
            "deaf": self._deafen,
            "heal": lambda words: self._links(RadioParameters()),  # noqa: ARG005
            "mute": lambda words: self._swarm.network.muted.update(dict.fromkeys(words, 1.0)),
            "unmute": lambda words: self._swarm.network.muted.clear(),  # noqa: ARG005
            "kill": lambda words: self._swarm.kill(words[0]),
            "leave": lambda words: self._swarm.leave(words[0]),
            "start": self._start,
            "twin": lambda words: self._swarm.add_twin(words[0]),
            "replay": self._replay,
            "status": lambda words: self._lines.extend(map(_status, self._swarm.running())),  # noqa: ARG005
        }

    def execute(self, command: str) -> list[str]:
        """Carry out one command; what happened, a line each."""
        word, *words = command.split()
        if word not in self._commands:
            raise TraceError(f"a trace has no command {word!r}")
        self._lines = []
        self._commands[word](words)
        return self._lines

    def _see(self, words: list[str]) -> None:
        for place in words[1:]:
            self._swarm.stations[words[0]].capture(PLACES.index(place))

    def _partition(self, words: list[str]) -> None:
        groups = tuple(tuple(group.split()) for group in " ".join(words).split("|"))
        self._links(RadioParameters(partitions=(Partition(groups, self._swarm.agenda.now_s),)))

    def _deafen(self, words: list[str]) -> None:
        links = self._swarm.radio.parameters
        dead = LinkParameters(loss_ratio=1.0)
        both = tuple(LinkOverride(a, b, dead) for a, b in (words, reversed(words)))
        self._links(replace(links, overrides=(*links.overrides, *both)))

    def _links(self, parameters: RadioParameters) -> None:
        self._swarm.radio.parameters = parameters

    def _start(self, words: list[str]) -> None:
        if words[1:] == ["empty"]:
            self._swarm.lose_disk(words[0])
        self._swarm.start(words[0])

    def _replay(self, words: list[str]) -> None:
        leader, correction = self._corrections[words[0]]
        message = CorrectionBatch((correction,))
        self._swarm.stations[words[0]].handle(MessageReceived(Envelope(leader.log, message)))

    def _observe(self, station: Station, event: Event | None, effects: list[Effect]) -> None:
        if isinstance(event, MessageReceived) and isinstance(event.envelope.message, CorrectionBatch):
            for correction in event.envelope.message.corrections:
                sender = self._swarm.stations[correction.term.leader.robot]
                if correction.knots is not None:
                    self._corrections.setdefault(correction.log.robot, (sender, correction))
        for effect in effects:
            text = _told(effect)
            if text is not None:
                self._lines.append(f"{self._swarm.agenda.now_s:6.2f} {station.name} {text}")


def _told(effect: Effect) -> str | None:
    """An effect in a few words; None for what no story needs."""
    match effect:
        case Encode(keyframe):
            return f"encodes {keyframe}"
        case FetchLatent(keyframe, holder):
            return f"fetches {keyframe} from {holder}"
        case Register(query=query, match=match):
            return f"registers {query} with {match}"
        case Deliver(correction, frame_changed):
            jump = ", which is another" if frame_changed else ""
            return f"applies {correction.term} round {correction.round} in {map_frame(correction.anchor)}{jump}"
        case Broadcast(message):
            return "hands over" if isinstance(message, Handover) else None
        case Optimise(term, number):
            return f"optimises in {term} round {number}"
        case Report(fact):
            return _reported(fact)
        case Unicast() | ChooseClosures() | StepConsensus() | PersistRecord() | PersistTerm():
            return None
        case PersistCorrection() | DropLog():
            return None
        case _:
            assert_never(effect)


def _reported(fact: Fact) -> str | None:
    """A fact in a few words; None for what no story needs."""
    match fact:
        case LeaderFollowed():
            return f"follows {fact.term}:{fact.leader_log}"
        case LeaderLost():
            return f"loses {fact.term}: {fact.reason}"
        case NeighbourUp() | NeighbourDown() | NeighbourRestarted():
            return f"{name_of(fact)} {fact.peer}"
        case LogForked() | NameTaken() | PeerRefused():
            return f"{name_of(fact)} {fact.peer}: {fact.reason}"
        case LatentLost() | LatentFailed():
            return f"{name_of(fact)} {fact.keyframe}"
        case LogGivenUp():
            return f"{name_of(fact)} {fact.log}"
        case SolutionIgnored():
            return f"ignores a solution of {fact.term} round {fact.round}"
    return None


def _status(station: Station) -> str:
    """One robot in a line."""
    core = station.core
    assert core is not None
    applied = core.corrections.applied
    frame = "no frame" if applied is None else map_frame(applied.anchor)
    logs = " ".join(f"{digest.log}:{digest.count}" for digest in core.gossip.digests())
    return (
        f"{station.name} {core.election.role.value} {core.election.term}, {frame}, "
        f"{core.assembly.closures} closures, holds {logs or 'nothing'}"
    )


def _scenario(classes: dict[str, int]) -> Scenario:
    robots = {name: RobotScenario(compute_class=value) for name, value in classes.items()}
    return Scenario(name="trace", tracks=TracksScenario(robots=1), robots=robots)


def _equipment() -> Equipment:
    return Equipment(PlaceEyes(), align)


def _places() -> Playback:
    """Places on a line; nothing is captured unless a command says so."""
    return Playback(tuple(_place(k) for k in range(len(PLACES))), np.eye(4), None)


def _place(number: int) -> Capture:
    def load() -> None:
        raise TraceError("places have no image")

    T_odom_body = pose(np.eye(3), np.array([APART_M * number, 0.0, 0.0]))
    return Capture(NEVER_S + number, T_odom_body, load)  # type: ignore[arg-type]
