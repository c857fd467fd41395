"""GNSS of a ROS 2 robot: NavSatFix messages as geodetic fixes of its keyframes, interpolated to their stamps."""

from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import numpy as np

from flocc_agent.core.measurements import BadMeasurement, GeodeticFix, Measurement
from flocc_agent.runtime.measurement_file import GAP_MAX_S, Stamped, position_at
from flocc_agent.runtime.ros2.types import BadMessage, checked_stamp_ns

WAITING_MAX = 64
"""Keyframes that wait for the next fix, and fixes that wait for a keyframe; the oldest gives way."""
COVARIANCE_UNKNOWN = 0


def fix_of(message: Any) -> Stamped:
    """A NavSatFix message.

    Raises:
        BadMessage: It holds no position, or says nothing of how exact it is.
    """
    stamp = message.header.stamp
    stamp_s = checked_stamp_ns(stamp.sec, stamp.nanosec) * 1e-9
    if message.status.status < 0:
        raise BadMessage("the receiver has no fix")
    if message.position_covariance_type == COVARIANCE_UNKNOWN:
        raise BadMessage("the fix has no covariance (position_covariance_type is 0)")
    covariance = np.array(message.position_covariance, dtype=float).reshape(3, 3)
    try:
        return Stamped(stamp_s, GeodeticFix(message.latitude, message.longitude, message.altitude, covariance))
    except BadMeasurement as error:
        raise BadMessage(str(error)) from error


class SatelliteFixes:
    """Brings fixes and keyframes together, whichever comes first."""

    def __init__(self, add_measurement: Callable[[Measurement, float], None]) -> None:
        """Start with none; `add_measurement` takes the fix of the keyframe with a stamp."""
        self.dropped = Counter[str]()
        self._add_measurement = add_measurement
        self._fixes: deque[Stamped] = deque(maxlen=WAITING_MAX)
        self._keyframes_s: deque[float] = deque(maxlen=WAITING_MAX)

    def add_fix(self, fix: Stamped) -> bool:
        """Take in a fix; returns whether it is newer than the one before."""
        if self._fixes and fix.stamp_s <= self._fixes[-1].stamp_s:
            self.dropped["fix back in time"] += 1
            return False
        self._fixes.append(fix)
        self._measure()
        return True

    def add_keyframe(self, stamp_s: float) -> None:
        """A keyframe was taken."""
        self._keyframes_s.append(stamp_s)
        self._measure()

    def _measure(self) -> None:
        """Hand out fixes of keyframes that have fixes on both sides; those that fixes left behind get none."""
        fixes, waiting = list(self._fixes), deque[float](maxlen=WAITING_MAX)
        for stamp_s in self._keyframes_s:
            fix = position_at(fixes, stamp_s)
            if fix is not None:
                self._give(fix.measurement, stamp_s)
            elif not fixes or fixes[-1].stamp_s < stamp_s:
                waiting.append(stamp_s)
            else:
                self.dropped[f"keyframe without fixes within {GAP_MAX_S:g} s"] += 1
        self._keyframes_s = waiting

    def _give(self, measurement: Measurement, stamp_s: float) -> None:
        try:
            self._add_measurement(measurement, stamp_s)
        except BadMeasurement as error:
            self.dropped[str(error)] += 1
