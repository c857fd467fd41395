"""A camera that does not fit is found from its own keyframes, and one that fits is left in peace."""

from collections.abc import Callable
from itertools import accumulate, pairwise
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from tests.agent.perception.classical_scenes import camera_at, seen_from, wall

from flocc_agent.config import ClassicalConfig, PerceptionConfig
from flocc_agent.core.interfaces import Camera, Image, OdometryPair, Perception
from flocc_agent.core.registration import RegistrationFailed, RegistrationFailure
from flocc_agent.core.reports import WITHHELD, CameraDoubted
from flocc_agent.geometry import angle_rad, inverse, pose, so3_exp
from flocc_agent.perception.backends import build_perception
from flocc_agent.perception.classical.encoder import encode_features
from flocc_agent.perception.classical.features import FeatureExtractor, Features
from flocc_agent.perception.classical.patches import dense_patches
from flocc_agent.perception.classical.sift_registrar import classical_registrar
from flocc_agent.perception.multiview.registrar import without_overlay
from flocc_agent.perception.watch.camera_verdict import CameraFault, CameraVerdict, WatchedPair, camera_verdict
from flocc_agent.perception.watch.camera_watch import CameraWatch
from flocc_agent.perception.watch.overlay import OverlayFinder, place_of
from flocc_agent.perception.watch.seen_motion import Flow, flow_of, moves_with_the_scene
from flocc_lab.bench.drawn_overlays import overlay
from flocc_protocol.arrays import Array

Float = NDArray[np.float64]

FOCAL_PX = 400.0
CAMERA = Camera(320, 240, 280.0, 280.0, 159.5, 119.5)
TURNED_RAD = float(np.radians(5.0))


def drive(rng: np.random.Generator, count: int, turn_rad: float = 0.1) -> list[Float]:
    """True camera poses of a robot that drives forward and turns left and right."""
    T = np.eye(4)
    poses = [T]
    for k in range(count):
        turn = turn_rad * np.sin(0.9 * k) + rng.normal(0.0, 0.2 * turn_rad)
        step = pose(so3_exp(np.array([rng.normal(0, 0.004), turn, rng.normal(0, 0.004)])), np.array([0.05, 0.0, 0.6]))
        T = T @ step
        poses.append(T)
    return poses


def odometry_of(poses: list[Float], rng: np.random.Generator, heading_rad: float = 0.002) -> list[Float]:
    """The same poses as a robot with drift knows them."""
    T = np.eye(4)
    known = [T]
    scale, bias = 1.0 + rng.normal(0.0, 0.02), rng.normal(0.0, heading_rad)
    for before, now in pairwise(poses):
        step = inverse(before) @ now
        noise = so3_exp(np.array([0.0, bias, 0.0]) + rng.normal(0.0, heading_rad, 3))
        T = T @ pose(step[:3, :3] @ noise, scale * step[:3, 3] + rng.normal(0.0, 0.005, 3))
        known.append(T)
    return known


def flows(
    rng: np.random.Generator,
    count: int = 20,
    factor: float = 1.0,
    mirrored: bool = False,
    turn_rad: float = 0.1,
    odometry: Callable[[list[Float]], list[Float]] = lambda poses: poses,
) -> list[WatchedPair]:
    """Pairs of a drive as a camera sees them whose configured focal length is `factor` times the true one."""
    poses = drive(rng, count, turn_rad)
    known = odometry(odometry_of(poses, rng))
    stretch = np.array([-1.0 if mirrored else 1.0, 1.0]) / factor
    pairs = []
    for k in range(count):
        before, now = _rays(poses[k], poses[k + 1], rng)
        flow = Flow(before * stretch, now * stretch, FOCAL_PX * factor, known[k], known[k + 1])
        pairs.append(WatchedPair(flow))
    return pairs


def turned_by(T_body_camera: Float) -> Callable[[list[Float]], list[Float]]:
    """Odometry that knows the camera without this turn."""
    return lambda poses: [T @ inverse(T_body_camera) for T in poses]


def as_a_car_knows(seed: int, times: float = 1.0) -> Callable[[list[Float]], list[Float]]:
    """Odometry that is off by so many times 2 degrees of heading and 3 cm from one keyframe to the next."""
    rng = np.random.default_rng(seed)
    turn_rad, t_m = times * np.radians([0.6, 2.0, 0.6]), times * 0.03

    def known(poses: list[Float]) -> list[Float]:
        steps = [inverse(before) @ now for before, now in pairwise(poses)]
        off = [pose(so3_exp(rng.normal(0.0, turn_rad)), rng.normal(0.0, t_m, 3)) for _ in steps]
        return list(accumulate((T @ error for T, error in zip(steps, off, strict=True)), np.matmul, initial=poses[0]))

    return known


def _rays(T_world_before: Float, T_world_now: Float, rng: np.random.Generator) -> tuple[Float, Float]:
    """Matches of points before both cameras, half a pixel wrong."""
    points = np.column_stack([rng.uniform(-6, 6, 400), rng.uniform(-3, 3, 400), rng.uniform(3, 25, 400)])
    in_world = points @ T_world_before[:3, :3].T + T_world_before[:3, 3]
    seen = []
    for T in (T_world_before, T_world_now):
        p = (in_world - T[:3, 3]) @ T[:3, :3]
        seen.append(np.column_stack([p[:, :2] / np.maximum(p[:, 2:], 0.1), p[:, 2]]))
    good = np.all([(s[:, 2] > 0.5) & (np.abs(s[:, :2]).max(axis=1) < 0.8) for s in seen], axis=0)
    noise = 0.5 / FOCAL_PX
    return tuple(s[good][:120, :2] + rng.normal(0, noise, (min(int(good.sum()), 120), 2)) for s in seen)  # type: ignore[return-value]


@pytest.mark.parametrize("factor", [0.5, 0.8, 0.9, 1.1, 1.25])
@pytest.mark.parametrize("seed", range(2))
def test_a_wrong_focal_length_is_named_with_its_factor_within_20_keyframes(factor: float, seed: int) -> None:
    verdict = camera_verdict(flows(np.random.default_rng(seed), 19, factor, turn_rad=0.12))
    assert verdict is not None
    assert verdict.fault is CameraFault.FOCAL_LENGTH
    assert verdict.focal_factor == pytest.approx(1.0 / factor, rel=0.04)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("seed", range(2))
def test_a_camera_turned_by_five_degrees_is_named_with_its_turn(axis: int, seed: int) -> None:
    T_camera_true = pose(so3_exp(TURNED_RAD * np.eye(3)[axis]), np.zeros(3))
    verdict = camera_verdict(flows(np.random.default_rng(seed), 19, odometry=turned_by(T_camera_true)))
    assert verdict is not None
    assert verdict.fault is CameraFault.MOUNTING
    assert angle_rad(verdict.X.T @ T_camera_true[:3, :3]) < np.radians(1.5)


@pytest.mark.parametrize("seed", range(6))
def test_a_camera_that_fits_is_left_in_peace_at_every_number_of_pairs(seed: int) -> None:
    pairs = flows(np.random.default_rng(seed), 20, turn_rad=0.03 + 0.04 * seed)
    assert [camera_verdict(pairs[:count]) for count in (5, 8, 20)] == [None] * 3


def test_odometry_of_another_convention_is_told_by_what_fits() -> None:
    R_body_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    found: dict[str, CameraVerdict | None] = {
        "body": camera_verdict(flows(np.random.default_rng(1), odometry=turned_by(pose(R_body_camera, np.zeros(3))))),
        "inverted": camera_verdict(flows(np.random.default_rng(2), odometry=lambda p: [inverse(T) for T in p])),
        "mixed": camera_verdict(
            flows(
                np.random.default_rng(3),
                odometry=lambda p: [pose(T[:3, :3], np.array([T[1, 3], T[2, 3], T[0, 3]])) for T in p],
            )
        ),
    }
    assert {name: verdict.fault if verdict else None for name, verdict in found.items()} == {
        "body": CameraFault.MOUNTING,
        "inverted": CameraFault.INVERTED_POSES,
        "mixed": CameraFault.MIXED_FRAMES,
    }


def test_mirrored_pictures_are_named() -> None:
    verdict = camera_verdict(flows(np.random.default_rng(4), mirrored=True))
    assert verdict is not None
    assert verdict.fault is CameraFault.MIRRORED


def test_other_axes_are_named_also_where_odometry_is_too_bad_for_anything_else() -> None:
    """Nothing makes bad odometry agree with pictures, but the axes that are configured leave twice as much and more.

    In a plane a mirrored camera moves as one that hangs upside down does.
    """
    rng, car = np.random.default_rng, as_a_car_knows(0)
    upside_down = turned_by(pose(so3_exp(np.array([0.0, 0.0, np.pi])), np.zeros(3)))
    pairs = flows(rng(0), 12, mirrored=True, odometry=car)
    found = [
        camera_verdict(flows(rng(0), 12, odometry=car)),
        camera_verdict(pairs),
        camera_verdict(flows(rng(0), 12, odometry=lambda poses: upside_down(car(poses)))),
    ]
    assert [None if verdict is None else verdict.fault for verdict in found] == [
        None,
        CameraFault.MOUNTING,
        CameraFault.MOUNTING,
    ]
    assert all(verdict.places_wrongly for verdict in found if verdict is not None)


def test_axes_that_were_found_wrong_stay_so_as_long_as_they_explain_more() -> None:
    pairs = flows(np.random.default_rng(1), 10, mirrored=True, odometry=as_a_car_knows(1, 2.2))
    first = camera_verdict(pairs[:5])
    assert first is not None
    assert camera_verdict(pairs) is None
    for fault in (first.fault, CameraFault.MIRRORED):
        later = camera_verdict(pairs, fault)
        assert later is not None
        assert later.fault is fault
        assert later.places_wrongly


def test_a_robot_that_only_drives_straight_shows_no_focal_length() -> None:
    assert camera_verdict(flows(np.random.default_rng(5), factor=0.5, turn_rad=0.001)) is None


# Whose closures would misplace it


class Told:
    """A perception whose registrar tells the flows of a drive in turn."""

    def __init__(self, pairs: list[WatchedPair]) -> None:
        self.registrar = self
        self._flows = [pair.flow for pair in pairs]

    def describe(self, image: Image) -> Array:
        return Array.of(np.zeros(2, np.float32))

    def encode(self, image: Image) -> bytes:
        return b"latent"

    def flow(self, before: bytes, now: bytes, T_odom_before: Float, T_odom_now: Float) -> Flow | None:
        return self._flows.pop(0)


def offered(pairs: list[WatchedPair]) -> tuple[list[bool], list[CameraDoubted]]:
    """Whether each keyframe of a drive is offered for closures, and what is told."""
    perception, watch, rng = Told(pairs), CameraWatch(), np.random.default_rng(0)
    looks = [
        watch.look(
            cast(Perception, perception),
            image_of(rng.integers(0, 256, (240, 320), dtype=np.uint8)),
            pose(np.eye(3), np.array([k, 0.0, 0.0])),
        )
        for k in range(len(pairs) + 1)
    ]
    assert {look.fault for look in looks} <= {"", WITHHELD}
    assert all((look.latent is None) == (look.descriptor is None) == bool(look.fault) for look in looks)
    return [look.latent is not None for look in looks], [doubt for look in looks for doubt in look.doubts]


def turned(rng: np.random.Generator, degrees: float, count: int = 20, turn_rad: float = 0.1) -> list[WatchedPair]:
    T = pose(so3_exp(np.radians(degrees) * np.array([0.0, 0.0, 1.0])), np.zeros(3))
    return flows(rng, count, turn_rad=turn_rad, odometry=turned_by(T))


@pytest.mark.parametrize("degrees", [75.0, 90.0, 179.9])
def test_a_camera_of_other_axes_is_kept_out_of_closures_from_when_it_is_known(degrees: float) -> None:
    is_offered, doubts = offered(turned(np.random.default_rng(21), degrees))
    assert is_offered == [True] * 5 + [False] * 16
    assert [(doubt.doubt, doubt.withheld) for doubt in doubts] == [("mounting", True)]
    assert doubts[0].amount == pytest.approx(degrees, abs=2.0)


def test_mirrored_pictures_are_kept_out_of_closures() -> None:
    is_offered, doubts = offered(flows(np.random.default_rng(22), mirrored=True))
    assert not any(is_offered[12:])
    assert ("mirrored", True) in {(doubt.doubt, doubt.withheld) for doubt in doubts}


@pytest.mark.parametrize("seed", range(23, 25))
def test_a_camera_that_fits_or_is_a_bit_off_is_offered_always(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for pairs in (flows(rng), turned(rng, 6.0), turned(rng, 40.0), flows(rng, factor=0.6)):
        is_offered, doubts = offered(pairs)
        assert all(is_offered)
        assert not any(doubt.withheld for doubt in doubts)


def test_a_straight_way_proves_nothing_and_a_mended_camera_is_offered_again() -> None:
    rng = np.random.default_rng(27)
    straight, _ = offered([*turned(rng, 180.0), *turned(rng, 180.0, 60, turn_rad=0.001)])
    assert not any(straight[8:])
    mended, _ = offered([*turned(rng, 180.0, 8), *flows(rng, 30)])
    assert not any(mended[7:12])
    assert all(mended[20:])


# What moves with the camera


def picture(T: Float, texture: NDArray[np.uint8], overlay: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
    """What a camera sees that turns at one place, with an overlay on its lens."""
    K = CAMERA.K()
    shift = np.array([[1.0, 0.0, 340.0], [0.0, 1.0, 240.0], [0.0, 0.0, 1.0]])
    H = np.linalg.inv(shift @ K @ T[:3, :3] @ np.linalg.inv(K))
    seen = cv2.warpPerspective(texture, H, (320, 240), borderMode=cv2.BORDER_WRAP)
    if overlay is not None:
        seen = np.where(overlay, _texture(99)[:240, :320], seen)
    return np.asarray(seen, np.uint8)


def _texture(seed: int) -> NDArray[np.uint8]:
    small = np.random.default_rng(seed).integers(0, 256, (90, 125), dtype=np.uint8)
    return np.asarray(cv2.resize(small, (1000, 720), interpolation=cv2.INTER_CUBIC), np.uint8)


def turning(count: int) -> list[Float]:
    """Camera poses of a robot that turns by two degrees for each keyframe and moves a bit."""
    angles = np.radians(-20.0 + 2.0 * np.arange(count))
    return [pose(so3_exp(np.array([0.1 * a, a, 0.0])), np.array([0.2 * k, 0.0, 0.0])) for k, a in enumerate(angles)]


def bumper(share: float) -> NDArray[np.bool_]:
    hidden = np.zeros((240, 320), np.bool_)
    hidden[round(240 * (1.0 - share)) :] = True
    return hidden


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
def test_a_bumper_is_found_and_little_else(share: float) -> None:
    finder = OverlayFinder(CAMERA)
    texture, hidden = _texture(1), bumper(share)
    assert not any(finder.add(picture(T, texture, hidden), T) for T in turning(12))
    mask = finder.mask((320, 240))
    assert np.mean(mask[hidden]) > 0.95
    assert np.mean(mask[~hidden]) < 0.12
    assert place_of(finder.cells()) == "bottom" or share > 0.3


@pytest.mark.parametrize("kind", ["watermark", "clock"])
def test_what_lets_the_scene_through_or_counts_is_found(kind: str) -> None:
    """A rule that asks whether a window as a whole stays finds 0 and 0.53 of the writing here."""
    finder, cover = OverlayFinder(CAMERA), overlay(kind, (320, 240), 0.3, 1)
    grey = np.full((240, 320, 3), 128, np.uint8)
    written = np.any([cover(grey, k)[..., 0] > 135 for k in range(12)], axis=0)
    for k, T in enumerate(turning(12)):
        smooth = np.asarray(cv2.GaussianBlur(picture(T, _texture(1)), (0, 0), 1), np.uint8)
        seen = np.repeat(smooth[..., None], 3, axis=2)
        finder.add(np.ascontiguousarray(cover(seen, k)[..., 0]), T)
    mask = finder.mask((320, 240))
    assert np.mean(mask[written]) > 0.7
    assert np.mean(mask[cv2.dilate(written.astype(np.uint8), np.ones((25, 25), np.uint8)) == 0]) < 0.12


def test_pictures_without_a_match_that_is_right_show_no_motion() -> None:
    """OpenCV 5.0 raises on about half of these."""
    rng = np.random.default_rng(8)
    motions = pose(so3_exp(np.array([0.0, 0.1, 0.0])), np.zeros(3))
    found = []
    for _ in range(10):
        points = rng.uniform(-0.5, 0.5, (2, 20, 2)).astype(np.float32)
        features = [Features(one, np.zeros((20, 128), np.uint8), FOCAL_PX) for one in points]
        found.append(flow_of(features[0], features[1], (np.arange(20), np.arange(20)), np.eye(4), motions))
    assert sum(flow is not None for flow in found) <= 1


def test_nothing_stays_where_nothing_is_on_the_lens() -> None:
    finder = OverlayFinder(CAMERA)
    assert not any(finder.add(picture(T, _texture(2)), T) for T in turning(20))
    assert not finder.cells().any()


def test_what_a_robot_turns_around_stays_and_is_scene() -> None:
    """A wall at 3 m that is kept in view: what the turn moves, the way to the side moves back."""
    finder = OverlayFinder(CAMERA)
    texture, K = _texture(5), np.array([[280.0, 0.0, 159.5], [0.0, 280.0, 119.5], [0.0, 0.0, 1.0]])
    wall_of_texture = np.array([[3.0 / 280.0, 0.0, -5.4], [0.0, 3.0 / 280.0, -3.9], [0.0, 0.0, 1.0]])
    for x in 0.15 * np.arange(-5, 6):
        T = pose(so3_exp(np.array([0.0, -np.arctan(x / 3.0), 0.0])), np.array([x, 0.0, 0.0]))
        R = T[:3, :3].T
        H = K @ np.column_stack([R[:, 0], R[:, 1], R @ (np.array([0.0, 0.0, 3.0]) - T[:3, 3])]) @ wall_of_texture
        assert not finder.add(np.asarray(cv2.warpPerspective(texture, H, (320, 240)), np.uint8), T)
        assert not finder.cells().any()


def test_broad_blobs_resemble_themselves_a_few_pixels_on_and_are_scene() -> None:
    finder = OverlayFinder(CAMERA)
    small = np.random.default_rng(6).integers(0, 256, (18, 25), dtype=np.uint8)
    texture = np.asarray(cv2.resize(small, (1000, 720), interpolation=cv2.INTER_CUBIC), np.uint8)
    for angle in np.radians(np.arange(12)):
        T = pose(so3_exp(np.array([0.0, angle, 0.0])), np.zeros(3))
        finder.add(picture(T, texture), T)
        assert not finder.cells().any()


def test_a_frozen_picture_is_not_encoded_and_told_at_the_second_one() -> None:
    perception = build_perception(PerceptionConfig())
    watch = CameraWatch()
    poses = turning(6)
    looks = [watch.look(perception, image_of(picture(poses[min(k, 3)], _texture(3))), T) for k, T in enumerate(poses)]
    assert [look.latent is None for look in looks] == [False, False, False, False, True, True]
    assert [doubt.doubt for look in looks for doubt in look.doubts] == ["frozen"]
    assert "taken before" in looks[4].fault


def test_a_robot_that_stands_while_odometry_goes_on_has_no_frozen_camera() -> None:
    """Noise of one grey level: another picture of the same place."""
    perception = build_perception(PerceptionConfig())
    watch, rng = CameraWatch(), np.random.default_rng(7)
    poses = turning(6)
    noisy = [
        np.clip(picture(poses[min(k, 3)], _texture(3)) + rng.normal(0.0, 1.0, (240, 320)), 0.0, 255.0).astype(np.uint8)
        for k in range(6)
    ]
    looks = [watch.look(perception, image_of(pixels), T) for pixels, T in zip(noisy, poses, strict=True)]
    assert [look.latent is None for look in looks] == [False, False, False, False, True, True]
    assert [(doubt.doubt, doubt.amount) for look in looks for doubt in look.doubts] == [("standing", 2)]
    assert "though by odometry" in looks[4].fault


def test_a_standing_robot_may_see_the_same_twice() -> None:
    finder = OverlayFinder(CAMERA)
    T = turning(1)[0]
    assert not any(finder.add(picture(T, _texture(3)), T) for _ in range(3))


def test_a_robot_that_turned_round_and_is_back_may_see_the_same_again() -> None:
    """Odometry says 3 degrees more than it turned; a simulator without noise gives the very same picture."""
    finder = OverlayFinder(CAMERA)
    texture = _texture(3)
    for angle in np.radians([*range(0, 351, 30), 363]):
        T = pose(so3_exp(np.array([0.0, angle, 0.0])), np.zeros(3))
        true_T = pose(so3_exp(np.array([0.0, angle * 360 / 363, 0.0])), np.zeros(3))
        assert not finder.add(picture(true_T, texture), T)


def test_an_overlay_is_told_once_and_left_out_from_then_on() -> None:
    perception = build_perception(PerceptionConfig())
    watch = CameraWatch()
    looks = [watch.look(perception, image_of(picture(T, _texture(4), bumper(0.3))), T) for T in turning(10)]
    doubts = [doubt for look in looks for doubt in look.doubts if doubt.doubt == "overlay"]
    assert len(doubts) == 1
    assert isinstance(doubts[0], CameraDoubted)
    assert doubts[0].where == "bottom"
    assert 0.25 < doubts[0].amount < 0.45
    assert [(look.withdrawn, look.hidden is None) for look in looks] == [
        (k, False) if looks[k].doubts else (0, True)
        for k in range(10)  # all keyframes before it show it
    ]
    assert looks[-1].latent is not None
    from flocc_agent.perception.classical.encoder import decode_features

    rows = decode_features(looks[-1].latent).points[:, 1] * CAMERA.fy + CAMERA.cy
    assert float(rows.max()) < 240 * 0.7


def image_of(grey: NDArray[np.uint8], hidden: NDArray[np.bool_] | None = None) -> Image:
    return Image(np.repeat(grey[..., None], 3, axis=2), CAMERA, hidden)


def test_hidden_pixels_give_no_feature_no_patch_and_take_nobodys_place() -> None:
    seen, hidden = picture(np.eye(4), _texture(5)), bumper(0.5)
    extractor = FeatureExtractor(ClassicalConfig(features_max=100))
    whole, shown = extractor.extract(image_of(seen)), extractor.extract(image_of(seen, hidden))
    assert len(whole.points) == len(shown.points) == 100
    assert float((shown.points[:, 1] * CAMERA.fy + CAMERA.cy).max()) < 120
    assert 0 < len(dense_patches(seen, hidden)) < 0.5 * len(dense_patches(seen))


def test_what_stays_at_its_pixel_is_no_match_of_two_places() -> None:
    rng = np.random.default_rng(6)
    scene = wall(rng)
    first, second = seen_from(scene, camera_at((0, 0, 0)), rng), seen_from(scene, camera_at((0.5, 0, 0)), rng)
    count = min(len(first.points), len(second.points))
    second.points[:10] = first.points[:10]
    same = np.arange(count)
    kept, _ = without_overlay(first, second, (same, same))
    assert not set(range(10)) & set(kept.tolist())
    assert len(kept) > 0.8 * (count - 10)


@pytest.mark.parametrize(("staying", "left"), [(29, 20), (40, 0)])
def test_what_changes_on_an_overlay_that_two_robots_share_goes_with_what_stays(staying: int, left: int) -> None:
    """A clock: most digits are the same in both pictures, and those that are not look like others beside them."""
    rng = np.random.default_rng(10)
    points = np.concatenate([rng.uniform([-0.1, 0.3], [0.1, 0.4], (staying + 20, 2)), [[-0.5, -0.4]]])
    elsewhere = points.copy()
    elsewhere[staying:-1] = rng.uniform([-0.1, 0.3], [0.1, 0.4], (20, 2))
    elsewhere[-1] += 0.1
    descriptors = np.zeros((len(points), 128), np.uint8)
    first, second = (Features(p.astype(np.float32), descriptors, FOCAL_PX) for p in (points, elsewhere))
    every = np.arange(len(points))
    kept = without_overlay(first, second, (every, every))[0]
    assert kept[-1] == len(points) - 1
    assert len(kept) - 1 == pytest.approx(left, abs=1)


def test_a_robot_that_does_not_turn_keeps_matches_that_stay() -> None:
    points = np.random.default_rng(7).uniform(-0.5, 0.5, (20, 2))
    straight, turned = pose(np.eye(3), np.array([0, 0, 1.0])), pose(so3_exp(np.array([0, 0.1, 0])), np.zeros(3))
    assert moves_with_the_scene(points, points, FOCAL_PX, straight).all()
    assert not moves_with_the_scene(points, points, FOCAL_PX, turned).any()


def test_what_goes_straight_hides_what_stays_beside_its_way() -> None:
    beside, ahead = np.array([[0.4, 0.3]]), np.array([[0.05, 0.0]])
    straight = pose(np.eye(3), np.array([0.0, 0.0, 2.4]))
    assert not moves_with_the_scene(beside, beside, FOCAL_PX, straight).any()
    assert moves_with_the_scene(ahead, ahead, FOCAL_PX, straight).all()


def test_what_two_robots_of_one_make_show_at_other_pixels_is_no_closure() -> None:
    """The first keyframes are encoded before anybody knows what moves with the camera."""
    rng = np.random.default_rng(9)
    part = np.column_stack([rng.uniform(-0.6, 0.6, 120), rng.uniform(0.1, 0.45, 120)])
    looks = rng.integers(0, 256, (120, 128), dtype=np.uint8)

    def shown(offset_px: tuple[float, float], changed: int) -> bytes:
        """120 features of the robot, some of which count, and 60 of a place that nobody else sees."""
        points = np.concatenate([part + np.array(offset_px) / FOCAL_PX, rng.uniform(-0.5, 0.5, (60, 2))])
        points[:120] += rng.normal(0.0, 0.3 / FOCAL_PX, (120, 2))
        descriptors = np.concatenate([looks, rng.integers(0, 256, (60, 128), dtype=np.uint8)])
        descriptors[:changed] = rng.integers(0, 256, (changed, 128), dtype=np.uint8)
        return encode_features(Features(points.astype(np.float32), descriptors, FOCAL_PX), {})

    turned = pose(so3_exp(np.array([0.0, 0.1, 0.0])), np.array([0.5, 0.0, 0.0]))
    query, match = shown((0.0, 0.0), 0), shown((12.0, 6.0), 0)
    registrar = classical_registrar(ClassicalConfig())
    assert registrar.register(query, match, None).correspondences > 100
    beside = registrar.register(query, match, OdometryPair(shown((0.0, 0.0), 40), turned, "own"))
    assert isinstance(beside, RegistrationFailed)
    assert beside.failure is RegistrationFailure.FEW_CORRESPONDENCES


@pytest.mark.data
@pytest.mark.parametrize("factor", [0.8, 1.0, 1.25])
def test_street_names_a_wrong_focal_length_within_20_keyframes(shared: Path, factor: float) -> None:
    from flocc_lab.bench.registration_scenes import robots_beside

    views = [view for view in robots_beside(shared / "data" / "street", 1.0).views if view.robot == "r1"][:20]
    perception, watch = build_perception(PerceptionConfig()), CameraWatch()
    told: list[CameraDoubted] = []
    for view in views:
        c = view.camera
        wrong = Camera(c.width, c.height, c.fx * factor, c.fy * factor, c.cx, c.cy, c.distortion)
        told += watch.look(perception, Image(view.image().pixels, wrong), view.T_odom_camera).doubts
    if factor == 1.0:
        assert told == []
    else:
        assert {doubt.doubt for doubt in told} == {"focal length"}
        assert told[-1].amount == pytest.approx(1.0 / factor, rel=0.06)


@pytest.mark.data
def test_noisy_poses_accuse_no_camera(shared: Path) -> None:
    """Steps of 0.1 m by poses that are 1 to 2 cm off: the robot was told that its focal length is 1.29 times."""
    from flocc_lab.bench.acceptance_rows import colour_sevenscenes
    from flocc_lab.bench.watched_drives import drives_of

    drive = drives_of("sevenscenes", colour_sevenscenes(shared / "data" / "sevenscenes"))
    views = [view for robot in drive if robot.robot == "r2" for view in robot.views][:13]
    perception, watch = build_perception(PerceptionConfig()), CameraWatch()
    looks = [watch.look(perception, view.image(), view.T_odom_camera) for view in views]
    assert [doubt for look in looks for doubt in look.doubts] == []
