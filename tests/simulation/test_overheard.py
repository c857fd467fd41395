"""Who only listens to broadcasts learns of every keyframe, closure, correction and leader, each once."""

from collections import Counter

from tests.simulation.test_doctor_simulated import broken

from flocc_agent.core.effects import Broadcast, Effect
from flocc_agent.core.events import Event
from flocc_agent.core.reports import (
    ClosureAccepted,
    ClosureRejected,
    CorrectionApplied,
    Fact,
    KeyframeTaken,
    LeaderFollowed,
)
from flocc_agent.runtime.event_lines import Reported, of_kind
from flocc_launch.dashboard.snapshot import MapGroup
from flocc_launch.dashboard.state import SwarmState
from flocc_launch.simulation.simulate import playbacks_of, swarm_of
from flocc_launch.simulation.virtual_robot import Station
from flocc_launch.view.live_view import Overheard
from flocc_protocol.ids import KeyframeId
from flocc_protocol.messages import Envelope, decode, encode


def overheard() -> tuple[list[Reported[Fact]], list[Reported[Fact]]]:
    """Events that a listener made of two robots' broadcasts, and what really happened."""
    scenario = broken()
    swarm = swarm_of(scenario, playbacks_of(scenario, {}), scenario.seed)
    listener, events = Overheard(scenario.backend.steepness), list[Reported[Fact]]()

    def listen(station: Station, _: Event | None, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Broadcast):
                data = encode(Envelope(station.log, effect.message))
                events.extend(listener.events(decode(data), swarm.agenda.now_s))

    swarm.observers.append(listen)
    swarm.run_until(25.0)
    return events, swarm.told


def test_a_listener_hears_what_happened() -> None:
    heard, told = overheard()
    assert keyframes(heard) == keyframes(told)
    assert closures(heard) == closures(told)
    assert set(closures(heard).values()) == {1}
    assert {(e.robot, e.fact.leader) for e in of_kind(heard, LeaderFollowed)} == {("r1", "r1"), ("r2", "r1")}
    assert {event.robot for event in of_kind(heard, CorrectionApplied)} == {"r1", "r2"}


def test_a_rejection_has_the_ratio_that_its_robot_told() -> None:
    heard, told = overheard()
    assert {e.fact for e in of_kind(heard, ClosureRejected)} == {e.fact for e in of_kind(told, ClosureRejected)}


def keyframes(events: list[Reported[Fact]]) -> list[KeyframeId]:
    return sorted(event.fact.keyframe for event in of_kind(events, KeyframeTaken))


def closures(events: list[Reported[Fact]]) -> Counter[ClosureAccepted]:
    return Counter(event.fact for event in of_kind(events, ClosureAccepted))


def test_a_listeners_picture_is_that_of_the_run() -> None:
    events, told = overheard()
    state = SwarmState(["r1", "r2"])
    for event in events:
        state.apply(event)
    snapshot = state.snapshot(25.0, "broken")
    assert snapshot.maps == [MapGroup("map/r1", ["r1", "r2"])]
    assert snapshot.leaders == ["r1"]
    assert len(snapshot.closures) == len(of_kind(told, ClosureAccepted))
    assert all(end is not None for closure in snapshot.closures for end in closure.ends_m)
