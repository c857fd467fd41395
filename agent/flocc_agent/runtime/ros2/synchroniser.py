"""Images with the odometry of their time: each image waits until odometry has passed it, and is then interpolated.

Both queues are bounded. What is lost, and why, is counted; nothing is ever invented for it.
"""

from collections import Counter, deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.runtime.trajectory import Trajectory

Float = NDArray[np.float64]

ODOMETRY_MAX = 4096


@dataclass(frozen=True, slots=True, eq=False)
class PosedImage:
    """A serialised image and where odometry says it was taken."""

    stamp_ns: int
    payload: bytes
    T_odom_body: Float


class Synchroniser:
    """Puts a stream of images and a stream of odometry together."""

    def __init__(self, images_max: int, gap_max_s: float, bytes_max: int = 2**62) -> None:
        """Prepare.

        Args:
            images_max: Images that wait; the oldest gives way.
            gap_max_s: Longer pauses of odometry are not bridged.
            bytes_max: Of the images that wait; one may always.
        """
        self._bytes_max = bytes_max
        self._waiting_bytes = 0
        self.dropped = Counter[str]()
        self._images_max = images_max
        self._gap_max_s = gap_max_s
        self._images: deque[tuple[int, bytes]] = deque()
        self._odometry: deque[tuple[int, Float]] = deque(maxlen=ODOMETRY_MAX)
        self._image_last_ns: int | None = None

    @property
    def latest(self) -> tuple[int, Float] | None:
        """The newest odometry."""
        return self._odometry[-1] if self._odometry else None

    def add_odometry(self, stamp_ns: int, T_odom_body: Float) -> bool:
        """Take in odometry; returns whether it is newer than what was there."""
        if self._odometry and stamp_ns <= self._odometry[-1][0]:
            self.dropped["odometry back in time"] += 1
            return False
        self._odometry.append((stamp_ns, T_odom_body))
        return True

    def add_image(self, stamp_ns: int, payload: bytes) -> bool:
        """Take in a serialised image; returns whether it is newer than the one before."""
        if self._image_last_ns is not None and stamp_ns <= self._image_last_ns:
            self.dropped["image back in time"] += 1
            return False
        self._image_last_ns = stamp_ns
        self._images.append((stamp_ns, payload))
        self._waiting_bytes += len(payload)
        while len(self._images) > self._images_max or (self._waiting_bytes > self._bytes_max and len(self._images) > 1):
            self.dropped["image without odometry" if self._starved() else "image not taken in time"] += 1
            self._take_oldest()
        return True

    def next(self) -> PosedImage | None:
        """The next image with its pose; None while odometry has not passed it, or there is none."""
        while self._images:
            stamp_ns, payload = self._images[0]
            if not self._odometry or self._odometry[-1][0] < stamp_ns:
                return None
            self._take_oldest()
            T_odom_body = self._at(stamp_ns)
            if T_odom_body is not None:
                return PosedImage(stamp_ns, payload, T_odom_body)
            self.dropped["image without odometry"] += 1
        return None

    def _take_oldest(self) -> None:
        _, payload = self._images.popleft()
        self._waiting_bytes -= len(payload)

    def _starved(self) -> bool:
        """Whether images wait for odometry rather than for whoever takes them."""
        return not self._odometry or self._odometry[-1][0] < self._images[0][0]

    def _at(self, stamp_ns: int) -> Float | None:
        """Odometry at a time that the newest has reached; None before the oldest and inside of a long pause."""
        while len(self._odometry) > 1 and self._odometry[1][0] <= stamp_ns:
            self._odometry.popleft()
        before_ns, before = self._odometry[0]
        if before_ns == stamp_ns:
            return before
        if before_ns > stamp_ns:
            return None
        after_ns, after = self._odometry[1]
        pair = Trajectory(np.array([0.0, (after_ns - before_ns) * 1e-9]), np.stack([before, after]))
        return pair.at((stamp_ns - before_ns) * 1e-9, self._gap_max_s)
