"""`flocc map save`: a mission's stores to a map, or to the next edition of the map in which it took place."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import BackendConfig, validated
from flocc_agent.runtime.map_folder import BadMap, MapFolder, MapFrontEnd, MapManifest, longer_copy
from flocc_launch.maps.gathering import Gathered, Logs, Optics, gathered
from flocc_launch.maps.map_page import map_page
from flocc_launch.maps.solving import NotSolved, SolvedMap, solved_map
from flocc_launch.maps.thumbnails import thumbnails
from flocc_launch.maps.writing import PAGE, MapContent, check_target, write_map
from flocc_launch.runs.run_folder import RunFolder
from flocc_protocol.ids import KeyframeId, LogId


def save_map(
    where: Path, out: Path, name: str | None = None, frame: str | None = None, sees_alike: bool = True
) -> MapManifest:
    """Save the map of a run, or of one agent's folder.

    Args:
        where: Run folder, agent's folder or store; nothing in it is changed, and its robots may still run.
        out: Folder of the map; a map that stands there is replaced in one step.
        name: For people; None: that of the folder.
        frame: Which frame of several to keep, such as `map/r1`; None: the largest, or the opened map's.
        sees_alike: The front end that the stores name made what is in them.

    Raises:
        FloccError: There are no stores, they contradict each other, nothing can be solved, or `out` cannot be written.
    """
    check_target(out)
    found = gathered(where, _recordings(where))
    found = found if sees_alike else replace(found, front_end=MapFrontEnd())
    earlier = None if found.used is None else _earlier(found, out)
    logs = found.logs if earlier is None else _with(earlier, found.logs)
    saved = None if earlier is None or found.used is None else earlier.saved(found.used.is_fixed)
    back_end = found.back_end if earlier is None else back_end_of(earlier)
    solved = solved_map(str(where), logs, saved, frame, back_end)
    if earlier is not None:
        solved = _kept_covariances(_checked_news(solved, earlier, where), earlier)
    solved = replace(solved, left_out={**solved.left_out, **_without_log(where, logs)})
    content = MapContent(
        name=name or (out.name if earlier is None else earlier.manifest.name),
        logs=logs,
        solved=solved,
        front_end=found.front_end if earlier is None else earlier.manifest.front_end,
        optics={**({} if earlier is None else optics_of(earlier)), **found.optics},
        latents=chain(() if earlier is None else latents_of(earlier), found.latents()),
        back_end=back_end,
        edition=1 if earlier is None else earlier.manifest.edition + 1,
        swarm=_swarm(where),
        pruned=earlier is not None and earlier.manifest.pruned,
        page=lambda manifest: map_page(manifest, solved, thumbnails(found.recordings, logs)),
    )
    return write_map(out, content)


def copy_map(opened: MapFolder, out: Path) -> MapManifest:
    """Write a map once more elsewhere, in one step; its page and thumbnails are those that it has.

    Raises:
        BadMap: It is damaged, or `out` cannot be written.
    """
    opened.check_whole()
    manifest = opened.manifest
    page = opened.path / PAGE
    content = MapContent(
        name=manifest.name,
        logs=opened.records,
        solved=SolvedMap(opened.saved(), opened.covariances(), {}, contradicted=opened.manifest.contradicted),
        front_end=manifest.front_end,
        optics=optics_of(opened),
        latents=latents_of(opened),
        back_end=back_end_of(opened),
        edition=manifest.edition,
        swarm=manifest.swarm,
        pruned=manifest.pruned,
        page=(lambda _: page.read_text(encoding="utf-8")) if page.is_file() else None,
    )
    return write_map(out, content)


def back_end_of(opened: MapFolder) -> BackendConfig:
    """How a map was solved.

    Raises:
        ConfigError: This version does not know one of its settings.
    """
    return validated(BackendConfig, opened.manifest.back_end, f"{opened.path}: back end")


def optics_of(opened: MapFolder) -> dict[LogId, Optics]:
    """Cameras of a map's logs."""
    return {entry.id: Optics(entry.camera, entry.T_body_camera) for entry in opened.manifest.logs}


def latents_of(opened: MapFolder) -> Iterator[tuple[KeyframeId, bytes, bytes]]:
    """All latents of a map that are sound."""
    import hashlib

    for keyframe in opened.latent_keyframes():
        data = opened.latent(keyframe)
        if data is not None:
            yield keyframe, hashlib.sha256(data).digest(), data


def _earlier(found: Gathered, out: Path) -> MapFolder:
    """The map in which a mission took place."""
    assert found.used is not None
    path = Path(found.used.path)
    check_target(out, path)
    opened = MapFolder.open(path)
    opened.check_whole()
    if opened.manifest.frame != found.used.frame:
        raise BadMap(f"{path}: is of {opened.manifest.frame}, and {found.where} worked in {found.used.frame}")
    return opened


def _with(earlier: MapFolder, logs: Logs) -> dict[LogId, tuple[bytes, ...]]:
    """The logs of a map and of a mission in it."""
    joined = dict(earlier.records)
    for log, records in logs.items():
        copy = longer_copy(joined.get(log, ()), records)
        if copy is None:
            raise BadMap(f"{earlier.path}: holds another log {log} than the mission in it")
        joined[log] = copy
    return joined


def _checked_news(solved: SolvedMap, earlier: MapFolder, where: Path) -> SolvedMap:
    """The same, unless no robot of the mission found itself in the map."""
    if not set(solved.saved.logs) - set(earlier.poses()):
        raise NotSolved(f"{where}: none of its robots found itself in {earlier.path} ({earlier.manifest.frame})")
    return solved


def _kept_covariances(solved: SolvedMap, earlier: MapFolder) -> SolvedMap:
    """Of a map that did not move, the covariances that it had."""
    known = earlier.covariances()
    kept: dict[LogId, NDArray[np.float32]] = dict(solved.covariances)
    for log, rows in kept.items():
        if log in known and len(known[log]) == len(rows) and bool(np.isnan(rows).all()):
            kept[log] = known[log]
    return replace(solved, covariances=kept)


def _recordings(where: Path) -> Mapping[str, Path]:
    if not (where / "run.json").is_file():
        return {}
    folder = RunFolder.open(where)
    found = {robot: folder.recording(robot) for robot in folder.run().robots}
    return {robot: path for robot, path in found.items() if path is not None}


def _without_log(where: Path, logs: Logs) -> dict[LogId, str]:
    """Robots of a run of which no store holds a log: their folders are gone, or they never began."""
    if not (where / "run.json").is_file():
        return {}
    run = RunFolder.open(where).run()
    known = {log.robot for log in logs}
    return {LogId(name): "left no log in any store" for name in run.robots if name not in {*known, *run.servers}}


def _swarm(where: Path) -> str | None:
    return RunFolder.open(where).run().scenario if (where / "run.json").is_file() else None
