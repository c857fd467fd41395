"""Where odometry begins anew: a jump that no robot makes, or a return to its zero.

What comes after is of another odometry frame, so a recording is cut there. A single pose that is off, with the next one
where it should be, is left out. Nothing else is concluded from a jump: a rare odometry may move far between two poses.
"""

import math

Numbers = tuple[float, ...]
Posed = tuple[int, Numbers]

ACCELERATION_MAX_M_PER_S2 = 100.0
STEP_MIN_S = 0.02
JUMP_MIN_M = 0.5
ZERO_M, ZERO_W = 0.05, 0.9995
"""A pose this near to the identity is where odometry begins: 5 cm, and 4 degrees by w of its quaternion."""
HOMEWARD_SPEED_RATIO = 3.0


class JourneyWatch:
    """Called with every pose in order; passes on those that are good, and says where a new journey begins.

    Attributes:
        outliers: Single poses that were left out.
    """

    def __init__(self) -> None:
        self.outliers = 0
        self._last: Posed | None = None
        self._speed_m_per_s: float | None = None
        self._held: Posed | None = None

    def take(self, stamp_ns: int, numbers: Numbers) -> list[tuple[bool, int, Numbers]]:
        """Poses that are known to be good by now, each with whether a journey begins with it.

        Args:
            stamp_ns: Of the pose; one that is not after the last is passed on, for whoever counts those.
            numbers: `tx ty tz qx qy qz qw`.
        """
        now = (stamp_ns, numbers)
        if self._held is None:
            if not self._jumps(self._last, now):
                return [self._passed(False, now)]
            self._held = now
            return []
        held, self._held = self._held, None
        if self._goes_on_from(held, now):
            self._last, self._speed_m_per_s = None, None
            return [self._passed(True, held), self._passed(False, now)]
        self.outliers += 1
        return [self._passed(False, now)]

    def _goes_on_from(self, held: Posed, now: Posed) -> bool:
        """Whether a pose fits the one that jumped better than the one before it."""
        if self._last is None or self._speed_m_per_s is None or now[0] <= held[0]:
            return False
        off_m_per_s = [abs(_speed_m_per_s(before, now) - self._speed_m_per_s) for before in (held, self._last)]
        return off_m_per_s[0] < off_m_per_s[1]

    def _passed(self, is_new: bool, now: Posed) -> tuple[bool, int, Numbers]:
        if self._last is None or now[0] > self._last[0]:
            self._speed_m_per_s = None if self._last is None else _speed_m_per_s(self._last, now)
            self._last = now
        else:
            self._speed_m_per_s = None  # a clock that was set back says nothing about speed
        return is_new, *now

    def _jumps(self, last: Posed | None, now: Posed) -> bool:
        if last is None or now[0] <= last[0] or self._speed_m_per_s is None:
            return False
        before_m_per_s, speed_m_per_s = self._speed_m_per_s, _speed_m_per_s(last, now)
        step_s = (now[0] - last[0]) * 1e-9
        if speed_m_per_s * step_s <= JUMP_MIN_M:
            return False
        accelerated = abs(speed_m_per_s - before_m_per_s) > ACCELERATION_MAX_M_PER_S2 * max(step_s, STEP_MIN_S)
        return accelerated or (_is_return(last[1], now[1]) and speed_m_per_s > HOMEWARD_SPEED_RATIO * before_m_per_s)


def _speed_m_per_s(last: Posed, now: Posed) -> float:
    return math.dist(last[1][:3], now[1][:3]) / ((now[0] - last[0]) * 1e-9)


def _is_return(last: Numbers, now: Numbers) -> bool:
    """Whether a pose is the identity, and the one before was not near it."""
    return abs(now[6]) > ZERO_W and math.hypot(*now[:3]) < ZERO_M and math.hypot(*last[:3]) > JUMP_MIN_M
