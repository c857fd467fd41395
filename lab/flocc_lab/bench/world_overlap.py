"""How well a world's images can be matched: `python -m flocc_lab.bench.world_overlap FOLDER` prints figures as JSON.

SIFT, ratio test, essential matrix: no part of the agent's perception, so that it judges the world and not the agent.
"""

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import angle_rad, between
from flocc_agent.runtime.recording import Recording

Float = NDArray[np.float64]

FEATURES = 1500
RATIO_MAX = 0.8
INLIERS_MIN = 60
NEAR_M = 2.0
SIMILAR_DEG = 25.0


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """Two views compared: inliers of the essential matrix, and its errors against the truth, degrees."""

    inliers: int
    rotation_error_deg: float
    direction_error_deg: float


class Matcher:
    """Compares views of several recordings that share one camera."""

    def __init__(self, recordings: list[Recording]) -> None:
        self._recordings = recordings
        self._sift = cv2.SIFT.create(FEATURES)
        self._features: dict[tuple[int, int], tuple[Float, NDArray[np.float32]]] = {}

    def camera_pose(self, robot: int, frame: int) -> Float:
        """True (4, 4) pose of a view."""
        recording = self._recordings[robot]
        T_world_body = recording.ground_truth(recording.frames[frame].stamp_s)
        assert T_world_body is not None, f"{recording.path} has no ground truth"
        return T_world_body @ recording.T_body_camera

    def compare(self, first: tuple[int, int], second: tuple[int, int]) -> Matched:
        """Match two views, each (robot, frame)."""
        (points_a, descriptors_a), (points_b, descriptors_b) = self._described(first), self._described(second)
        pairs = cv2.BFMatcher().knnMatch(descriptors_a, descriptors_b, k=2)
        good = [one for one, two in pairs if one.distance < RATIO_MAX * two.distance]
        a, b = points_a[[m.queryIdx for m in good]], points_b[[m.trainIdx for m in good]]
        K = self._recordings[first[0]].camera.K()
        E, mask = cv2.findEssentialMat(a, b, K, cv2.RANSAC, 0.9999, 1.0) if len(good) >= 8 else (None, None)
        if E is None or mask is None or E.shape != (3, 3):
            return Matched(0, 180.0, 180.0)
        _, R, t, _ = cv2.recoverPose(E, a, b, K, mask=mask.copy())
        T_second_first = between(self.camera_pose(*second), self.camera_pose(*first))
        direction = T_second_first[:3, 3] / max(float(np.linalg.norm(T_second_first[:3, 3])), 1e-9)
        return Matched(
            int(mask.sum()),
            float(np.degrees(angle_rad(R.T @ T_second_first[:3, :3]))),
            float(np.degrees(np.arccos(np.clip(t[:, 0] @ direction, -1, 1)))),
        )

    def overlapping(self, first: int, second: int) -> Iterator[tuple[int, int]]:
        """Frames of one robot with the frame of the other that was taken nearest by, looking the same way."""
        others = np.array([self.camera_pose(second, k) for k in range(len(self._recordings[second].frames))])
        for k in range(len(self._recordings[first].frames)):
            relative = between(self.camera_pose(first, k), others)
            apart_m = np.linalg.norm(relative[:, :3, 3], axis=1)
            turned_deg = np.degrees(np.arccos(np.clip(relative[:, 2, 2], -1, 1)))
            cost = np.where((apart_m < NEAR_M) & (turned_deg < SIMILAR_DEG), apart_m + turned_deg / 15, np.inf)
            if np.isfinite(cost.min()):
                yield k, int(cost.argmin())

    def _described(self, view: tuple[int, int]) -> tuple[Float, NDArray[np.float32]]:
        if view not in self._features:
            recording = self._recordings[view[0]]
            grey = cv2.cvtColor(recording.load_image(recording.frames[view[1]]).pixels, cv2.COLOR_RGB2GRAY)
            keypoints, descriptors = self._sift.detectAndCompute(grey, None)
            points = np.array([keypoint.pt for keypoint in keypoints])
            self._features[view] = points, np.asarray(descriptors, dtype=np.float32)
        return self._features[view]


def figures(folders: list[Path], every: int = 4) -> dict[str, Any]:
    """Statistics of consecutive views and of views that two robots share, over every n-th of them."""
    recordings = [Recording.open(folder) for folder in folders]
    matcher = Matcher(recordings)
    consecutive = [
        matcher.compare((robot, k), (robot, k + 1)).inliers
        for robot, recording in enumerate(recordings)
        for k in range(0, len(recording.frames) - 1, 3 * every)
    ]
    result: dict[str, Any] = {"consecutive_inliers": _spread(consecutive), "pairs": {}}
    for first, second in combinations(range(len(recordings)), 2):
        shared = list(matcher.overlapping(first, second))
        matched = [matcher.compare((first, a), (second, b)) for a, b in shared[::every]]
        good = [one for one in matched if one.inliers > INLIERS_MIN]
        result["pairs"][f"{folders[first].name}-{folders[second].name}"] = {
            "keyframes_with_a_shared_view": len(shared),
            "tried": len(matched),
            f"over_{INLIERS_MIN}_inliers": len(good),
            "inliers": _spread([one.inliers for one in matched]),
            "rotation_error_deg": _spread([one.rotation_error_deg for one in good]),
        }
    return result


def _spread(values: list[int] | list[float]) -> dict[str, float] | None:
    if not values:
        return None
    return {"min": round(min(values), 2), "median": round(float(np.median(values)), 2), "max": round(max(values), 2)}


def main() -> None:
    """Print the figures of a world's folder."""
    folders = sorted(path.parent for path in Path(sys.argv[1]).glob("*/camera.toml"))
    sys.stdout.write(json.dumps(figures(folders), indent=2) + "\n")


if __name__ == "__main__":
    main()
