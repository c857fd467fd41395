"""Pose graphs in files: g2o in and out, JRL in. `read_graph_file` picks the reader by the file's name."""

from pathlib import Path

from flocc_launch.graph_files.g2o import read_g2o, write_g2o
from flocc_launch.graph_files.graph_file import GraphFile, GraphFileError
from flocc_launch.graph_files.jrl import read_jrl

__all__ = ["GraphFile", "GraphFileError", "read_g2o", "read_graph_file", "read_jrl", "write_g2o"]


def read_graph_file(path: Path, isotropic: bool = False) -> GraphFile:
    """Read a .g2o file, a folder with one .g2o file per robot, or a .jrl file; with `isotropic` noise as in SE-Sync.

    Raises:
        GraphFileError: It is missing, of another kind or damaged; the message names the file and the line or key.
    """
    if path.is_dir() or path.suffix == ".g2o":
        return read_g2o(path, isotropic)
    if path.suffix == ".jrl":
        return read_jrl(path).with_isotropic_noise() if isotropic else read_jrl(path)
    raise GraphFileError(f"{path}: is neither a .g2o nor a .jrl file nor a folder of .g2o files")
