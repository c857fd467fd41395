"""Claims on GNSS of a ROS 2 robot: fixes belong to keyframes by their stamps; bad ones are refused."""

from typing import Any

import numpy as np
import pytest
from tests.agent.runtime.ros2 import cdr_by_hand

from flocc_agent.core.measurements import GeodeticFix, Measurement
from flocc_agent.runtime.measurement_file import Stamped
from flocc_agent.runtime.ros2.satellite import WAITING_MAX, SatelliteFixes, fix_of
from flocc_agent.runtime.ros2.types import NAV_SAT_FIX, BadMessage, MessageTypes

PLACE = (48.0, 11.0, 500.0)
SPREAD = [4.0, 0, 0, 0, 4, 0, 0, 0, 9]


def message(**changes: Any) -> Any:
    fields = {"stamp": (100, 500_000_000), "frame": "gps", "place": PLACE, "covariance": SPREAD, **changes}
    return MessageTypes().read(cdr_by_hand.nav_sat_fix(**fields), NAV_SAT_FIX)


def fix(stamp_s: float) -> Stamped:
    return Stamped(stamp_s, GeodeticFix(48.0 + 1e-5 * stamp_s, 11.0, 500.0, np.eye(3)))


def told(*steps: tuple[str, float]) -> tuple[list[float], dict[str, int]]:
    """Stamps of the keyframes that got a fix, in the order in which they did, and what was dropped."""
    found: list[tuple[float, Measurement]] = []
    fixes = SatelliteFixes(lambda measurement, stamp_s: found.append((stamp_s, measurement)))
    for what, stamp_s in steps:
        if what == "fix":
            fixes.add_fix(fix(stamp_s))
        else:
            fixes.add_keyframe(stamp_s)
    for stamp_s, measurement in found:
        assert isinstance(measurement, GeodeticFix)
        assert measurement.latitude_deg == pytest.approx(48.0 + 1e-5 * stamp_s)
    return [stamp_s for stamp_s, _ in found], dict(fixes.dropped)


def test_a_message_is_a_geodetic_fix() -> None:
    read = fix_of(message())
    assert read.stamp_s == pytest.approx(100.5)
    assert isinstance(read.measurement, GeodeticFix)
    assert (read.measurement.latitude_deg, read.measurement.altitude_m) == (48.0, 500.0)
    np.testing.assert_allclose(read.measurement.covariance_m2, np.diag([4.0, 4.0, 9.0]))


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"status": -1}, "has no fix"),
        ({"known": 0}, "has no covariance"),
        ({"covariance": [0.0] * 9}, "not positive definite"),
        ({"place": (float("nan"), 0.0, 0.0)}, "no place on Earth"),
        ({"stamp": (-5, 0)}, "is no time"),
    ],
)
def test_what_is_no_fix_is_refused_with_a_reason(changes: dict[str, Any], complaint: str) -> None:
    with pytest.raises(BadMessage, match=complaint):
        fix_of(message(**changes))


def test_a_keyframe_gets_its_fix_whichever_comes_first() -> None:
    assert told(("fix", 1.0), ("keyframe", 1.4), ("fix", 2.0))[0] == [1.4]
    assert told(("fix", 1.0), ("fix", 2.0), ("keyframe", 1.4))[0] == [1.4]
    assert told(("fix", 1.0), ("keyframe", 1.2), ("keyframe", 1.7), ("fix", 2.0), ("fix", 3.0))[0] == [1.2, 1.7]


def test_a_keyframe_without_fixes_around_it_gets_none() -> None:
    assert told(("keyframe", 0.5), ("fix", 1.0), ("fix", 2.0)) == ([], {"keyframe without fixes within 2 s": 1})
    assert told(("fix", 1.0), ("keyframe", 2.0), ("fix", 9.0)) == ([], {"keyframe without fixes within 2 s": 1})


def test_a_fix_of_the_past_is_dropped() -> None:
    assert told(("fix", 2.0), ("fix", 1.0)) == ([], {"fix back in time": 1})


def test_what_waits_has_a_maximum() -> None:
    keyframes = [("keyframe", 10.0 + 0.01 * k) for k in range(2 * WAITING_MAX)]
    found, _ = told(("fix", 9.9), *keyframes, ("fix", 11.4))
    assert len(found) == WAITING_MAX
