"""A ROS 2 robot's drivers on raw zenoh, without flocc, rosbags or ROS; what it hears, as JSON lines on stdout.

Usage: python -m tests.swarm.ros2_robot PORT. Runs until its standard input ends. It drives along x at 1 m/s, sees a
textured wall, and also is the router.
"""

import json
import sys
import threading
import time

import numpy as np
from tests.agent.runtime.ros2 import cdr_by_hand
from tests.agent.runtime.ros2.cdr_by_hand import Stamped
from tests.agent.runtime.ros2.raw_node import RawNode, gid, open_router

SIZE = HEIGHT, WIDTH = (240, 320)
K = (250.0, 0.0, 160.0, 0.0, 250.0, 120.0, 0.0, 0.0, 1.0)
P = (250.0, 0.0, 160.0, 0.0, 0.0, 250.0, 120.0, 0.0, 0.0, 0.0, 1.0, 0.0)
MOUNTING = Stamped((0, 0), "base_link", "optical", (0.1, 0.0, 0.5), (-0.5, 0.5, -0.5, 0.5))
SPEED_M_S = 1.0
PIXELS_PER_M = 80
PERIOD_S = 0.02
IMAGE_EVERY = 5
TELL_EVERY = 10

TF, PATH, TEXT = "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Path", "std_msgs/msg/String"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"


def wall() -> "np.ndarray[tuple[int, int], np.dtype[np.uint8]]":
    """A long texture of blocks."""
    blocks = np.random.default_rng(4).integers(0, 256, (HEIGHT // 8, 500)).astype(np.uint8)
    return np.kron(blocks, np.ones((8, 8), np.uint8))


def advertise(node: RawNode) -> None:
    """What the robot publishes, and hears."""
    node.advertise("/odom", "nav_msgs/msg/Odometry")
    node.advertise("/camera/image_raw", "sensor_msgs/msg/Image")
    node.advertise("/camera/camera_info", "sensor_msgs/msg/CameraInfo")
    node.advertise("/tf_static", TF, latched=True)
    node.subscribe("/tf", TF)
    node.subscribe("/flocc/path", PATH, latched=True)
    node.subscribe("/flocc/pose", POSE)
    node.subscribe("/flocc/map_frame", TEXT, latched=True)


def drive(node: RawNode, texture: "np.ndarray[tuple[int, int], np.dtype[np.uint8]]", step: int) -> None:
    """One step of odometry, and now and then an image."""
    now_ns = time.time_ns()
    stamp = divmod(now_ns, 10**9)
    x_m = SPEED_M_S * PERIOD_S * step
    node.publish(
        "/odom", cdr_by_hand.odometry(Stamped(stamp, "odom", "base_link", (x_m, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    )
    if step % IMAGE_EVERY == 0:
        left = round(PIXELS_PER_M * x_m) % (texture.shape[1] - WIDTH)
        picture = np.dstack([texture[:, left : left + WIDTH]] * 3)
        payload = cdr_by_hand.image(stamp, "optical", SIZE, "bgr8", picture.tobytes(), 3 * WIDTH)
        node.publish("/camera/image_raw", payload)
        node.publish("/camera/camera_info", cdr_by_hand.camera_info(stamp, "optical", SIZE, K, [0.0] * 5, P))


def heard(node: RawNode, step: int) -> dict[str, object]:
    """What came so far, decoded."""
    transforms = [cdr_by_hand.read_transforms(each.payload)[0] for each in node.received["/tf"]]
    paths = [cdr_by_hand.read_path(each.payload) for each in node.received["/flocc/path"]]
    poses = [cdr_by_hand.read_pose(each.payload) for each in node.received["/flocc/pose"]]
    attached = [cdr_by_hand.read_attachment(each.attachment or b"") for each in node.received["/tf"]]
    tokens = {gid(token) for token in node.tokens if "/MP/" in token and "/flocc_" in token}
    return {
        "x_m": SPEED_M_S * PERIOD_S * step,
        "nodes": sorted(token.split("/")[8] for token in node.tokens if "/NN/" in token),
        "transforms": len(transforms),
        "frames": sorted({(each.frame, each.child) for each in transforms}),
        "T_map_odom": (*transforms[-1].position, *transforms[-1].quaternion) if transforms else None,
        "numbers_in_order": [number for number, *_ in attached] == list(range(1, len(attached) + 1)),
        "gids_are_of_tokens": all(identifier in tokens for *_, identifier in attached),
        "path": [each.position for each in paths[-1][2]] if paths else [],
        "position": poses[-1].position if poses else None,
        "map_frames": [cdr_by_hand.read_text(each.payload) for each in node.received["/flocc/map_frame"]],
    }


def wait_for_the_end(ended: threading.Event) -> None:
    """Read standard input to its end."""
    sys.stdin.read()
    ended.set()


def main(port: int) -> None:
    """Drive until nobody wants it any more."""
    ended = threading.Event()
    threading.Thread(target=wait_for_the_end, args=(ended,), daemon=True).start()
    texture = wall()
    router = open_router(port)
    with RawNode(port) as node:
        advertise(node)
        node.publish("/tf_static", cdr_by_hand.transforms([MOUNTING]))
        step = 0
        while not ended.wait(PERIOD_S):
            drive(node, texture, step)
            step += 1
            if step % TELL_EVERY == 0:
                print(json.dumps(heard(node, step)), flush=True)
    router.close()


if __name__ == "__main__":
    main(int(sys.argv[1]))
