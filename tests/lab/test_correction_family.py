"""Both error rates of what a robot believes of a leader, on a few members of the drawn family."""

from dataclasses import replace

import numpy as np

from flocc_agent.core.corrections import Corrections
from flocc_agent.core.effects import Deliver, Unicast
from flocc_agent.core.parameters import GossipParameters
from flocc_lab.correction_family import OWN, drawn, judged
from flocc_protocol.messages import KnotRequest


def test_honest_corrections_are_believed_and_lies_are_held() -> None:
    table = judged(6, first=41, slow=1)
    assert sum(bad for _, bad in table.honest.values()) <= 1
    told, held = (sum(each[k] for each in table.lies.values()) for k in (0, 1))
    assert held >= 0.85 * told > 100
    told, held = (sum(each[k] for each in table.slow.values()) for k in (0, 1))
    assert held >= 0.7 * told > 10


def test_a_doubted_correction_is_believed_once_the_poses_of_others_came() -> None:
    """The odometry of a robot that was met missed a ride too, and only its newest correction is known."""
    member = drawn(np.random.default_rng((770000, 3, 39)), 3)
    machine = Corrections(OWN, GossipParameters(), odometry=member.odometry, towards=lambda _: ["x"], evidence=member)
    assert member.in_short
    for log in member.in_short:
        assert machine.on_message("x", replace(member.others[log], knots=None)) == []
        assert machine.on_message("x", member.others[log]) == []  # not kept before anything rests on it
    own = member.placed(member.solution).own
    assert machine.on_message("x", own) == []
    (asked,) = machine.ask_knots(0.5)
    assert isinstance(asked, Unicast)
    assert isinstance(asked.message, KnotRequest)
    assert {version.log for version in asked.message.versions} == member.in_short
    for log in member.in_short:
        machine.on_message("x", member.others[log], 0.6)
    assert [effect.correction for effect in machine.reconsider(1.0) if isinstance(effect, Deliver)] == [own]
    newer = [replace(member.others[log], round=2, knots=None) for log in member.in_short]
    assert [machine.on_message("x", each, 2.0) for each in newer] == [[] for _ in newer]
    assert machine.ask_knots(3.0) == []
