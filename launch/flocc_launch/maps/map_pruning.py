"""`flocc map prune`: the fewest latents that keep what the map can recognise.

Records stay: they are the logs. A keyframe gives up its latent, and is no candidate any more, where another one that is
kept was taken near it, looks the same way and looks alike. Kept are, of each place, those that stand for the most
others; of equals the one that looks least like the rest of the map.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.runtime.map_folder import MapFolder, MapManifest
from flocc_launch.maps.map_merging import described
from flocc_launch.maps.map_page import map_page
from flocc_launch.maps.map_saving import back_end_of, latents_of, optics_of
from flocc_launch.maps.solving import SolvedMap
from flocc_launch.maps.writing import MapContent, check_target, write_map
from flocc_protocol.ids import KeyframeId

Float = NDArray[np.float64]

ALIKE_RATIO = 0.5
"""How similar a keyframe must be to the one that stands for it, between what any two are and what neighbours are."""


def prune_map(folder: Path, out: Path, place_m: float, place_deg: float) -> MapManifest:
    """Write a map with fewer latents.

    Args:
        folder: The map; it stays as it is.
        out: Folder of the new one.
        place_m: How far from a kept keyframe another one may be that it stands for.
        place_deg: How far it may look away from it.

    Raises:
        FloccError: It is no map, or `out` cannot be written.
    """
    check_target(out, folder)
    opened = MapFolder.open(folder)
    opened.check_whole()
    kept = set(kept_keyframes(opened, place_m, np.radians(place_deg)))
    manifest = opened.manifest
    solved = SolvedMap(opened.saved(), opened.covariances(), {}, contradicted=opened.manifest.contradicted)
    content = MapContent(
        name=manifest.name,
        logs=opened.records,
        solved=solved,
        front_end=manifest.front_end,
        optics=optics_of(opened),
        latents=(each for each in latents_of(opened) if each[0] in kept),
        back_end=back_end_of(opened),
        edition=manifest.edition + 1,
        swarm=manifest.swarm,
        pruned=True,
        page=_page(solved),
    )
    return write_map(out, content)


def _page(solved: SolvedMap) -> Callable[[MapManifest], str]:
    return lambda manifest: map_page(manifest, replace(solved), ())


def kept_keyframes(opened: MapFolder, place_m: float, place_rad: float) -> list[KeyframeId]:
    """Keyframes that stand for all others, as few as a greedy choice finds."""
    keyframes, rows = described(opened)
    poses = opened.poses()
    posed = [n for n, k in enumerate(keyframes) if k.log in poses and k.index < len(poses[k.log])]
    keyframes, rows = [keyframes[n] for n in posed], rows[posed]
    if not keyframes:
        return []
    T = np.array([poses[k.log][k.index] for k in keyframes])
    covered_by = _neighbourhoods(T, rows, place_m, place_rad)
    distinct = -(rows @ rows.mean(axis=0))
    uncovered = np.ones(len(keyframes), dtype=bool)
    gains = np.array([len(near) for near in covered_by])
    kept = []
    while uncovered.any():
        best = int(np.lexsort((-distinct, -gains))[0])
        kept.append(best)
        newly = [n for n in covered_by[best] if uncovered[n]]
        uncovered[newly] = False
        for n in newly:
            for other in covered_by[n]:
                gains[other] -= 1
    return sorted(keyframes[n] for n in kept)


def _neighbourhoods(T: Float, rows: NDArray[np.float32], place_m: float, place_rad: float) -> list[list[int]]:
    """Of each keyframe those that are near, look the same way and look alike, itself among them; symmetric."""
    from scipy.spatial import cKDTree

    near = cKDTree(T[:, :3, 3]).query_ball_point(T[:, :3, 3], place_m)
    alike_min = _alike_min(rows)
    found = []
    for n, others in enumerate(near):
        cosine = 0.5 * (np.einsum("kij,ij->k", T[others, :3, :3], T[n, :3, :3]) - 1.0)
        turned = np.arccos(np.clip(cosine, -1.0, 1.0))
        alike = rows[others] @ rows[n] >= alike_min
        fits = [other for other, ok in zip(others, (turned <= place_rad) & alike, strict=True) if ok]
        found.append(fits if n in fits else [*fits, n])
    return found


def _alike_min(rows: NDArray[np.float32]) -> float:
    """Half the way from how alike any two keyframes are to how alike neighbours in a log are."""
    if len(rows) < 3:
        return -1.0
    neighbours = float(np.median(np.einsum("nd,nd->n", rows[:-1], rows[1:])))
    centre = rows.mean(axis=0)
    anywhere = float(centre @ centre)
    return anywhere + ALIKE_RATIO * (neighbours - anywhere)
