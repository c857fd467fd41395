"""Images with the odometry of their time: interpolated, bounded, counted."""

import numpy as np
import pytest

from flocc_agent.geometry import Float, pose, so3_exp
from flocc_agent.runtime.ros2.synchroniser import ODOMETRY_MAX, Synchroniser

MS = 1_000_000
EPOCH_NS = 1_700_000_000 * 10**9


def at(t_ms: float) -> Float:
    """A robot that moves by 1 mm and turns by 1 mrad per millisecond."""
    return pose(so3_exp(np.array([0.0, 0.0, 1e-3 * t_ms])), np.array([1e-3 * t_ms, 0.0, 0.0]))


def fed(odometry_ms: list[int], images_ms: list[int], images_max: int = 8) -> Synchroniser:
    synchroniser = Synchroniser(images_max, gap_max_s=0.5)
    for t in odometry_ms:
        synchroniser.add_odometry(EPOCH_NS + t * MS, at(t))
    for t in images_ms:
        synchroniser.add_image(EPOCH_NS + t * MS, str(t).encode())
    return synchroniser


def taken_ms(synchroniser: Synchroniser) -> list[int]:
    """Times of all images that are ready; each must be where odometry was then."""
    times = []
    while (posed := synchroniser.next()) is not None:
        t = (posed.stamp_ns - EPOCH_NS) // MS
        assert posed.payload == str(t).encode()
        np.testing.assert_allclose(posed.T_odom_body, at(t), atol=1e-9)
        times.append(t)
    return times


def test_an_image_is_where_odometry_was_at_its_time() -> None:
    assert taken_ms(fed([0, 20, 40, 60], [0, 7, 20, 31, 60])) == [0, 7, 20, 31, 60]


def test_an_image_waits_until_odometry_has_passed_it() -> None:
    synchroniser = fed([0, 20], [25, 35])
    assert taken_ms(synchroniser) == []
    synchroniser.add_odometry(EPOCH_NS + 30 * MS, at(30))
    assert taken_ms(synchroniser) == [25]
    synchroniser.add_odometry(EPOCH_NS + 50 * MS, at(50))
    assert taken_ms(synchroniser) == [35]
    assert synchroniser.dropped == {}


def test_images_before_the_first_odometry_and_in_a_long_pause_are_left_out_and_counted() -> None:
    synchroniser = fed([100, 200, 1000, 1100], [20, 150, 500, 1050])
    assert taken_ms(synchroniser) == [150, 1050]
    assert synchroniser.dropped == {"image without odometry": 2}


def test_without_odometry_the_oldest_images_give_way() -> None:
    synchroniser = fed([], list(range(0, 100, 10)), images_max=4)
    assert synchroniser.dropped == {"image without odometry": 6}
    synchroniser.add_odometry(EPOCH_NS, at(0))
    synchroniser.add_odometry(EPOCH_NS + 200 * MS, at(200))
    assert taken_ms(synchroniser) == [60, 70, 80, 90]


def test_images_that_nobody_takes_give_way_under_another_name() -> None:
    assert fed([0, 1000], list(range(0, 100, 10)), images_max=4).dropped == {"image not taken in time": 6}


@pytest.mark.parametrize("again_ms", [20, 10, -500])
def test_time_that_stands_or_goes_back_is_left_out_and_counted(again_ms: int) -> None:
    synchroniser = fed([0, 20], [5, 15])
    assert not synchroniser.add_odometry(EPOCH_NS + again_ms * MS, at(999))
    assert not synchroniser.add_image(EPOCH_NS + (again_ms - 5) * MS, b"wrong")
    assert taken_ms(synchroniser) == [5, 15]
    assert synchroniser.dropped == {"odometry back in time": 1, "image back in time": 1}
    assert synchroniser.latest is not None
    assert synchroniser.latest[0] == EPOCH_NS + 20 * MS


def test_odometry_without_images_stays_bounded() -> None:
    synchroniser = Synchroniser(8, 0.5)
    for t in range(ODOMETRY_MAX + 100):
        synchroniser.add_odometry(t * MS, np.eye(4))
    synchroniser.add_image(50 * MS, b"old")
    assert synchroniser.next() is None
    assert synchroniser.dropped == {"image without odometry": 1}


def test_large_images_wait_only_within_their_bytes_and_one_always_may() -> None:
    synchroniser = Synchroniser(64, 0.5, bytes_max=100)
    for t in (1, 2, 3):
        synchroniser.add_image(t, bytes(60))
    assert synchroniser.dropped == {"image without odometry": 2}
    synchroniser.add_odometry(0, np.eye(4))
    synchroniser.add_odometry(5, np.eye(4))
    posed = synchroniser.next()
    assert posed is not None
    assert (posed.stamp_ns, synchroniser.next()) == (3, None)
    synchroniser.add_image(6, bytes(500))
    synchroniser.add_odometry(7, np.eye(4))
    assert synchroniser.next() is not None


def test_bytes_of_images_that_were_taken_make_room() -> None:
    synchroniser = Synchroniser(64, 0.5, bytes_max=100)
    synchroniser.add_odometry(0, np.eye(4))
    for t in range(10, 100, 20):
        synchroniser.add_image(t, bytes(50))
        synchroniser.add_image(t + 1, bytes(50))
        synchroniser.add_odometry(t + 2, np.eye(4))
        assert synchroniser.next() is not None
        assert synchroniser.next() is not None
    assert synchroniser.dropped == {}
