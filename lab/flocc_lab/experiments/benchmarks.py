"""Where the experiments find a benchmark's files."""

from pathlib import Path

from flocc_lab.experiments.experiment import ExperimentError

COSMO = {"cosmo-wifi": "wifi", "cosmo-proradio": "proradio"}
"""Folders of cosmo_bench by the name of the source."""


def cosmo_file(data: Path, source: str) -> Path:
    """The file of one radio condition in a folder of shared data.

    Raises:
        ExperimentError: There is no such source or no file.
    """
    if source not in COSMO:
        raise ExperimentError(f"there is no source {source!r}; see --help")
    folder = data / "cosmo_bench" / COSMO[source]
    found = next(iter(sorted(folder.glob("*.jrl"))), None)
    if found is None:
        raise ExperimentError(f"{folder}: holds no .jrl file; give --data")
    return found
