"""`python -m flocc_lab.bench.watched_cameras ../shared/data --towns 12`: what the watch over cameras names, and when.

Every drive is walked with the right camera, all of it, and with each fault for its first keyframes. A cell says after
how many keyframes the fault was named; `-` that it was not, and in brackets what was named instead. Anything that is
named where all is right is a false alarm. SIFT is done once per picture: faults of the calibration change rays only.
"""

import sys
import time
from argparse import ArgumentParser
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import ClassicalConfig
from flocc_agent.core.interfaces import Camera, Image, Perception
from flocc_agent.geometry import inverse, pose, so3_exp
from flocc_agent.perception.classical.encoder import encode_features
from flocc_agent.perception.classical.features import FeatureExtractor, Features
from flocc_agent.perception.classical.sift_registrar import classical_registrar
from flocc_agent.perception.multiview.picture import rays_of
from flocc_agent.perception.watch.camera_watch import CameraWatch
from flocc_lab.bench.drawn_overlays import overlay
from flocc_lab.bench.registration_scenes import SceneView
from flocc_lab.bench.watched_drives import Drive, drawn_drives, recorded_drives

Float = NDArray[np.float64]

WITHIN_KEYFRAMES = 20
"""A fault is to be named by then."""
WATCHED_KEYFRAMES = 40
"""Drives with a fault end here."""
TURNED_RAD = float(np.radians(5.0))
FACTORS = (0.5, 0.8, 0.9, 1.1, 1.25)
FROZEN_FROM = 4
OVERLAY_SEED = 99
OVERLAYS = ("bumper", "watermark", "clock")
SIDE_PX = 1000
"""Focal length of the camera, without centre and distortion, that cached features are kept for."""


@dataclass(frozen=True, slots=True)
class Trouble:
    """What is done to a drive.

    Attributes:
        name: For the table.
        doubt: What is to be named; empty: nothing.
        camera: What the calibration says, of the true camera.
        T_wrong_camera: (4, 4) the true camera in the one that the calibration says.
        is_mirrored: Whether pictures are turned left to right.
        overlay: What lies over the pictures, and on how much of them.
        amount: That is to be told; None: not looked at.
    """

    name: str
    doubt: str
    camera: Callable[[Camera], Camera] = lambda camera: camera
    T_wrong_camera: Float = field(default_factory=lambda: np.eye(4))
    is_mirrored: bool = False
    overlay: tuple[str, float] | None = None
    frozen_from: int | None = None
    amount: float | None = None


@dataclass(frozen=True, slots=True)
class WatchedDrive:
    """What came of one drive.

    Attributes:
        keyframes: How many were looked at.
        named: Of each doubt: its word, after how many keyframes, its amount.
        watch_ms: CPU per keyframe of the watch alone.
    """

    keyframes: int
    named: tuple[tuple[str, int, float], ...]
    watch_ms: float


def troubles() -> Iterator[Trouble]:
    """The right camera first, then what can be wrong."""
    yield Trouble("right", "")
    for factor in FACTORS:
        yield Trouble(f"f {factor:g}", "focal length", camera=zoomed(factor), amount=1.0 / factor)
    for axis, name in enumerate("xyz"):
        T = pose(so3_exp(TURNED_RAD * np.eye(3)[axis]), np.zeros(3))
        yield Trouble(f"5 deg {name}", "mounting", T_wrong_camera=T, amount=5.0)
    yield Trouble("mirrored", "mirrored", is_mirrored=True)
    yield Trouble("frozen", "frozen", frozen_from=FROZEN_FROM)
    for kind in OVERLAYS:
        for share in (0.1, 0.3, 0.5):
            yield Trouble(f"{kind} {100 * share:.0f} %", "overlay", overlay=(kind, share))


def zoomed(factor: float) -> Callable[[Camera], Camera]:
    """A calibration whose focal lengths are `factor` times the true ones."""
    return lambda camera: replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


class CachedFeatures:
    """SIFT features by picture and mask, as an encoder whose camera may be another one each time."""

    model = "classical/sift-2"

    def __init__(self) -> None:
        self._extractor = FeatureExtractor(ClassicalConfig())
        self._found: dict[bytes, Features] = {}
        self.cpu_s = 0.0

    def encode(self, image: Image) -> bytes:
        """The latent for this image's camera."""
        began_s = time.process_time()
        hidden = b"" if image.hidden is None else np.packbits(image.hidden).tobytes()
        key = image.pixels[::7, ::7].tobytes() + hidden
        if key not in self._found:
            self._found[key] = self._extractor.extract(replace(image, camera=_plain(image.camera)))
        latent = encode_features(_seen_by(image.camera, self._found[key]), {})
        self.cpu_s += time.process_time() - began_s
        return latent


def _plain(camera: Camera) -> Camera:
    """A camera of the same size whose rays are pixels of its picture, over a constant."""
    return Camera(camera.width, camera.height, SIDE_PX, SIDE_PX, 0.0, 0.0)


def _seen_by(camera: Camera, found: Features) -> Features:
    """Features of the plain camera as another camera of the same size says where they are."""
    pixels = found.points.astype(np.float64) * SIDE_PX
    points, _ = rays_of(pixels, (camera.width, camera.height), camera)
    focal_px = found.focal_px / SIDE_PX * 0.5 * (camera.fx + camera.fy)
    return Features(points.astype(np.float32), found.descriptors, focal_px)


class NoPlace:
    """A describer that says nothing: the watch does not ask for it."""

    dimension = 1

    def describe(self, image: Image) -> NDArray[np.float32]:  # noqa: ARG002
        """The same for all."""
        return np.ones(1, np.float32)


def watched(drive: Drive, trouble: Trouble, eyes: CachedFeatures) -> WatchedDrive:
    """Walk a drive with something wrong until that is named, or with nothing wrong to its end."""
    perception = Perception(NoPlace(), eyes, classical_registrar(ClassicalConfig()))
    watch = CameraWatch()
    named: list[tuple[str, int, float]] = []
    views = drive.views[:WATCHED_KEYFRAMES] if trouble.doubt else drive.views
    looks_s = 0.0
    for k, view in enumerate(views):
        image = troubled(views, k, trouble)
        before_s = time.process_time() - eyes.cpu_s
        look = watch.look(perception, image, view.T_odom_camera @ inverse(trouble.T_wrong_camera))
        looks_s += time.process_time() - eyes.cpu_s - before_s
        named += [(doubt.doubt, k + 1, doubt.amount) for doubt in look.doubts]
        if trouble.doubt and any(word == trouble.doubt for word, _, _ in named):
            views = views[: k + 1]
            break
    return WatchedDrive(len(views), tuple(named), 1e3 * looks_s / len(views))


def troubled(views: Sequence[SceneView], k: int, trouble: Trouble) -> Image:
    """The k-th picture as the agent gets it."""
    shown = k if trouble.frozen_from is None else min(k, trouble.frozen_from)
    pixels = views[shown].image().pixels
    if trouble.is_mirrored:
        pixels = np.ascontiguousarray(pixels[:, ::-1])
    if trouble.overlay is not None:
        kind, share = trouble.overlay
        pixels = overlay(kind, (pixels.shape[1], pixels.shape[0]), share, OVERLAY_SEED)(pixels, k)
    return Image(pixels, trouble.camera(views[k].camera))


def cell(found: WatchedDrive, trouble: Trouble) -> str:
    """What is said of one drive."""
    others = sorted({f"{word} at {k}" for word, k, _ in found.named if word != trouble.doubt})
    when = next((str(k) for word, k, _ in found.named if word == trouble.doubt), "" if not trouble.doubt else "-")
    return " ".join([when, *(f"[{other}]" for other in others)]).strip()


def summary(rows: Sequence[tuple[Drive, dict[str, WatchedDrive]]], tried: Sequence[Trouble]) -> Iterator[str]:
    """By recording: of each fault how often it was named in time, and how far the figure told was off."""
    yield "| recording | drives | keyframes | false alarms | " + " | ".join(t.name for t in tried if t.doubt) + " |"
    yield "| --- " * (4 + sum(bool(t.doubt) for t in tried)) + "|"
    groups = [(name, list(group)) for name, group in groupby(rows, key=lambda row: row[0].recording.split()[0])]
    for name, group in [*groups, ("all", list(rows))]:
        right = [found["right"] for _, found in group]
        cells = [str(len(group)), str(sum(w.keyframes for w in right)), str(sum(len(w.named) for w in right))]
        cells += [counted([found[t.name] for _, found in group], t) for t in tried if t.doubt]
        yield f"| {name} | " + " | ".join(cells) + " |"


def counted(found: Sequence[WatchedDrive], trouble: Trouble) -> str:
    """Named within the limit, later, wrongly."""
    hits = [next((k for word, k, _ in one.named if word == trouble.doubt), None) for one in found]
    in_time = sum(k is not None and k <= WITHIN_KEYFRAMES for k in hits)
    late = sum(k is not None and k > WITHIN_KEYFRAMES for k in hits)
    other = sum(any(word != trouble.doubt for word, _, _ in one.named) for one in found)
    return f"{in_time}" + (f" + {late} late" if late else "") + (f", {other} otherwise" if other else "")


def amounts(rows: Sequence[tuple[Drive, dict[str, WatchedDrive]]], tried: Sequence[Trouble]) -> Iterator[str]:
    """How far the figures that were told first are off, at the median and at most."""
    for trouble in (t for t in tried if t.amount is not None):
        told = [
            abs(amount / trouble.amount - 1.0)
            for _, found in rows
            for word, _, amount in found[trouble.name].named[:1]
            if word == trouble.doubt and trouble.amount is not None
        ]
        if told:
            yield f"{trouble.name}: off by {100 * np.median(told):.1f} % at the median, {100 * max(told):.1f} % at most"


def report(drives: Iterable[Drive]) -> Iterator[str]:
    """All lines, a drive's as soon as it is walked."""
    tried = list(troubles())
    yield "| drive | keyframes | right | " + " | ".join(t.name for t in tried[1:]) + " | watch, CPU ms |"
    yield "| --- " * (3 + len(tried)) + "|"
    rows = []
    for drive in drives:
        eyes = CachedFeatures()
        found = {trouble.name: watched(drive, trouble, eyes) for trouble in tried}
        rows.append((drive, found))
        cells = [cell(found[t.name], t) for t in tried]
        head = f"| {drive.recording} {drive.robot} | {len(drive.views)} | "
        yield head + " | ".join(cells) + f" | {found['right'].watch_ms:.0f} |"
    yield ""
    yield from summary(rows, tried)
    yield ""
    yield from amounts(rows, tried)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("shared", type=Path)
    parser.add_argument("--towns", type=int, default=12)
    parser.add_argument("--first-seed", type=int, default=1601)
    parser.add_argument("--cache", type=Path, default=Path.home() / ".cache" / "flocc" / "watched-towns")
    parser.add_argument("--only", default="", help="recordings whose name contains this")
    given = parser.parse_args(arguments)
    seeds = range(given.first_seed, given.first_seed + given.towns)
    drives = chain(recorded_drives(given.shared), drawn_drives(seeds, given.cache))
    for line in report(drive for drive in drives if given.only in drive.recording):
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
