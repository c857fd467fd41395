"""Messages, field by field: what goes is read by hand and by rosbags, what comes is written by hand."""

from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from tests.agent.runtime.ros2 import cdr_by_hand
from tests.agent.runtime.ros2.cdr_by_hand import Stamped

from flocc_agent.geometry import Float, R_from_q_wxyz, pose, q_wxyz_from_R, se3_exp, so3_exp, so3_log
from flocc_agent.runtime.ros2.incoming import odometry_of
from flocc_agent.runtime.ros2.outgoing import Outgoing, ros_covariance
from flocc_agent.runtime.ros2.static_frames import DEPTH_MAX, StaticFrames
from flocc_agent.runtime.ros2.types import ODOMETRY, TF, BadMessage, MessageTypes, header_of

TYPES = MessageTypes()
OUTGOING = Outgoing(TYPES, "map", "r1/odom")
STORE = get_typestore(Stores.ROS2_KILTED)
STAMP_NS = 1_700_000_000_000_000_007
STAMP = (1_700_000_000, 7)
T_MAP_ODOM = pose(so3_exp(np.array([0.1, -0.2, 1.3])), np.array([4.0, -5.0, 0.5]))
T_ODOM_BODY = pose(so3_exp(np.array([-0.3, 0.2, -0.4])), np.array([1.0, 2.0, -3.0]))


def numbers_of(T: Float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Position, and quaternion as x y z w."""
    w, x, y, z = q_wxyz_from_R(T[:3, :3]).tolist()
    return tuple(T[:3, 3].tolist()), (x, y, z, w)


def covariance() -> Float:
    root = np.random.default_rng(3).normal(size=(6, 6)) * np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])[:, None]
    return np.asarray(root @ root.T)


def read_by_rosbags(payload: bytes, name: str) -> Any:
    return STORE.deserialize_cdr(payload, name)


def test_the_transform_places_odom_in_the_map() -> None:
    payload = TYPES.written(OUTGOING.transforms(T_MAP_ODOM, None, STAMP_NS))
    position, quaternion = numbers_of(T_MAP_ODOM)
    assert cdr_by_hand.read_transforms(payload) == [Stamped(STAMP, "map", "r1/odom", position, quaternion)]
    (moved,) = read_by_rosbags(payload, TF).transforms
    assert (moved.header.stamp.sec, moved.header.stamp.nanosec) == STAMP
    assert (moved.header.frame_id, moved.child_frame_id) == ("map", "r1/odom")
    t, q = moved.transform.translation, moved.transform.rotation
    assert (t.x, t.y, t.z, q.x, q.y, q.z, q.w) == (*position, *quaternion)


def test_a_path_has_every_pose_with_its_own_time() -> None:
    T_map_body = np.stack([T_MAP_ODOM, T_MAP_ODOM @ T_ODOM_BODY])
    payload = TYPES.written(OUTGOING.path(T_map_body, [STAMP_NS, STAMP_NS + 10**9], STAMP_NS + 2 * 10**9))
    first, second = (numbers_of(T) for T in T_map_body)
    later = (STAMP[0] + 1, STAMP[1])
    assert cdr_by_hand.read_path(payload) == (
        (STAMP[0] + 2, STAMP[1]),
        "map",
        [Stamped(STAMP, "map", "", *first), Stamped(later, "map", "", *second)],
    )
    path = read_by_rosbags(payload, "nav_msgs/msg/Path")
    assert [posed.header.stamp.sec for posed in path.poses] == [STAMP[0], STAMP[0] + 1]
    assert path.poses[1].pose.position.y == second[0][1]


def test_the_pose_of_the_body_in_the_map_comes_with_its_covariance() -> None:
    payload = TYPES.written(OUTGOING.pose(T_MAP_ODOM, covariance(), T_ODOM_BODY, STAMP_NS))
    expected = ros_covariance(T_MAP_ODOM, covariance(), T_ODOM_BODY[:3, 3]).ravel()
    posed = cdr_by_hand.read_pose(payload)
    position, quaternion = numbers_of(T_MAP_ODOM @ T_ODOM_BODY)
    assert posed == Stamped(STAMP, "map", "", position, quaternion, tuple(expected.tolist()))
    message = read_by_rosbags(payload, "geometry_msgs/msg/PoseWithCovarianceStamped")
    np.testing.assert_array_equal(message.pose.covariance, expected)


def test_an_unknown_covariance_is_all_zeros() -> None:
    payload = TYPES.written(OUTGOING.pose(T_MAP_ODOM, None, T_ODOM_BODY, STAMP_NS))
    assert cdr_by_hand.read_pose(payload).covariance == (0.0,) * 36


def test_text() -> None:
    assert cdr_by_hand.read_text(TYPES.written(OUTGOING.text("map/r1"))) == "map/r1"


def test_the_covariance_is_that_of_numerically_moved_poses() -> None:
    """Columns of the Jacobian by central differences: translation in the map, rotation about the map's fixed axes."""
    T_map_body, step = T_MAP_ODOM @ T_ODOM_BODY, 1e-6
    J = np.zeros((6, 6))
    for k in range(6):
        ends = []
        for sign in (1.0, -1.0):
            moved = T_MAP_ODOM @ se3_exp(sign * step * np.eye(6)[k]) @ T_ODOM_BODY
            turned = so3_log(moved[:3, :3] @ T_map_body[:3, :3].T)
            ends.append(np.concatenate([moved[:3, 3], turned]))
        J[:, k] = (ends[0] - ends[1]) / (2 * step)
    got = ros_covariance(T_MAP_ODOM, covariance(), T_ODOM_BODY[:3, 3])
    np.testing.assert_allclose(got, J @ covariance() @ J.T, rtol=1e-6, atol=1e-12)


def test_the_covariance_is_in_the_order_of_ros() -> None:
    """One metre of uncertainty along odom's x axis, where odom looks along the map's y axis: variance of y alone."""
    quarter = pose(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3))
    along_x = np.diag([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    np.testing.assert_allclose(np.diag(ros_covariance(quarter, along_x, np.zeros(3))), [0, 1, 0, 0, 0, 0], atol=1e-15)
    yaw, lever_m = np.diag([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), np.array([2.0, 0.0, 0.0])
    np.testing.assert_allclose(np.diag(ros_covariance(quarter, yaw, lever_m)), [4, 0, 0, 0, 0, 1], atol=1e-14)


def odometry(**changes: Any) -> bytes:
    position, quaternion = numbers_of(T_ODOM_BODY)
    sample = {"stamp": STAMP, "frame": "odom", "child": "base_link", "position": position, "quaternion": quaternion}
    return cdr_by_hand.odometry(Stamped(**(sample | changes)))


def test_odometry_is_read() -> None:
    stamp_ns, T = odometry_of(TYPES.read(odometry(), ODOMETRY), "odom", "base_link")
    assert stamp_ns == STAMP_NS
    np.testing.assert_allclose(T, T_ODOM_BODY, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"frame": "world"}, "odometry is of 'base_link' in 'world', but the configuration says 'base_link' in 'odom'"),
        ({"child": "imu"}, "odometry is of 'imu' in 'odom'"),
        ({"quaternion": (0.0, 0.0, 0.0, 0.0)}, "quaternion of length 0 is no pose"),
        ({"quaternion": (0.0, 0.0, 0.0, float("nan"))}, "is no pose"),
        ({"position": (1e400, 0.0, 0.0)}, "is no pose"),
        ({"position": (0.0, 0.0, -1e7)}, "is no pose"),
        ({"position": (0.0, float("nan"), 0.0)}, "is no pose"),
        ({"stamp": (-1, 0)}, "the stamp -1 s and 0 ns is no time"),
        ({"stamp": (2**31 - 1, 0)}, "is no time"),
        ({"stamp": (1, 10**9)}, "is no time"),
    ],
)
def test_odometry_that_cannot_be_used_says_why(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(BadMessage, match=said):
        odometry_of(TYPES.read(odometry(**changes), ODOMETRY), "odom", "base_link")


def test_a_message_cut_short_anywhere_is_refused() -> None:
    whole = odometry()
    for length in range(len(whole)):
        with pytest.raises(BadMessage):
            TYPES.read(whole[:length], ODOMETRY)


def test_bytes_of_anything_are_refused_or_read_but_never_crash() -> None:
    rng = np.random.default_rng(5)
    whole = cdr_by_hand.transforms([Stamped(STAMP, "base_link", "camera", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))] * 3)
    frames = StaticFrames()
    for _ in range(500):
        broken = bytearray(whole)
        broken[rng.integers(0, len(broken))] = rng.integers(0, 256)
        with suppress(BadMessage):
            frames.add(TYPES.read(bytes(broken), TF))
    assert frames.between("base_link", "camera") is not None


def test_the_header_is_read_without_the_rest() -> None:
    payload = cdr_by_hand.image(STAMP, "camera_optical", (2, 2), "mono8", bytes(4), 2)
    assert header_of(payload) == (STAMP_NS, "camera_optical")
    for length in (0, 3, 15, 20):
        with pytest.raises(BadMessage):
            header_of(payload[:length])


def static(parent: str, child: str, T: Float) -> Stamped:
    return Stamped((0, 0), parent, child, *numbers_of(T))


def test_static_frames_connect_the_camera_with_the_body() -> None:
    T_base_mast = pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    T_mast_optical = pose(R_from_q_wxyz(np.array([0.5, -0.5, 0.5, -0.5])), np.array([0.1, 0.0, 0.0]))
    T_foot_base = pose(np.eye(3), np.array([0.0, 0.0, 0.3]))
    frames = StaticFrames()
    frames.add(TYPES.read(cdr_by_hand.transforms([static("mast", "optical", T_mast_optical)]), TF))
    assert frames.between("base_link", "optical") is None
    frames.add(TYPES.read(cdr_by_hand.transforms([static("/base_link", "/mast", T_base_mast)]), TF))
    frames.add(TYPES.read(cdr_by_hand.transforms([static("foot", "base_link", T_foot_base)]), TF))
    T = frames.between("base_link", "optical")
    assert T is not None
    np.testing.assert_allclose(T, T_base_mast @ T_mast_optical, atol=1e-12)
    T_down = frames.between("optical", "foot")
    assert T_down is not None
    np.testing.assert_allclose(T_down @ T_foot_base @ T, np.eye(4), atol=1e-12)


def test_static_frames_in_a_circle_end() -> None:
    frames = StaticFrames()
    circle = [static(f"f{k}", f"f{(k + 1) % (2 * DEPTH_MAX)}", np.eye(4)) for k in range(2 * DEPTH_MAX)]
    frames.add(TYPES.read(cdr_by_hand.transforms(circle), TF))
    assert frames.between("f0", "elsewhere") is None
