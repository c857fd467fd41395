"""What a map is, in a few lines."""

import numpy as np

from flocc_agent.geometry import symmetric
from flocc_agent.runtime.map_folder import LensModel, MapFolder, MapManifest

CONTRADICTED_SHOWN = 10


def map_lines(opened: MapFolder) -> list[tuple[str, str]]:
    """Names and values, for `flocc map info`.

    Raises:
        BadMap: It is not whole.
    """
    opened.check_whole()
    manifest = opened.manifest
    return [*manifest_lines(manifest), ("uncertainty", _uncertainty(opened)), ("size", _size(manifest))]


def manifest_lines(manifest: MapManifest) -> list[tuple[str, str]]:
    """What its manifest alone says."""
    front_end = manifest.front_end
    made_with = f"{front_end.method or 'a program of its own'}, {front_end.model or 'model not known'}"
    pruned = ", pruned" if manifest.pruned else ""
    keyframes = sum(entry.keyframes for entry in manifest.logs)
    return [
        ("map", f"{manifest.name}, edition {manifest.edition}"),
        ("frame", manifest.frame),
        ("logs", f"{len(manifest.logs)}{' (signed)' if manifest.signed else ''}"),
        ("keyframes", f"{keyframes}, {manifest.latents} with a latent{pruned}"),
        ("closures", f"{manifest.closures} used"),
        ("front end", made_with),
        ("made by", f"flocc {manifest.made_by}{f', swarm {manifest.swarm}' if manifest.swarm else ''}"),
        *((f"log {entry.log}", f"{entry.keyframes} keyframes, {_lens(entry.camera)}") for entry in manifest.logs),
        *((f"left out {log}", reason) for log, reason in manifest.left_out.items()),
        *contradicted_lines(manifest),
    ]


def contradicted_lines(manifest: MapManifest) -> list[tuple[str, str]]:
    """Keyframes that several logs contradict, those of the most logs first."""
    most = sorted(manifest.contradicted.items(), key=lambda each: (-len(each[1]), each[0]))
    lines = [(f"contradicted {keyframe}", f"by {', '.join(logs)}") for keyframe, logs in most[:CONTRADICTED_SHOWN]]
    more = len(most) - len(lines)
    return lines + ([("contradicted", f"{more} keyframes more, in map.json")] if more else [])


def _lens(camera: LensModel | None) -> str:
    if camera is None:
        return "camera not known"
    degrees = np.degrees(2 * np.arctan(camera.view_ratio()))
    return f"{camera.width} x {camera.height} pixels, {degrees:.0f} degrees wide"


def positions_sigma_m(opened: MapFolder) -> tuple[float, float] | None:
    """Median and largest standard deviation of keyframes' positions, against the anchor's first; None: not known."""
    rows = np.concatenate(
        [rows for rows in opened.covariances().values() if len(rows)] or [np.zeros((0, 21), dtype=np.float32)]
    )
    known = rows[np.isfinite(rows).all(axis=1)]
    if not len(known):
        return None
    sigmas_m = [float(np.sqrt(np.linalg.eigvalsh(symmetric(row)[3:, 3:])[-1].clip(0))) for row in known]
    return float(np.median(sigmas_m)), max(sigmas_m)


def _uncertainty(opened: MapFolder) -> str:
    sigmas_m = positions_sigma_m(opened)
    if sigmas_m is None:
        return "not known"
    return f"positions to {sigmas_m[0]:.2f} m, at worst {sigmas_m[1]:.2f} m (one sigma, from the anchor)"


def _size(manifest: MapManifest) -> str:
    files = (manifest.records, manifest.solution, manifest.latent_file)
    return f"{sum(file.bytes for file in files) / 1e6:.1f} MB, of which latents {manifest.latent_file.bytes / 1e6:.1f}"
