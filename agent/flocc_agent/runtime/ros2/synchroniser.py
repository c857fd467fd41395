"""Images with the odometry of their time: each image waits until odometry has passed it, and is then interpolated.

Both queues are bounded. What is lost, and why, is counted; nothing is ever invented for it.
"""

from collections import Counter, deque
from dataclasses import dataclass
from typing import Generic, TypeVar

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


Item = TypeVar("Item")


class HeldImages(Generic[Item]):
    """A queue of images that is bounded in number and bytes; one may always wait."""

    def __init__(self, images_max: int, bytes_max: int) -> None:
        self._images_max = images_max
        self._bytes_max = bytes_max
        self._bytes = 0
        self._items: deque[tuple[Item, int]] = deque()

    def __len__(self) -> int:
        return len(self._items)

    @property
    def oldest(self) -> Item:
        """What has waited for longest."""
        return self._items[0][0]

    def add(self, item: Item, size: int) -> None:
        """Let an image of `size` bytes wait; `is_full` then says whether an older one must give way."""
        self._items.append((item, size))
        self._bytes += size

    def is_full(self) -> bool:
        """Whether more wait than may."""
        return len(self) > self._images_max or (self._bytes > self._bytes_max and len(self) > 1)

    def take(self) -> Item:
        """The oldest, which waits no longer."""
        item, size = self._items.popleft()
        self._bytes -= size
        return item


class Synchroniser:
    """Puts a stream of images and a stream of odometry together."""

    def __init__(self, images_max: int, gap_max_s: float, bytes_max: int = 2**62) -> None:
        """Prepare.

        Args:
            images_max: Images that wait; the oldest gives way.
            gap_max_s: Longer pauses of odometry are not bridged.
            bytes_max: Of the images that wait; one may always.
        """
        self.dropped = Counter[str]()
        self._gap_max_s = gap_max_s
        self._images = HeldImages[tuple[int, bytes]](images_max, bytes_max)
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
        self._images.add((stamp_ns, payload), len(payload))
        while self._images.is_full():
            self.dropped["image without odometry" if self._starved() else "image not taken in time"] += 1
            self._images.take()
        return True

    def next(self) -> PosedImage | None:
        """The next image with its pose; None while odometry has not passed it, or there is none."""
        while self._images:
            if self._starved():
                return None
            stamp_ns, payload = self._images.take()
            T_odom_body = self._at(stamp_ns)
            if T_odom_body is not None:
                return PosedImage(stamp_ns, payload, T_odom_body)
            self.dropped["image without odometry"] += 1
        return None

    def _starved(self) -> bool:
        """Whether images wait for odometry rather than for whoever takes them."""
        return not self._odometry or self._odometry[-1][0] < self._images.oldest[0]

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
