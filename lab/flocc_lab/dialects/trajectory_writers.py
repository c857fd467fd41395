"""Trajectories and names of images as other tools write them; the table in docs/data-sets.md lists these forms."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import q_wxyz_from_R
from flocc_agent.runtime.trajectory import Trajectory

Float = NDArray[np.float64]
Row = tuple[float, Float, Float]
"""Stamp in seconds, position, quaternion w x y z."""

EUROC_HEADER = (
    "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
    "b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)
OKVIS_HEADER = (
    "timestamp, p_WS_W_x, p_WS_W_y, p_WS_W_z, q_WS_x, q_WS_y, q_WS_z, q_WS_w, v_WS_W_x, v_WS_W_y, v_WS_W_z, "
    "b_g_x, b_g_y, b_g_z, b_a_x, b_a_y, b_a_z"
)
_ROS = "field.pose.pose"
ROS_HEADER = "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.child_frame_id," + ",".join(
    [*(f"{_ROS}.position.{axis}" for axis in "xyz"), *(f"{_ROS}.orientation.{axis}" for axis in "xyzw")]
)


@dataclass(frozen=True, slots=True)
class TrajectoryForm:
    """How one tool writes trajectories.

    Attributes:
        file: Its usual name.
        how: What says the columns: "header", "suffix", "columns" or "motion".
        write: Text of rows.
    """

    file: str
    how: str
    write: Callable[[Sequence[Row]], str]


def rows_of(trajectory: Trajectory) -> list[Row]:
    """Rows of a trajectory."""
    return [
        (float(stamp_s), T[:3, 3], q_wxyz_from_R(T[:3, :3]))
        for stamp_s, T in zip(trajectory.stamps_s, trajectory.T_fixed_body, strict=True)
    ]


def xyzw(row: Row) -> list[float]:
    """Position and quaternion, w last."""
    return [*row[1].tolist(), *row[2][[1, 2, 3, 0]].tolist()]


def wxyz(row: Row) -> list[float]:
    """Position and quaternion, w first."""
    return [*row[1].tolist(), *row[2].tolist()]


def line(values: Sequence[float | int | str], separator: str = " ") -> str:
    """One line; whole numbers and words stay as they are."""
    return separator.join(f"{value:.9f}" if isinstance(value, float) else str(value) for value in values) + "\n"


def ns(stamp_s: float) -> int:
    """Nanoseconds of a stamp."""
    return round(stamp_s * 1e9)


def _tum(rows: Sequence[Row]) -> str:
    return "".join(line([row[0], *xyzw(row)]) for row in rows)


FORMS: dict[str, TrajectoryForm] = {
    "TUM": TrajectoryForm("odometry.tum", "suffix", _tum),
    "TUM with its header": TrajectoryForm(
        "groundtruth.txt", "header", lambda rows: "# timestamp tx ty tz qx qy qz qw\n" + _tum(rows)
    ),
    "EuRoC ground truth": TrajectoryForm(
        "data.csv",
        "header",
        lambda rows: EUROC_HEADER + "\n" + "".join(line([ns(row[0]), *wxyz(row), *[0.5] * 9], ",") for row in rows),
    ),
    "EuRoC's 17 columns": TrajectoryForm(
        "odometry.csv", "columns", lambda rows: "".join(line([ns(row[0]), *wxyz(row), *[0.5] * 9], ",") for row in rows)
    ),
    "OKVIS": TrajectoryForm(
        "okvis2.csv",
        "header",
        lambda rows: OKVIS_HEADER + "\n" + "".join(line([ns(row[0]), *xyzw(row), *[0.5] * 9], ", ") for row in rows),
    ),
    "Basalt": TrajectoryForm(
        "trajectory.csv",
        "header",
        lambda rows: (
            ", ".join(EUROC_HEADER.split(", ")[:8])
            + "\n"
            + "".join(line([ns(row[0]), *wxyz(row)], ",") for row in rows)
        ),
    ),
    "VINS-Mono": TrajectoryForm(
        "vins_result_loop.csv",
        "columns",
        lambda rows: "".join(line([ns(r[0]), *wxyz(r)], ",")[:-1] + ",\n" for r in rows),
    ),
    "VINS-Fusion": TrajectoryForm(
        "vio.csv",
        "columns",
        lambda rows: "".join(line([ns(r[0]), *wxyz(r), 0.1, 0.2, 0.3], ",")[:-1] + ",\n" for r in rows),
    ),
    "RPG": TrajectoryForm(
        "stamped_traj_estimate.txt",
        "header",
        lambda rows: (
            "# id timestamp tx ty tz qx qy qz qw\n"
            + "".join(line([k, row[0], *xyzw(row)]) for k, row in enumerate(rows))
        ),
    ),
    "RTAB-Map": TrajectoryForm(
        "poses.txt",
        "header",
        lambda rows: (
            "#timestamp x y z qx qy qz qw id\n"
            + "".join(line([row[0], *xyzw(row), k + 1]) for k, row in enumerate(rows))
        ),
    ),
    "OpenVINS": TrajectoryForm(
        "traj_estimate.txt",
        "header",
        lambda rows: (
            "# timestamp(s) tx ty tz qx qy qz qw Pr11 Pr12 Pr13\n"
            + "".join(line([row[0], *xyzw(row), 0.1, 0.0, 0.0]) for row in rows)
        ),
    ),
    "rostopic echo -p": TrajectoryForm(
        "odom.csv",
        "header",
        lambda rows: (
            ROS_HEADER
            + "\n"
            + "".join(
                line([ns(row[0]) + 1000, k, ns(row[0]), "odom", "base_link", *xyzw(row)], ",")
                for k, row in enumerate(rows)
            )
        ),
    ),
    "sec and nanosec": TrajectoryForm(
        "poses.csv",
        "header",
        lambda rows: (
            "sec,nanosec,x,y,z,qw,qx,qy,qz\n"
            + "".join(line([*divmod(ns(row[0]), 10**9), *wxyz(row)], ",") for row in rows)
        ),
    ),
    "PX4 (ulog2csv)": TrajectoryForm(
        "vehicle_odometry_0.csv",
        "header",
        lambda rows: (
            "timestamp,timestamp_sample,position[0],position[1],position[2],q[0],q[1],q[2],q[3],pose_frame\n"
            + "".join(line([ns(row[0]) // 1000 + 45_000, ns(row[0]) // 1000, *wxyz(row), 1], ",") for row in rows)
        ),
    ),
    "Kimera": TrajectoryForm(
        "traj_vio.csv",
        "header",
        lambda rows: (
            "#timestamp,x,y,z,qw,qx,qy,qz,vx,vy,vz,bgx,bgy,bgz,bax,bay,baz\n"
            + "".join(line([ns(row[0]), *wxyz(row), *[0.5] * 9], ",") for row in rows)
        ),
    ),
    "bagpy": TrajectoryForm(
        "odom-odom.csv",
        "header",
        lambda rows: (
            "Time,header.seq,header.stamp.secs,header.stamp.nsecs,header.frame_id,child_frame_id,"
            + ",".join([*(f"pose.pose.position.{a}" for a in "xyz"), *(f"pose.pose.orientation.{a}" for a in "xyzw")])
            + ",pose.covariance\n"
            + "".join(
                line([row[0] + 0.01, k, *divmod(ns(row[0]), 10**9), "odom", "base", *xyzw(row), '"(0.1, 0.0)"'], ",")
                for k, row in enumerate(rows)
            )
        ),
    ),
    "maplab": TrajectoryForm(
        "vertex_poses_velocities_biases.csv",
        "header",
        lambda rows: (
            "vertex index, timestamp [ns], vertex-id(hex), mission-id(hex), p_G_Ix [m], p_G_Iy [m], p_G_Iz [m], "
            "q_G_Iw, q_G_Ix, q_G_Iy, q_G_Iz, v_x [m/s]\n"
            + "".join(line([k, ns(row[0]), "0a1b", "ffee", *wxyz(row), 0.0], ", ") for k, row in enumerate(rows))
        ),
    ),
    "LaMAR": TrajectoryForm(
        "trajectories.txt",
        "header",
        lambda rows: (
            "# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz, *covar\n"
            + "".join(line([ns(row[0]) // 1000, "ios", *wxyz(row)[3:], *wxyz(row)[:3]], ", ") for row in rows)
        ),
    ),
    "ZED": TrajectoryForm(
        "zed_poses.csv",
        "header",
        lambda rows: "Timestamp,tx,ty,tz,ox,oy,oz,ow\n" + "".join(line([ns(row[0]), *xyzw(row)], ",") for row in rows),
    ),
    "units in names": TrajectoryForm(
        "poses_mm.csv",
        "header",
        lambda rows: (
            "timestamp_ms,x_mm,y_mm,z_mm,qw,qx,qy,qz\n"
            + "".join(line([1e3 * r[0], *(1e3 * r[1]).tolist(), *r[2].tolist()], ",") for r in rows)
        ),
    ),
    "ORB-SLAM": TrajectoryForm("KeyFrameTrajectory.txt", "motion", _tum),
}
REFUSED: dict[str, tuple[str, str]] = {
    "KITTI rows without images": ("poses.txt", "1 0 0 1 0 1 0 2 0 0 1 3\n1 0 0 2 0 1 0 2 0 0 1 3\n"),
    "positions only": ("rtk.txt", "1700000000.0 1 2 3\n1700000000.1 1 2 3\n"),
    "roll, pitch, yaw": ("ins.csv", "timestamp,x,y,z,roll,pitch,yaw\n1700000000.0,1,2,3,0,0,0\n"),
    "Redwood, Open3D": ("trajectory.log", "0 0 1\n1 0 0 5\n0 1 0 5\n0 0 1 5\n0 0 0 1\n"),
    "unknown order": ("vio.txt", "1700000000.0 1 2 3 0.5 0.5 0.5 0.5\n1700000000.1 1 2 3 0.5 0.5 0.5 0.5\n"),
    "unknown unit": ("odometry.txt", "".join(f"{2 * k} {k} 0 0 0 0 0 1\n" for k in range(5))),
    "stamps in minutes": (
        "poses.csv",
        "time [min],x,y,z,qx,qy,qz,qw\n" + "".join(f"{k / 600:.6f},{k},0,0,0,0,0,1\n" for k in range(8)),
    ),
    "g2o": ("poses.g2o", "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n"),
    "the world in the camera": (
        "poses.csv",
        "timestamp,t_cw_x,t_cw_y,t_cw_z,q_cw_x,q_cw_y,q_cw_z,q_cw_w\n0,0,0,0,0,0,0,1\n",
    ),
    "poses of several bodies": (
        "tf.csv",
        "timestamp,child_frame_id,x,y,z,qx,qy,qz,qw\n"
        + "".join(f"1700000000.{k},{'base' if k % 2 else 'lidar'},{k},0,0,0,0,0,1\n" for k in range(8)),
    ),
    "JSON": ("poses.json", '{"poses": [[1, 2, 3]]}\n'),
}

NameForm = Callable[[float, int], str]


def _date(stamp_s: float, form: str) -> str:
    return datetime.fromtimestamp(int(stamp_s), tz=UTC).strftime(form)


def _thousandths(stamp_s: float) -> int:
    return round(stamp_s % 1 * 1000)


NAMES: dict[str, tuple[NameForm, float]] = {
    "seconds": (lambda s, _: f"{s:.6f}", 1e-6),
    "seconds and a camera": (lambda s, _: f"{s:.6f}_cam0", 1e-6),
    "seconds_nanoseconds": (lambda s, _: f"{ns(s) // 10**9}_{ns(s) % 10**9:09d}", 1e-6),
    "seconds-microseconds": (lambda s, _: f"frame_{int(s)}-{round(s % 1 * 1e6):06d}", 1e-6),
    "milliseconds": (lambda s, _: f"{round(s * 1e3)}", 1e-3),
    "microseconds": (lambda s, _: f"img{round(s * 1e6)}", 1e-6),
    "nanoseconds": (lambda s, _: f"{ns(s)}", 1e-6),
    "number and nanoseconds": (lambda s, k: f"{k:05d}_{ns(s)}", 1e-6),
    "PXL": (lambda s, _: f"PXL_{_date(s, '%Y%m%d_%H%M%S')}{_thousandths(s):03d}", 1e-3),
    "ISO": (lambda s, _: f"{_date(s, '%Y-%m-%dT%H-%M-%S')}.{_thousandths(s):03d}", 1e-3),
    "date and microseconds": (lambda s, _: f"{_date(s, '%Y-%m-%d_%H-%M-%S')}-{_thousandths(s) * 1000:06d}", 1e-3),
}
"""Names of images by stamp and number, and how exactly they say the stamp."""
NUMBERS: dict[str, NameForm] = {
    "numbers": lambda _, k: f"{k:06d}",
    "KITTI raw": lambda _, k: f"{k:010d}",
    "frame numbers": lambda _, k: f"frame{k}",
    "camera numbers": lambda _, k: f"DSC_{k + 17:04d}",
}
"""Names that only count."""
AMBIGUOUS_NAMES: dict[str, NameForm] = {
    "two stamps": lambda s, _: f"{ns(s)}_{ns(s) + 5}",
    "nanoseconds without zeros": lambda s, k: f"{int(s)}.{k % 10 * 10**8 + 7}",
}
"""Names with two readings."""
