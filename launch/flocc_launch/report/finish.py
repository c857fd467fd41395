"""Finish a run folder: everything that is computed from what the drivers left in it."""

from pathlib import Path

from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_launch.report.album import Progress, album_of
from flocc_launch.report.build import build
from flocc_launch.report.html import write_html
from flocc_launch.report.model import SCHEMA_VERSION, RunReport
from flocc_launch.report.run_graph import write_pose_graph
from flocc_launch.report.shown_pairs import PAIRS_SHOWN
from flocc_launch.runs.ground_truth import write_truth
from flocc_launch.runs.loaded_run import LoadedRun, load
from flocc_launch.runs.run_folder import RunFolder, RunFolderError, read_record, write_json
from flocc_launch.runs.tracks import Float, Mask


def finish(folder: RunFolder, pairs_max: int = PAIRS_SHOWN, progress: Progress | None = None) -> RunReport:
    """Write trajectories, pose graph, report.json and report.html; doing it again gives the same files.

    Args:
        folder: The run.
        pairs_max: Pairs of keyframes that report.html shows as pictures.
        progress: Called with (done, all) while pictures are looked at.

    Raises:
        RunFolderError: The folder is cut off or damaged.
    """
    folder.refuse_links()
    loaded = load(folder)
    report = build(loaded)
    write_trajectories(folder.path, loaded)
    write_pose_graph(folder.path / "pose_graph.g2o", loaded)
    write_json(folder.path / "report.json", report.model_dump(mode="json"))
    write_html(folder.path / "report.html", report, loaded, album_of(folder, loaded, pairs_max, progress))
    return report


def read_report(path: Path) -> RunReport:
    """Read a `report.json`.

    Raises:
        RunFolderError: It is missing, cut off, or of another schema version.
    """
    report = read_record(path, RunReport)
    if report.schema_version != SCHEMA_VERSION:
        raise RunFolderError(f"{path}: has schema version {report.schema_version}, this flocc reads {SCHEMA_VERSION}")
    return report


def write_trajectories(path: Path, loaded: LoadedRun) -> None:
    """Write the .tum files of every robot; a file without any pose is not written, nor a truth that a person gave."""
    for robot, track in loaded.tracks.items():
        everything = track.stamps_s == track.stamps_s
        write_poses(path / "odometry" / f"{robot}.tum", track.stamps_s, track.T_odom_body, everything)
        write_poses(path / "trajectories" / f"{robot}.tum", track.stamps_s, track.T_map_body, track.corrected)
        truth = Trajectory(track.stamps_s[track.true], track.T_world_body[track.true])
        write_truth(path / "groundtruth" / f"{robot}.tum", truth)


def write_poses(path: Path, stamps_s: Float, poses: Float, chosen: Mask) -> None:
    """Write the chosen poses, if any."""
    if chosen.any():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_tum(path, Trajectory(stamps_s[chosen], poses[chosen]))
