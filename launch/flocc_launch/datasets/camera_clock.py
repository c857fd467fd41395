"""The offset between a camera's clock and its body's, which Kalibr measures: `t_imu = t_cam + timeshift_cam_imu`.

It is added to the stamps of pictures, where the poses are of the body's clock. An odometry that was made of the
pictures stamps its poses as they are stamped: then every pose stands at a picture's stamp, and both are of the camera's
clock already.
"""

from collections.abc import Sequence

import numpy as np

SAME_S = 2e-6
"""Stamps that are written with microseconds are no further off."""
AT_PICTURES_MIN_RATIO = 0.98


def of_pictures(pose_stamps_s: Sequence[float], picture_stamps_s: Sequence[float]) -> bool:
    """Whether poses stand at stamps of pictures, so that they are of the camera's clock."""
    poses, pictures = np.asarray(pose_stamps_s, dtype=float), np.sort(np.asarray(picture_stamps_s, dtype=float))
    inside = poses[(poses >= pictures[0] - SAME_S) & (poses <= pictures[-1] + SAME_S)] if len(pictures) else poses[:0]
    if len(inside) < 2:
        return False
    after = np.minimum(np.searchsorted(pictures, inside), len(pictures) - 1)
    near_s = np.minimum(np.abs(pictures[after] - inside), np.abs(pictures[np.maximum(after - 1, 0)] - inside))
    return bool(np.mean(near_s <= SAME_S) >= AT_PICTURES_MIN_RATIO)


def told(shift_s: float, is_added: bool) -> str:
    """What was made of the offset, for a note."""
    said = f"timeshift_cam_imu is {shift_s:+g} s (t_imu = t_cam + shift)"
    if is_added:
        return f"{said}, and was added to the stamps of the pictures"
    return f"{said}, and was not added: the poses stand at the pictures' own stamps, and are of the camera's clock"
