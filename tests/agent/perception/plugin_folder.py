"""What pip leaves of a package that brings a front end: a folder on the path with the package's dist-info."""

from pathlib import Path

METADATA = "Metadata-Version: 2.1\nName: plugin\nVersion: 1.0\n"


def install(folder: Path, name: str, builder: str) -> None:
    """Write the dist-info of a package 'plugin' whose module lies in the same folder.

    Args:
        folder: Where the module is; to be put on the path.
        name: What `perception.method` is to say.
        builder: MODULE:FUNCTION.
    """
    info = folder / "plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(METADATA)
    (info / "entry_points.txt").write_text(f"[flocc.perception]\n{name} = {builder}\n")
