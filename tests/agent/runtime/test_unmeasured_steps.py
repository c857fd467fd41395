"""Steps of odometry that nobody measured: found in files and as poses come, and left to loop closures."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from tests.agent.runtime.test_pose_limits import drawn_ride

from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig
from flocc_agent.core.measurements import OdometryCovariance
from flocc_agent.core.pose_graph import GraphSolution, LoopClosure, PoseGraph, Trajectory
from flocc_agent.geometry import between, inverse, pose, so3_exp
from flocc_agent.runtime.recording import Recording
from flocc_agent.runtime.unmeasured_steps import StepWatch, after_jump, after_pause, pauses, unmeasured
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]


@pytest.mark.parametrize("seed", range(20))
def test_as_poses_come_the_same_jump_is_found_as_in_a_file(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamps_s, T = drawn_ride(rng)
    k = int(rng.integers(12, len(T) - 5))
    stamps_s[k:] += stamps_s[k - 1] + min(0.1, stamps_s[k] - stamps_s[k - 1]) - stamps_s[k]
    jumped = np.array(T)
    jumped[k:, :3, 3] += [500.0, 0.0, 0.0]
    for poses, found in ((T, []), (jumped, [k])):
        assert sorted(unmeasured(stamps_s, poses)) == sorted({*pauses(stamps_s).tolist(), *found})
        watch = StepWatch(pauses_count=False)
        exact = []
        for n, (stamp_s, T_odom_body) in enumerate(zip(stamps_s, poses, strict=True)):
            watch.saw(float(stamp_s), T_odom_body)
            if n % 4 == 0 and watch.of_keyframe(float(stamp_s)) is not None:
                exact.append(n)
        assert exact == [-(-n // 4) * 4 for n in found]


def test_a_pause_is_one_of_odometry_and_not_of_photographs_or_of_the_camera() -> None:
    every_minute = np.array([60.0 * k for k in range(20)])
    usual = np.array([0.1 * k for k in range(20)])
    paused = np.array([0.1 * k + 15.0 * (k >= 12) for k in range(20)])
    assert pauses(every_minute).tolist() == pauses(usual).tolist() == []
    assert pauses(paused).tolist() == [12]
    for counts in (True, False):
        watch = StepWatch(counts)
        assert watch.of_keyframe(-1.0) is None
        for stamp_s in paused:
            watch.saw(float(stamp_s), np.eye(4))
        step = watch.of_keyframe(float(paused[-1]))
        assert (step is not None) == counts


@pytest.mark.parametrize("pause_s", [5.1, 86_400.0, 1e12])
def test_however_long_a_pause_is_its_step_can_be_kept(pause_s: float) -> None:
    assert after_pause(pause_s).covariance[3, 3] <= 1e10
    far = pose(np.eye(3), np.array([1e7, -1e7, 0.0]))
    assert after_jump(far, np.eye(4)).covariance[3, 3] <= 1e10


def test_a_recording_says_so_of_the_frame_after_a_pause_but_where_it_says_it_itself(tmp_path: Path) -> None:
    stamps_s = [0.2 * k + 15.0 * (k >= 10) for k in range(20)]
    (tmp_path / "images").mkdir()
    for k in range(20):
        cv2.imwrite(str(tmp_path / f"images/{k}.png"), np.full((8, 8, 3), 10 * k, dtype=np.uint8))
    lines = [f"{stamp_s:.3f} images/{k}.png" for k, stamp_s in enumerate(stamps_s)]
    (tmp_path / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{stamp_s:.3f} {0.1 * k:.1f} 0 0 0 0 0 1" for k, stamp_s in enumerate(stamps_s)]
    (tmp_path / "odometry.tum").write_text("\n".join(rows) + "\n")
    (tmp_path / "camera.toml").write_text("[camera]\nwidth=8\nheight=8\nfx=8\nfy=8\ncx=4\ncy=4\ndistortion=[]\n")
    measurements = Recording.open(tmp_path).measurements
    assert measurements.kept == {stamps_s[10]}
    (stated,) = measurements.at(stamps_s[10])
    assert isinstance(stated.measurement, OdometryCovariance)
    assert stated.measurement.covariance[3, 3] > 15.0**2


def test_closures_place_a_robot_that_was_carried_and_blame_nobodys_scale() -> None:
    """beta is switched off after keyframe 13, carried 9 m and switched on: its odometry goes on from there."""
    a, b = LogId("alfa"), LogId("beta")
    angles = np.linspace(0.0, 4.0, 40)
    ring = np.array(
        [pose(so3_exp(np.array([0.0, 0.0, t])), 8.0 * np.array([np.sin(t), 1 - np.cos(t), 0])) for t in angles]
    )
    truth = {a: ring, b: ring @ pose(np.eye(3), np.array([0.0, 0.5, 0.0]))}
    carried = np.concatenate([truth[b][:14], truth[b][13] @ inverse(truth[b][26]) @ truth[b][26:]])
    truth[b] = np.concatenate([truth[b][:14], truth[b][26:]])
    places = [*range(14), *range(26, 40)]
    closures = [
        LoopClosure(KeyframeId(b, n), KeyframeId(a, k), between(truth[b][n], truth[a][k]), metric=True)
        for n, k in enumerate(places)
        if n % 2
    ]
    step = after_pause(15.0)
    covariances = np.full((len(carried) - 1, 6, 6), np.nan)
    covariances[13] = step.covariance
    config = BackendConfig(weight_by_probability=False, covariances=False)
    worst_m = []
    for edge_covariances in (covariances, None):
        trajectories = {a: Trajectory(truth[a]), b: Trajectory(carried, edge_covariances)}
        solution = optimise(PoseGraph(trajectories, closures), config)
        assert isinstance(solution, GraphSolution)
        (component,) = solution.components
        T_world_map = truth[a][0] @ inverse(component.T_map_keyframe[a][0])
        off = T_world_map @ component.T_map_keyframe[b]
        worst_m.append(float(np.linalg.norm(off[:, :3, 3] - truth[b][:, :3, 3], axis=1).max()))
    assert worst_m[0] < 0.02
    assert worst_m[1] > 0.5
