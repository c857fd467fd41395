"""Who only listens to broadcasts learns of every keyframe, closure, correction and leader, each once."""

from collections import Counter

from tests.simulation.test_doctor_simulated import broken

from flocc_agent.core.effects import Broadcast, Effect
from flocc_agent.core.events import Event as CoreEvent
from flocc_launch.dashboard.state import SwarmState
from flocc_launch.runs.run_records import ClosureAccepted, CorrectionApplied, Event, KeyframeCaptured, LeaderFollowed
from flocc_launch.simulation.simulate import playbacks_of, swarm_of
from flocc_launch.simulation.virtual_robot import Station
from flocc_launch.view.live_view import Overheard
from flocc_protocol.messages import Envelope, decode, encode


def overheard() -> tuple[list[Event], list[dict[str, object]]]:
    """Events that a listener made of two robots' broadcasts, and what really happened."""
    scenario = broken()
    swarm = swarm_of(scenario, playbacks_of(scenario, {}), scenario.seed)
    listener, events = Overheard(scenario.backend.steepness), list[Event]()

    def listen(station: Station, _: CoreEvent | None, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Broadcast):
                data = encode(Envelope(station.log, effect.message))
                events.extend(listener.events(decode(data), swarm.agenda.now_s))

    swarm.observers.append(listen)
    swarm.run_until(25.0)
    return events, swarm.lines


def test_a_listener_hears_what_happened() -> None:
    events, lines = overheard()
    keyframes = [event.keyframe for event in events if isinstance(event, KeyframeCaptured)]
    assert sorted(keyframes) == sorted(str(line["keyframe"]) for line in lines if line["event"] == "keyframe")
    closures = Counter((event.query, event.match) for event in events if isinstance(event, ClosureAccepted))
    assert closures == Counter((line["query"], line["match"]) for line in lines if line["event"] == "closure_accepted")
    assert set(closures.values()) == {1}
    assert {(e.robot, e.leader) for e in events if isinstance(e, LeaderFollowed)} == {("r1", "r1"), ("r2", "r1")}
    assert {event.robot for event in events if isinstance(event, CorrectionApplied)} == {"r1", "r2"}


def test_a_listeners_picture_is_that_of_the_run() -> None:
    events, lines = overheard()
    state = SwarmState(["r1", "r2"])
    for event in events:
        state.apply(event)
    snapshot = state.snapshot(25.0)
    assert snapshot["maps"] == [{"frame": "map/r1", "robots": ["r1", "r2"]}]
    assert snapshot["leaders"] == ["r1"]
    assert len(snapshot["closures"]) == sum(line["event"] == "closure_accepted" for line in lines)
    assert all(end is not None for closure in snapshot["closures"] for end in closure["ends_m"])
