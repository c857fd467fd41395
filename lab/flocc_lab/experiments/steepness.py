"""Write the k of Eq. (2) that the registration experiment learned into a deployment's configuration."""

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flocc_agent.config import ConfigError, read_json, read_toml
from flocc_lab.experiments.experiment import ExperimentError
from flocc_lab.experiments.folder import ExperimentFolder
from flocc_lab.experiments.logistic import LogisticFit
from flocc_lab.experiments.registration_quality import REGISTRATION, fit_of

TABLE = re.compile(r"^\s*\[")
BACKEND = re.compile(r"^\s*\[\s*backend\s*\]\s*(#.*)?$")
KEY = re.compile(r"^(\s*steepness\s*=\s*)[^#\n]*?(\s*(#.*)?)$")


@dataclass(frozen=True, slots=True)
class Learned:
    """What a finished registration experiment says of k.

    Attributes:
        steepness: k, rounded to what the data can tell.
        fit: Where it comes from.
    """

    steepness: float
    fit: LogisticFit


def learned(run: Path) -> Learned:
    """Fit k to the rows of a registration experiment.

    Raises:
        ExperimentError: It is another experiment, not finished, or its rows allow no k.
    """
    configuration = read_json(run / "config.json")
    if configuration.get("experiment") != REGISTRATION.name:
        raise ExperimentError(f"{run}: is no registration experiment, from which k could be learned")
    if configuration.get("state") != "finished":
        raise ExperimentError(f"{run}: the experiment is partial; finish it first with the same command")
    rows = ExperimentFolder(run, configuration).rows().values()
    fit = fit_of(row for row in rows if row["error"] is None)
    if fit is None:
        raise ExperimentError(f"{run}: has no inliers or no outliers, so Eq. (2) cannot be fitted")
    if fit.steepness is None:
        raise ExperimentError(
            f"{run}: no k > 0 fits: most inliers have a ratio below 1, where Eq. (2) gives less than one half; "
            "keep the configured steepness"
        )
    return Learned(float(f"{fit.steepness:.3g}"), fit)


def write_steepness(config: Path, steepness: float) -> None:
    """Put `backend.steepness` into a TOML file and leave everything else, comments too, as it is.

    Raises:
        ConfigError: The file cannot be read or written, or is written in a way that this does not understand.
    """
    before = read_toml(config)
    text = config.read_text(encoding="utf-8")
    after = with_steepness(text, steepness)
    if not _is_only_change(before, after, steepness):
        raise ConfigError(f"{config}: could not be changed safely; set steepness = {steepness:g} in [backend] by hand")
    partial = config.with_name(config.name + ".partial")
    try:
        partial.write_text(after, encoding="utf-8")
        partial.replace(config)
    except OSError as error:
        raise ConfigError(f"{config}: cannot be written: {error.strerror}") from error


def with_steepness(text: str, steepness: float) -> str:
    """The same TOML text with the key in its [backend], which is added where there is none."""
    lines = text.splitlines()
    header = next((k for k, line in enumerate(lines) if BACKEND.match(line)), None)
    if header is None:
        return "\n".join([*lines, "", "[backend]", f"steepness = {steepness:g}"]).lstrip("\n") + "\n"
    end = next((k for k in range(header + 1, len(lines)) if TABLE.match(lines[k])), len(lines))
    for k in range(header + 1, end):
        if KEY.match(lines[k]):
            lines[k] = KEY.sub(rf"\g<1>{steepness:g}\g<2>", lines[k])
            return "\n".join(lines) + "\n"
    return "\n".join([*lines[: header + 1], f"steepness = {steepness:g}", *lines[header + 1 :]]) + "\n"


def _is_only_change(before: dict[str, Any], after: str, steepness: float) -> bool:
    try:
        found = tomllib.loads(after)
    except tomllib.TOMLDecodeError:
        return False
    backend = before.get("backend", {})
    return isinstance(backend, dict) and found == {**before, "backend": {**backend, "steepness": steepness}}
