"""Writes a recording (the plain folder that an agent reads) image by image, and takes up one that was cut short.

An image is complete before its line stands in `images.txt`, so whatever ends the work leaves a recording of what was
written so far.
"""

import os
import shutil
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera
from flocc_agent.runtime.pictures import PictureError
from flocc_agent.runtime.recording import MASK, read_mask, write_camera
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_launch.datasets.files import perhaps_cameras
from flocc_launch.datasets.pixels import ImageWriter, encoded_image, read_bytes
from flocc_launch.datasets.source import DatasetError, Lens, Source

Float = NDArray[np.float64]
Progress = Callable[[int, int], None]

PENDING_MAX = 8
BATCH_BYTES, BATCH_IMAGES = 1 << 20, 32
"""Small images are handed to the thread that writes them so many at a time: a hand-over costs as much as a file."""
LINES_MAX = 1000
"""Poses that are kept before they are written."""
Entry = tuple[str, bytes, str]
"""Name of an image's file, its bytes, and its line."""


class RecordingWriter:
    """Appends images to a recording; the trajectories and the camera are written whole.

    Attributes:
        path: The folder.
        count: Images that it holds.
        last_stamp_s: The latest stamp, or None; a resumed conversion goes on after it.
    """

    def __init__(self, path: Path, identity: str) -> None:
        """Open a recording for writing, or go on with it.

        Args:
            path: The folder; made where it is missing.
            identity: What is written, one line; a folder with another identity is not touched.

        Raises:
            DatasetError: The folder holds another recording, or anything else.
        """
        self.path = path
        _claim(path / "source.txt", identity)
        (path / "images").mkdir(exist_ok=True)
        self.count = 0
        self.last_stamp_s: float | None = None
        self._is_sorted = True
        listing = path / "images.txt"
        if listing.exists():
            os.truncate(listing, self._take_up(listing))
        self._file = listing.open("a", encoding="utf-8")
        self._thread = ThreadPoolExecutor(1)
        self._pending: deque[Future[None]] = deque()
        self._batch: list[Entry] = []
        self._batch_bytes = 0

    def __enter__(self) -> "RecordingWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.flush()
        finally:
            self._thread.shutdown()
            self._file.close()

    def flush(self) -> None:
        """Wait until every image that was added stands in the recording, also for whoever comes after a `kill -9`."""
        self._hand_over()
        while self._pending:
            self._pending.popleft().result()

    def _hand_over(self) -> None:
        """Let the thread write the images that have come together."""
        if self._batch:
            self._pending.append(self._thread.submit(self._write, self._batch))
        self._batch, self._batch_bytes = [], 0

    def _write(self, batch: list[Entry]) -> None:
        for name, encoded, _ in batch:
            _write(f"{self.path}/{name}", encoded)
        self._file.write("".join(line for _, _, line in batch))
        self._file.flush()

    def add(self, stamp_s: float, encoded: bytes, suffix: str) -> None:
        """Append one encoded image. A thread writes it while the next one is read; `sort` ends what came out of order.

        Args:
            stamp_s: When it was taken, seconds.
            encoded: The image file's bytes.
            suffix: Of its name, with the dot.
        """
        while len(self._pending) >= PENDING_MAX:
            self._pending.popleft().result()
        name = f"images/{self.count:06d}{suffix}"
        self._batch.append((name, encoded, f"{stamp_s:.9f} {name}\n"))
        self._batch_bytes += len(encoded)
        if self._batch_bytes >= BATCH_BYTES or len(self._batch) >= BATCH_IMAGES:
            self._hand_over()
        self._count(stamp_s)

    def _count(self, stamp_s: float) -> None:
        self.count += 1
        if self.last_stamp_s is None or stamp_s > self.last_stamp_s:
            self.last_stamp_s = stamp_s
        else:
            self._is_sorted = False

    def sort(self) -> None:
        """Bring the lines of `images.txt` into the order of stamps, where images came in another one."""
        self.flush()
        if not self._is_sorted:
            listing, partial = self.path / "images.txt", self.path / "images.part"
            lines = listing.read_text(encoding="utf-8").splitlines(keepends=True)
            partial.write_text("".join(sorted(lines, key=lambda line: float(line.split(" ", 1)[0]))), encoding="utf-8")
            partial.replace(listing)

    def write_lens(self, lens: Lens) -> None:
        """Write `camera.toml` of a lens that an agent's camera can say."""
        camera = lens.camera.agent_camera()
        assert camera is not None
        self.write_camera(camera, lens.T_body_camera)

    def write_camera(self, camera: Camera, T_body_camera: Float) -> None:
        """Write `camera.toml`."""
        write_camera(self.path / "camera.toml", camera, T_body_camera)

    def write_trajectories(self, odometry: Trajectory | None, truth: Trajectory | None) -> None:
        """Write `odometry.tum` and `groundtruth.tum`, as far as there are any."""
        if odometry is not None:
            write_tum(self.path / "odometry.tum", odometry)
        if truth is not None:
            write_tum(self.path / "groundtruth.tum", truth)

    def _take_up(self, listing: Path) -> int:
        """Count the images that are there already; returns the bytes of their lines."""
        kept = 0
        with listing.open("rb") as lines:
            for line in lines:
                stamp, _, name = line.decode().partition(" ")
                if not line.endswith(b"\n") or not (self.path / name.strip()).is_file():
                    break
                kept += len(line)
                self._count(float(stamp))
        return kept


class PoseWriter:
    """Appends poses to a TUM file as they come, and takes up one that was cut short.

    `finish` makes the trajectory, and counts stamps from another zero where it is asked to.

    Attributes:
        last_ns: Stamp of the last pose, or -1.
    """

    def __init__(self, path: Path, wanted: bool) -> None:
        self._path = path
        self._partial = path.with_suffix(".part")
        self._wanted = wanted
        self._lines: list[str] = []
        self.last_ns = -1
        if wanted and path.exists() and not self._partial.exists():
            path.unlink()
        if wanted and self._partial.exists():
            self._take_up()

    def __enter__(self) -> "PoseWriter":
        if self._wanted:
            self._file = self._partial.open("a", encoding="ascii")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._wanted and not self._file.closed:
            try:
                self.flush()
            finally:
                self._file.close()

    def add(self, stamp_ns: int, numbers: tuple[float, ...]) -> bool:
        """Append `tx ty tz qx qy qz qw`; one that is before the last one is left out, and the return value False."""
        if stamp_ns > self.last_ns:
            line = "%d.%09d %.9f %.9f %.9f %.12f %.12f %.12f %.12f\n"
            self._lines.append(line % (*divmod(stamp_ns, 10**9), *numbers))
            self.last_ns = stamp_ns
            if len(self._lines) >= LINES_MAX:
                self.flush()
        return stamp_ns >= self.last_ns

    def flush(self) -> None:
        """Hand every pose that was added to the system."""
        if self._wanted:
            self._file.write("".join(self._lines))
            self._lines.clear()
            self._file.flush()

    def finish(self, zero_ns: int = 0) -> None:
        """Make the trajectory of what was written, with stamps in seconds from `zero_ns`."""
        if not self._wanted:
            return
        self.flush()
        if zero_ns == 0:
            shutil.copyfile(self._partial, self._path)
            return
        with self._partial.open(encoding="ascii") as lines, self._path.open("w", encoding="ascii") as out:
            for line in lines:
                stamp, _, numbers = line.partition(" ")
                seconds, nanoseconds = divmod(abs(shifted := int(stamp.replace(".", "")) - zero_ns), 10**9)
                out.write(f"{'-' if shifted < 0 else ''}{seconds}.{nanoseconds:09d} {numbers}")

    def forget(self) -> None:
        """Remove what only a later attempt would need."""
        self._partial.unlink(missing_ok=True)

    def _take_up(self) -> None:
        kept = 0
        with self._partial.open("rb") as lines:
            for line in lines:
                if line.endswith(b"\n"):
                    kept += len(line)
                    self.last_ns = int(line.split(b" ", 1)[0].replace(b".", b""))
        os.truncate(self._partial, kept)


def _write(path: str, data: bytes) -> None:
    """Write a file; without Python's buffers, which cost more than the system call."""
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    try:
        view = memoryview(data)
        while view:
            view = view[os.write(handle, view) :]
    finally:
        os.close(handle)


def _claim(path: Path, identity: str) -> None:
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        if (path.parent / "images.txt").exists():
            raise DatasetError(
                f"{path.parent}: holds a recording that this command did not write; choose another folder"
            )
        others = sorted(entry.name for entry in path.parent.iterdir() if not entry.name.startswith("."))
        if others:
            raise DatasetError(f"{path.parent}: holds something else ({', '.join(others[:4])}); choose another folder")
        path.write_text(identity + "\n", encoding="utf-8")
    elif (found := path.read_text(encoding="utf-8").strip()) != identity:
        raise DatasetError(f"{path.parent}: holds another recording ({found}); remove it or choose another folder")


def write_source(
    source: Source, out: Path, odometry: Trajectory, identity: str, progress: Progress | None = None
) -> None:
    """Write a recording from a source's image files; images that it has already are not written again.

    Args:
        source: Images, lens and ground truth.
        out: The recording's folder.
        odometry: `T_odom_body`.
        identity: See `RecordingWriter`.
        progress: Called with images done and images in all.

    Raises:
        DatasetError: Intrinsics are missing or of another size, or an image cannot be read.
    """
    images = ImageWriter(_lens(source), source.levels)
    with RecordingWriter(out, identity) as writer:
        writer.write_lens(images.lens)
        writer.write_trajectories(odometry, source.truth)
        _carry_mask(source, images, out)
        done_s = writer.last_stamp_s
        for number, (stamp_s, file) in enumerate(source.images, start=1):
            if done_s is None or stamp_s > done_s + 1e-9:
                writer.add(stamp_s, *_written(images, file))
            if progress is not None:
                progress(number, len(source.images))


def _carry_mask(source: Source, images: ImageWriter, out: Path) -> None:
    """Bring the folder's mask to the recording; where pictures are straightened, so is it.

    Raises:
        RecordingError: It is no mask of these images.
    """
    mask = source.path / MASK
    hidden = read_mask(mask, images.straightener)
    if hidden is None:
        return
    if images.straightener.is_needed:
        data, _ = encoded_image(np.where(hidden, np.uint8(0), np.uint8(255)), lossless=True)
        (out / MASK).write_bytes(data)
    else:
        shutil.copyfile(mask, out / MASK)


def _written(images: ImageWriter, file: Path) -> tuple[bytes, str]:
    try:
        return images.written(read_bytes(file), file.suffix.lower())
    except PictureError as error:
        raise DatasetError(f"{file}: {error}") from error


def _lens(source: Source) -> Lens:
    if source.lens is None:
        seen = perhaps_cameras(source.path)
        raise DatasetError(
            f"{source.path}: intrinsics are missing; put a camera.toml or camera.yaml with width, height, fx, fy, cx, "
            "cy and distortion there, or name such a file with flocc dataset ... --camera"
            + (f" ({', '.join(seen)} may be one)" if seen else "")
        )
    return source.lens
