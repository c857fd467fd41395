"""A leader that lies: what it says of where others are is held against what they hold themselves.

Robots with keys do not follow it any more; the others keep their frame, and have another leader.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from tests.agent.core.virtual_time import EveryoneSigns

from flocc_agent.core import plausibility
from flocc_agent.core.correction_evidence import Placed
from flocc_agent.core.distrust import DISTRUSTED_FIRST_S
from flocc_agent.core.effects import Deliver, Effect
from flocc_agent.core.events import Event
from flocc_agent.core.knots import corrected
from flocc_agent.core.plausibility import BENT, HELD_BACK_S, UNTIED
from flocc_agent.core.reports import LeaderFollowed, PeerRefused
from flocc_agent.core.robot import Robot
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation import virtual_robot
from flocc_launch.simulation.campaign import prepared
from flocc_launch.simulation.swarm import Swarm
from flocc_launch.simulation.virtual_robot import Station
from flocc_protocol.arrays import Array
from flocc_protocol.ids import LogId
from flocc_protocol.messages import CorrectionBatch, LogCorrection

FAR_M = 15_600e3
LIAR = "r3"
LIES_AT_S = 30.0
JUMP_M = 5.0
"""No honest round moves a robot of these swarms by so much, once all are in one map."""


def scenario() -> Scenario:
    fields: dict[str, Any] = {
        "name": "liar",
        "tracks": {"robots": 3, "seed": 4, "area_m": 20.0, "length_m": 80.0},
        "keyframes": {"distance_m": 1.0},
        "robots": {LIAR: {"compute_class": 9}},
        "perception": {"method": "synthetic", "synthetic": {"outlier_probability": 0.0, "alias_probability": 0.0}},
        "duration_s": 120.0,
    }
    return Scenario.model_validate(fields)


def swarm(monkeypatch: pytest.MonkeyPatch, keys: bool) -> Swarm:
    if keys:
        monkeypatch.setattr(virtual_robot, "Robot", partial(Robot, sealer=EveryoneSigns()))
    made = prepared(scenario())
    made.run_until(0.0)
    return made


def shifted(message: LogCorrection, by_m: float) -> LogCorrection:
    x, y, z, *q = message.T_map_odom
    return replace(message, T_map_odom=(x + by_m, y, z, q[0], q[1], q[2], q[3]))


def moved_away(message: LogCorrection) -> LogCorrection:
    return shifted(message, FAR_M)


def torn_off(message: LogCorrection) -> LogCorrection:
    """Within the reach of everybody's ways, but away from all closures."""
    return shifted(message, 60.0)


def bent(message: LogCorrection) -> LogCorrection:
    """Every second knot is elsewhere."""
    assert message.knots is not None
    numbers = np.arange(30)
    twists = np.zeros((len(numbers), 6))
    twists[::2, 4] = 8.0
    knots = replace(message.knots, keyframes=Array.of(numbers, "u4"), twists=Array.of(twists, "f4"))
    return replace(message, knots=knots)


def of_a_made_up_map(message: LogCorrection) -> LogCorrection:
    return replace(moved_away(message), anchor=LogId("a"))


LIES: dict[str, Callable[[LogCorrection], LogCorrection]] = {
    "moved by 15,600 km": moved_away,
    "torn off all closures": torn_off,
    "bent": bent,
    "in a map that does not exist": of_a_made_up_map,
}


def let_it_lie(made: Swarm, lie: Callable[[LogCorrection], LogCorrection], for_s: float) -> None:
    """Send everybody a false correction, four times a second, in the liar's own name and term, and no true one."""
    liar = made.stations[LIAR]
    assert liar.core is not None
    liar.core.corrections.publish = lambda *_: []  # type: ignore[method-assign]
    honest = {s.name: s.core.corrections.applied for s in made.running() if s.core is not None and s.name != LIAR}

    def send(number: int) -> None:
        term = liar.core.election.term if liar.core is not None else None
        for name, last in honest.items():
            assert last is not None
            if term is not None and term.leader == liar.log:
                told = lie(replace(last, term=term, round=1000 + number, signature=bytes(64)))
                liar._around.unicast(liar, name, CorrectionBatch((told,)))
                liar._around.broadcast(liar, CorrectionBatch((replace(told, knots=None),)))

    for number in range(int(4 * for_s)):
        made.agenda.at(made.agenda.now_s + 0.25 * number, lambda number=number: send(number))  # type: ignore[misc]


class Jumps:
    """How far what consumers get moves a robot's keyframes, at most, after the liar began."""

    def __init__(self, made: Swarm) -> None:
        self.worst_m = 0.0
        self._swarm = made
        self._last: dict[str, np.ndarray] = {}
        made.observers.append(self._step)

    def _step(self, station: Station, event: Event | None, effects: list[Effect]) -> None:
        assert station.core is not None
        for effect in effects:
            if isinstance(effect, Deliver) and station.name != LIAR:
                odometry = station.core.assembly.odometry(station.log)
                at_m = corrected(effect.correction, odometry, np.arange(len(odometry)))[:, :3, 3]
                before, self._last[station.name] = self._last.get(station.name), at_m
                if before is not None and self._swarm.agenda.now_s > LIES_AT_S:
                    moved_m = np.linalg.norm(at_m[: len(before)] - before, axis=1)
                    self.worst_m = max(self.worst_m, float(moved_m.max()))


def refused(made: Swarm) -> set[str]:
    facts = [told.fact for told in made.told if told.robot != LIAR]
    return {fact.reason for fact in facts if isinstance(fact, PeerRefused) and fact.peer == LIAR}


def leaders(made: Swarm) -> list[str]:
    terms = [station.core.election.term for station in made.running() if station.core and station.name != LIAR]
    return [term.leader.robot for term in terms if term is not None]


@pytest.mark.parametrize("lie", LIES.values(), ids=LIES)
@pytest.mark.parametrize("keys", [False, True], ids=["open", "keys"])
def test_a_lie_moves_nobody(monkeypatch: pytest.MonkeyPatch, lie: Callable[..., LogCorrection], keys: bool) -> None:
    made = swarm(monkeypatch, keys)
    jumps = Jumps(made)
    made.run_until(LIES_AT_S)
    assert leaders(made) == [LIAR, LIAR]
    let_it_lie(made, lie, 4 * HELD_BACK_S)
    made.run_until(LIES_AT_S + 4 * HELD_BACK_S)
    assert jumps.worst_m < JUMP_M
    assert refused(made)
    if keys and UNTIED not in str(refused(made)):
        assert leaders(made) == ["r1", "r1"]


def test_who_lied_is_followed_again_after_a_while_and_another_leader_corrects_meanwhile(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = swarm(monkeypatch, keys=True)
    made.run_until(LIES_AT_S)
    let_it_lie(made, moved_away, 1.5 * HELD_BACK_S)
    made.run_until(LIES_AT_S + 3 * HELD_BACK_S)
    for name in ("r1", "r2"):
        other = made.stations[name].core
        assert other is not None
        assert other.corrections.applied is not None
        assert other.corrections.applied.term.leader.robot == "r1"
    made.run_until(LIES_AT_S + 3 * HELD_BACK_S + DISTRUSTED_FIRST_S)
    assert leaders(made) == [LIAR, LIAR]
    followed = [told.fact.leader for told in made.told if told.robot == "r2" and isinstance(told.fact, LeaderFollowed)]
    assert followed[-1] == LIAR
    assert followed.count(LIAR) > 1
    assert "r1" in followed


def doubts_all(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """One robot finds something to say against every correction."""
    judged = plausibility.contradiction

    def contradicted(placed: Placed, *others: Any) -> str | None:
        return BENT if placed.own.log.robot == name else judged(placed, *others)

    monkeypatch.setattr(plausibility, "contradiction", contradicted)


@pytest.mark.parametrize("keys", [False, True], ids=["open", "keys"])
def test_a_robot_that_doubts_an_honest_leader_solves_the_graph_itself_and_believes_it_then(
    monkeypatch: pytest.MonkeyPatch, keys: bool
) -> None:
    doubts_all(monkeypatch, "r2")
    made = swarm(monkeypatch, keys)
    made.run_until(1.5 * HELD_BACK_S)
    doubting = made.stations["r2"].core
    assert doubting is not None
    assert doubting.corrections.applied is not None
    assert leaders(made) == [LIAR, LIAR]
    assert not refused(made)
    made.run_until(5.0 * HELD_BACK_S)
    leader = made.stations[LIAR].core
    assert leader is not None
    newest = leader.corrections.of(doubting.log)
    assert newest is not None
    assert doubting.corrections.applied.version == newest.version


def test_a_lie_that_only_an_own_solution_refutes_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    made = swarm(monkeypatch, keys=True)
    jumps = Jumps(made)
    made.run_until(LIES_AT_S)
    doubts_all(monkeypatch, "r2")
    let_it_lie(made, lambda message: shifted(message, 40.0), 2 * HELD_BACK_S)
    made.run_until(LIES_AT_S + 2 * HELD_BACK_S)
    assert jumps.worst_m < JUMP_M
    assert BENT in str(refused(made))
