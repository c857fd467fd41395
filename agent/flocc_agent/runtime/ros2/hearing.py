"""What a robot's messages say, kind by kind: intrinsics, mounting, odometry, images, fixes. Called on one thread.

What cannot be used is said once, counted and left out.
"""

import math
from collections import Counter
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import Ros2Config
from flocc_agent.runtime.keyframes import KeyframeSelector
from flocc_agent.runtime.pose_limits import SPEED_MAX_M_S, step_fault
from flocc_agent.runtime.ros2.incoming import Eye, model_of, odometry_of
from flocc_agent.runtime.ros2.odometry_covariance import StepCovariances
from flocc_agent.runtime.ros2.problems import Problems
from flocc_agent.runtime.ros2.satellite import SatelliteFixes, fix_of
from flocc_agent.runtime.ros2.static_frames import StaticFrames, pose_of_numbers, stands_as_a_link
from flocc_agent.runtime.ros2.synchroniser import HeldImages, PosedImage, Synchroniser
from flocc_agent.runtime.ros2.topics import Offer, Qos, Topic
from flocc_agent.runtime.ros2.types import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    NAV_SAT_FIX,
    ODOMETRY,
    TF,
    BadMessage,
    MessageTypes,
    header_of,
)
from flocc_agent.runtime.unmeasured_steps import StepWatch

Float = NDArray[np.float64]

KINDS = ("tf_static", "camera_info", "odometry", "fix", "image")
"""What is taken in first where much has come at once: images last, since they need all the others."""
IMAGES_MAX = 64
IMAGES_BYTES_MAX = 64 * 1024 * 1024
"""Images that wait for odometry, and as many for their camera or the encoder; the oldest gives way."""
ODOMETRY_GAP_MAX_S = 0.5
"""Images in a longer pause of the odometry are left out: what is between is guessed, not measured."""
BACK_IN_TIME = (
    "time goes backwards; such messages are left out. After a reset of odometry or clock, call ~/reset_odometry"
)
WITHOUT_STAMP = "the stamps are 0, so nothing can be dated by them; the driver must fill in header.stamp"
CLOCKS_APART_MAX_S = 10.0

SENSOR = Qos(5, best_effort=True)
TF_STATIC = Qos(100, transient_local=True)


class Hearing:
    """Takes messages of each kind."""

    def __init__(
        self,
        config: Ros2Config,
        types: MessageTypes,
        problems: Problems,
        fixes: SatelliteFixes,
        mount_camera: Callable[[Float], None],
    ) -> None:
        """Prepare; a mounting that is configured is told at once.

        Args:
            config: Topics and frames.
            types: Reads messages.
            problems: Takes what is wrong.
            fixes: Takes fixes.
            mount_camera: Told `T_body_camera` once it is known.
        """
        self._config = config
        self._types = types
        self._problems = problems
        self._fixes = fixes
        self._mount_camera = mount_camera
        self._static = StaticFrames()
        self.synchroniser = Synchroniser(IMAGES_MAX, ODOMETRY_GAP_MAX_S, IMAGES_BYTES_MAX)
        self._wanted = HeldImages[PosedImage](IMAGES_MAX, IMAGES_BYTES_MAX)
        self._compared_ns: int | None = None
        self._were_apart = False
        self.covariances = StepCovariances()
        self.steps = StepWatch(pauses_count=True)
        self.heard = Counter[str]()
        self.subscribed: dict[str, Topic] = {}
        self.eye: Eye | None = None
        self.T_body_camera: Float | None = None
        self._camera_frame = config.camera_frame
        self._is_link = False
        self._eye_frame = ""
        if config.camera_mounting is not None:
            self.mount(pose_of_numbers(config.camera_mounting, "camera_mounting"))

    def wanted(self) -> dict[str, tuple[str, str, Qos]]:
        """Topic, type and quality of service of each subscription."""
        config = self._config
        wanted: dict[str, tuple[str, str, Qos]] = {}
        if config.odometry_topic:
            wanted["odometry"] = (config.odometry_topic, ODOMETRY, Qos(200))
        if config.image_topic:
            wanted["image"] = (config.image_topic, self.image_type(), SENSOR)
            wanted["camera_info"] = (config.camera_info_topic, CAMERA_INFO, SENSOR)
            if config.camera_mounting is None:
                wanted["tf_static"] = (f"{config.tf_topic}_static", TF, TF_STATIC)
        if config.fix_topic:
            wanted["fix"] = (config.fix_topic, NAV_SAT_FIX, SENSOR)
        return wanted

    def image_type(self) -> str:
        """Type of the images' messages."""
        return COMPRESSED_IMAGE if self._config.is_compressed() else IMAGE

    def take(self, kind: str, payload: bytes) -> bool:
        """Take in a message; returns whether images may go on by it."""
        self.heard[kind] += 1
        try:
            match kind:
                case "odometry":
                    return self._take_odometry(payload)
                case "image":
                    return self._take_image(payload)
                case "camera_info":
                    self._take_camera_info(payload)
                    return True
                case "fix":
                    self._take_fix(payload)
                case "tf_static":
                    self._static.add(self._types.read(payload, TF))
                    return True
        except BadMessage as error:
            self.refuse(kind, str(error))
        return False

    def _take_camera_info(self, payload: bytes) -> None:
        message = self._types.read(payload, CAMERA_INFO)
        model, frame = model_of(message, self._config.rectified), message.header.frame_id
        if self.eye is None or self.eye.model != model:
            if self.eye is not None and frame != self._eye_frame:
                raise BadMessage(f"intrinsics are of frame {frame!r}, but those before were of {self._eye_frame!r}")
            self._eye_frame = frame
            view_deg = self._config.field_of_view_deg
            self.eye = Eye(model, None if view_deg is None else math.radians(view_deg))

    def _take_odometry(self, payload: bytes) -> bool:
        config = self._config
        message = self._types.read(payload, ODOMETRY)
        sample = odometry_of(message, config.odom_frame, config.base_frame)
        self._check_step(*sample)
        if not self.synchroniser.add_odometry(*sample):
            self.complain("odometry", BACK_IN_TIME if sample[0] else WITHOUT_STAMP)
            return False
        self.steps.saw(sample[0] * 1e-9, sample[1])
        self.covariances.add(sample[0], np.reshape(message.pose.covariance, (6, 6)))
        return True

    def _check_step(self, stamp_ns: int, T_odom_body: Float) -> None:
        """Refuse odometry that lies out of reach of the newest.

        Raises:
            BadMessage: It moved faster than any robot.
        """
        if self.synchroniser.latest is None or stamp_ns <= self.synchroniser.latest[0]:
            return
        last_ns, T_odom_last = self.synchroniser.latest
        if step_fault(T_odom_body[:3, 3] - T_odom_last[:3, 3], (stamp_ns - last_ns) * 1e-9) is not None:
            raise BadMessage(f"odometry jumps out of reach (faster than {SPEED_MAX_M_S:g} m/s)")

    def _take_image(self, payload: bytes) -> bool:
        stamp_ns, frame = header_of(payload)
        if self._is_of_another_camera(frame):
            told = "the configuration says" if self._config.camera_frame else "the mounting that was read is of"
            raise BadMessage(f"images are in frame {frame!r}, but {told} {self._camera_frame!r}")
        if not self.synchroniser.add_image(stamp_ns, payload):
            self.complain("image", BACK_IN_TIME if stamp_ns else WITHOUT_STAMP)
            return False
        return True

    def _take_fix(self, payload: bytes) -> None:
        if not self._fixes.add_fix(fix_of(self._types.read(payload, NAV_SAT_FIX))):
            self.complain("fix", BACK_IN_TIME)

    def next_wanted(self, selector: KeyframeSelector) -> PosedImage | None:
        """The next image that is to become a keyframe and whose camera is known; None where there is none yet.

        Those that come before the camera is known wait for it, as those do that come faster than they are taken.
        """
        while (posed := self.synchroniser.next()) is not None:
            if not selector.wants(posed.T_odom_body):
                continue
            selector.took(posed.T_odom_body)
            self._wanted.add(posed, len(posed.payload))
            while self._wanted.is_full():
                lacking = self._lacking(self._wanted.take())
                self.synchroniser.dropped[f"image without {lacking}" if lacking else "image not taken in time"] += 1
        while self._wanted and self._is_of_another_camera(header_of(self._wanted.oldest.payload)[1]):
            self._wanted.take()
            self.synchroniser.dropped["image of another camera"] += 1
        return self._wanted.take() if self._wanted and self._lacking(self._wanted.oldest) is None else None

    def _is_of_another_camera(self, frame: str) -> bool:
        """Whether an image's frame is not the one that is configured, or whose mounting was read."""
        return bool(self._camera_frame) and frame.lstrip("/") != self._camera_frame

    def _lacking(self, posed: PosedImage) -> str | None:
        """What is not known yet of an image's camera."""
        if self.eye is None:
            return "intrinsics"
        _, camera_frame = header_of(posed.payload)
        return "mounting" if self.mounting(camera_frame.lstrip("/")) is None else None

    def mounting(self, camera_frame: str) -> Float | None:
        """`T_body_camera`, found once; None while /tf_static does not connect the two."""
        if self.T_body_camera is None:
            T_body_camera = self._static.between(self._config.base_frame, camera_frame)
            self._is_link = T_body_camera is not None and stands_as_a_link(camera_frame, T_body_camera)
            if T_body_camera is not None and not self._is_link:
                self._camera_frame = camera_frame
                self.mount(T_body_camera)
        return self.T_body_camera

    def mount(self, T_body_camera: Float) -> None:
        """Know where the camera sits."""
        self.T_body_camera = T_body_camera
        self._mount_camera(T_body_camera)

    def compare(self, offer: Offer) -> None:
        """Say when a node publishes one of our topics as something else: its messages would never come."""
        for kind, topic in self.subscribed.items():
            if offer.topic != topic.name:
                continue
            if (offer.type, offer.hash) != (topic.type, topic.hash):
                told = offer.type if offer.type != topic.type else f"{offer.type} of another definition ({offer.hash})"
                self.complain(kind, f"{offer.node} publishes it as {told}, but {topic.type} is needed")
            elif offer.misfit:
                self.complain(kind, f"{offer.node} {offer.misfit}: --ros-args -p qos_overrides (docs/ros2.md)")

    def say_what_is_missing(self) -> None:
        """Say what has not come, and what does not connect."""
        for kind, topic in self.subscribed.items():
            if not self.heard[kind]:
                self.complain(kind, f"no {topic.type} has come yet")
        if self._wanted and self.eye is not None and self.T_body_camera is None:
            told = f"does not connect {self._config.base_frame!r} with the camera's frame"
            if self._is_link:
                told = "images are of a link's frame (z up), not an optical one (z forward): give camera_mounting"
            self.complain("tf_static", told)

    def compare_clocks(self, now_ns: int) -> None:
        """Say when odometry that still comes is stamped by another clock than the node's: tf2 finds nothing then.

        Args:
            now_ns: The node's time; 0 while simulated time has not begun.
        """
        if now_ns == 0:
            self.complain("clock", "use_sim_time is set, but no /clock has come")
        elif self.synchroniser.latest is not None and self.synchroniser.latest[0] != self._compared_ns:
            self._compared_ns = self.synchroniser.latest[0]
            behind_s = (now_ns - self.synchroniser.latest[0]) * 1e-9
            was_apart, self._were_apart = self._were_apart, abs(behind_s) > CLOCKS_APART_MAX_S
            if was_apart and self._were_apart:  # twice: a clock that begins anew is apart for a moment
                aside = "behind" if behind_s > 0 else "ahead of"
                self.complain(
                    "odometry",
                    f"its stamps are more than {CLOCKS_APART_MAX_S:g} s {aside} this node's clock; where the robot has "
                    "simulated time, start every node with it (-p use_sim_time:=true)",
                )

    def refuse(self, kind: str, sentence: str) -> None:
        """Count a message that cannot be used, and say why once."""
        self._problems.refuse(kind, self._name(kind), sentence)

    def complain(self, kind: str, sentence: str) -> None:
        """Say something of a topic once."""
        self._problems.say(self._name(kind), sentence)

    def _name(self, kind: str) -> str:
        return self.subscribed[kind].name if kind in self.subscribed else "ROS 2"
