"""Data sets and files that flocc knows but does not read: recognised by what they are called, refused by name.

Each sentence says what to convert. Nothing here is opened but to look whether it is there.
"""

from pathlib import Path

from flocc_agent.runtime.text_tables import RecordingError
from flocc_agent.runtime.trajectory_text import read_poses

FOLDERS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("ScanNet, exported", ("color", "pose", "intrinsic"), "put color/ into images/ and make groundtruth.tum of pose/"),
    ("TartanAir", ("image_left", "pose_left.txt"), "make groundtruth.tum of pose_left.txt, which is in NED axes"),
    ("Oxford RobotCar", ("stereo", "stereo.timestamps"), "demosaic stereo/ into images/, and make odometry.tum of vo/"),
    ("nuScenes", ("samples", "sweeps"), "export one camera's images and ego poses as a plain folder"),
    ("4Seasons", ("undistorted_images", "KeyFrameData"), "make odometry.tum of result.txt beside the images of cam0"),
    ("NCLT", ("lb3",), "undistort one camera of lb3/ into images/ named by microseconds"),
    ("Stray Scanner's export", ("rgb.mp4", "odometry.csv"), "cut rgb.mp4 into images named by odometry.csv"),
    ("Polycam's raw export", ("keyframes", "mesh_info.json"), "make transforms.json of it: ns-process-data polycam"),
    ("ADVIO", ("iphone", "ground-truth"), "cut iphone/frames.mov into images named by iphone/frames.csv"),
    ("Argoverse", ("sensors", "city_SE3_egovehicle.feather"), "export one camera's images and poses as a plain folder"),
    ("an ASL sequence's parent", ("calibration", "state_groundtruth_estimate0"), "name the folder that holds mav0"),
    ("ARKitScenes", ("lowres_wide", "lowres_wide.traj"),
     "make groundtruth.tum of lowres_wide.traj and camera.yaml of a .pincam"),
    ("a NeRF scene of Blender", ("transforms_train.json",),
     "write transforms.json with w, h and fl_x, of the frames of one path"),
    ("ScanNet of 2023, of an iPhone", ("pose_intrinsic_imu.json",),
     "make groundtruth.tum and camera.yaml of pose_intrinsic_imu.json"),
    ("ICL-NUIM", ("associations.txt", "traj0.gt.freiburg"),
     "write rgb.txt of associations.txt and groundtruth.txt of traj0"),
    ("Virtual KITTI 2", ("extrinsic.txt", "intrinsic.txt"),
     "make groundtruth.tum of extrinsic.txt, which is world to camera"),
    ("Spectacular AI's recording", ("data.jsonl", "calibration.json"),
     "make odometry.tum of the output, and name frames/ by stamps"),
    ("Record3D's export", ("metadata.json", "rgb"), "make transforms.json of it: ns-process-data record3d"),
    ("Polycam's images", ("keyframes/images",), "make transforms.json of them: ns-process-data polycam"),
    ("Polycam's corrected images", ("keyframes/corrected_images",),
     "make transforms.json of them: ns-process-data polycam"),
    ("Open3D's reconstruction", ("trajectory.log",),
     "make groundtruth.tum of trajectory.log, which is the camera in the world, beside images named by their stamps"),
    ("RTAB-Map's export with a prefix", ("rtabmap_rgb",),
     "call rtabmap_rgb rgb and rtabmap_poses.txt poses.txt, and put one file of rtabmap_calib there as camera.yaml"),
    ("TUM-VI's folder for DSO", ("camchain.yaml", "imu.txt", "cam0"), "name the folder above it, which holds mav0"),
    ("a KITTI-360 sequence", ("data_2d_raw",), "name images by stamps and make groundtruth.tum of data_poses/"),
    ("OpenSfM's reconstruction", ("reconstruction.json",),
     "write COLMAP's text form of it: opensfm export_colmap"),
    ("a project of ODM", ("opensfm/reconstruction.json",),
     "write COLMAP's text form of opensfm/: opensfm export_colmap"),
    ("Meshroom's reconstruction", ("cameras.sfm",),
     "write COLMAP's text form of it: aliceVision_exportColmap"),
    ("Metashape's export", ("cameras.xml",),
     "write COLMAP's text form of it: File, Export, Export Cameras"),
    ("Bundler's reconstruction", ("bundle.out",),
     "write COLMAP's text form of it"),
    ("a scene of ScanNet of 2023", ("dslr", "iphone"),
     "put one of its nerfstudio/transforms.json beside its images"),
    ("TartanAir V2", ("pose_lcam_front.txt",),
     "make groundtruth.tum of pose_lcam_front.txt, which is in NED axes, beside the images"),
    ("3D Scanner App's export", ("frame_00000.jpg", "frame_00000.json"),
     "make transforms.json of the frames' cameraPoseARFrame"),
    ("kapture", ("sensors/sensors.txt",), "write COLMAP's text form of it: kapture_export_colmap.py"),
    ("OpenMVG's reconstruction", ("sfm_data.json",), "write COLMAP's text form of it: openMVG_main_openMVG2Colmap"),
    ("a trained splat", ("cameras.json", "cfg_args"), "give the COLMAP model and the images that it was trained on"),
    ("OpenLORIS", ("color.txt", "sensors.yaml"),
     "call color.txt rgb.txt, and write camera.yaml of the colour camera in sensors.yaml"),
    ("UZH-FPV", ("img", "left_images.txt"),
     "write images.txt of the stamps and names in left_images.txt, and camera.yaml of the calibration"),
)  # fmt: skip
FILES: dict[str, tuple[str, str]] = {
    ".zip": ("an archive", "unpack it"),
    ".tar": ("an archive", "unpack it"),
    ".gz": ("an archive", "unpack it"),
    ".tgz": ("an archive", "unpack it"),
    ".7z": ("an archive", "unpack it"),
    ".xz": ("an archive", "unpack it"),
    ".bz2": ("an archive", "unpack it"),
    ".zst": ("an archive", "unpack it"),
    ".zstd": ("an archive", "unpack it"),
    ".rar": ("an archive", "unpack it"),
    ".active": (
        "a bag whose recorder was killed",
        "rosbag reindex it and rosbag fix it, or call it .bag to read its front",
    ),
    ".ulg": (
        "a log of PX4, which has no pictures",
        "ulog2csv makes vehicle_odometry_0.csv of it, to go with --odometry",
    ),
    ".tlog": ("a log of MAVLink, which has no pictures", "make a trajectory of it that goes with --odometry"),
    ".vrs": ("a recording of Project Aria", "vrs extract-images gives its images, to be named by their stamps"),
    ".aedat": ("a recording of an event camera", "make pictures of its events"),
    ".aedat4": ("a recording of an event camera", "make pictures of its events, or extract its frames"),
    ".h264": ("a raw video stream", "put it into a container: ffmpeg -i IN -c copy OUT.mp4"),
    ".h265": ("a raw video stream", "put it into a container: ffmpeg -i IN -c copy OUT.mp4"),
    ".hevc": ("a raw video stream", "put it into a container: ffmpeg -i IN -c copy OUT.mp4"),
    ".insv": ("a video of a 360 degree camera", "export one flat view of it as MP4"),
    ".360": ("a video of a 360 degree camera", "export one flat view of it as MP4"),
    ".r3d": (
        "a capture of Record3D",
        "export it as images with metadata, and make transforms.json: ns-process-data record3d",
    ),
    ".lcm": ("a log of LCM", "export its images and poses as a plain folder"),
    ".parquet": ("a table of Parquet", "write its poses as CSV, beside the images"),
    ".sens": ("ScanNet's recording", "export it with ScanNet's SensReader"),
    ".svo": ("ZED's recording", "export it with ZED_SVO_Export"),
    ".svo2": ("ZED's recording", "export it with ZED_SVO_Export"),
    ".klg": ("Kintinuous' log", "export its images and name them by stamps"),
    ".oni": ("OpenNI's recording", "export its images and name them by stamps"),
    ".db": ("RTAB-Map's database", "export images and poses in RTAB-Map, or rtabmap-export --images --poses"),
    ".tfrecord": ("Waymo's recording", "export one camera's images and poses as a plain folder"),
    ".h5": ("an HDF5 file", "export its images and poses as a plain folder"),
    ".hdf5": ("an HDF5 file", "export its images and poses as a plain folder"),
    ".rrd": ("a recording of Rerun", "give the data that it shows"),
    ".pcap": ("a capture of network packets", "give a bag with images"),
    ".ply": ("a point cloud", "give images and a trajectory"),
    ".pcd": ("a point cloud", "give images and a trajectory"),
    ".las": ("a point cloud", "give images and a trajectory"),
    ".laz": ("a point cloud", "give images and a trajectory"),
    ".e57": ("a point cloud", "give images and a trajectory"),
    ".obj": ("a model of a surface", "give the images and poses that it was made of"),
    ".glb": ("a model of a surface", "give the images and poses that it was made of"),
    ".usdz": ("a model of a surface", "give the images and poses that it was made of"),
    ".npz": ("arrays of numpy", "write images and a trajectory as files"),
    ".npy": ("arrays of numpy", "write images and a trajectory as files"),
}
SUFFIX_GLOBS = (".sens", ".svo", ".svo2", ".klg", ".oni", ".db", ".tfrecord")


TRAJECTORIES = (".tum", ".txt", ".csv")
GRAPHS = (".g2o", ".jrl")
GRAPH = (
    "is a pose graph, which has no images: flocc optimise FILE --out DIR solves it, and flocc dataset graph FILE makes "
    "a scenario of a .jrl of several robots"
)
WITH_IMAGES = (
    "flocc needs the images, too: put it into a folder as odometry.tum (or groundtruth.tum), beside images/ and "
    "camera.yaml; evo compares trajectories alone"
)
TRACKS_MAX = 20


def is_trajectory(path: Path) -> bool:
    """Whether a text holds poses."""
    try:
        return len(read_poses(path).lines) > 0
    except RecordingError:
        return False


def marked_kind(path: Path) -> str | None:
    """What a folder is by the files that mark a data set of a kind, and what to convert, or None."""
    for name, markers, advice in FOLDERS:
        if all((path / marker).exists() for marker in markers):
            return f"is {name}, which flocc does not read; {advice}"
    return None


def kind_of_folder(path: Path) -> str | None:
    """What a folder is and what to convert, or None where it is no kind that is known."""
    if (marked := marked_kind(path)) is not None:
        return marked
    files = [entry for entry in sorted(path.iterdir()) if entry.is_file()]
    graphs = [file.name for file in files if file.suffix.lower() in GRAPHS]
    if graphs:
        return f"holds {', '.join(graphs[:4])}: {GRAPH.replace('is a', 'a', 1)}"
    texts = [file for file in files[:TRACKS_MAX] if file.suffix.lower() in TRAJECTORIES]
    tracks = [file.name for file in texts if is_trajectory(file)]
    if tracks and len(tracks) == len(files):
        return f"holds trajectories only ({', '.join(tracks[:4])}); {WITH_IMAGES}"
    inside = next((file for suffix in SUFFIX_GLOBS for file in sorted(path.glob(f"*{suffix}"))), None)
    return None if inside is None else f"holds {inside.name}: {kind_of_file(inside)}"


def kind_of_file(path: Path) -> str | None:
    """What a file is and what to do with it, or None where it is no kind that is known."""
    if path.suffix.lower() in GRAPHS:
        return GRAPH
    if path.suffix.lower() in TRAJECTORIES and path.is_file() and is_trajectory(path):
        return f"is a trajectory; {WITH_IMAGES}"
    found = FILES.get(path.suffix.lower())
    return None if found is None else f"is {found[0]}, which flocc does not read; {found[1]}"
