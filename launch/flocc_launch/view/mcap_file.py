"""A run as one MCAP file, and live over Foxglove's WebSocket: Foxglove, rerun and `mcap` open the file."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from flocc_launch.dashboard.tail import RunTail
from flocc_launch.runs.loaded_run import load
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.view.run_view import images_of
from flocc_launch.view.scene_drawing import SceneDrawing, foxglove_module, layout
from flocc_protocol.errors import FloccError

MCAP_NAME = "run.mcap"
MCAP_MAGIC = b"\x89MCAP0\r\n"
LAYOUT_SUFFIX = ".layout.json"
LIVE_PERIOD_S = 0.25
BACKLOG_MAX = 4096


class McapError(FloccError):
    """The file cannot be written, or the port is taken."""


def write_mcap(folder: RunFolder, path: Path) -> Path:
    """Write a run as MCAP, and beside it a layout for Foxglove (`NAME.layout.json`).

    Args:
        folder: The run.
        path: The file; an earlier MCAP file is replaced, anything else is left alone.

    Raises:
        FoxgloveMissing: foxglove-sdk is not installed.
        McapError: The file cannot be written, something else stands there, or the run has a time that is none.
        RunFolderError: The run cannot be read.
    """
    foxglove = foxglove_module()
    check_mcap_target(path)
    loaded = load(folder)
    context = foxglove.Context()
    partial = path.with_name(f"{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with foxglove.open_mcap(str(partial), allow_overwrite=True, context=context):
            drawing = SceneDrawing(foxglove, context, list(loaded.robots), images_of(folder), epoch_ns(folder))
            for event in loaded.events:
                drawing.take(event)
            drawing.finish({robot: track.T_map_body for robot, track in loaded.tracks.items()}, loaded.end_s)
        partial.replace(path)
        path.with_suffix(LAYOUT_SUFFIX).write_text(layout(list(loaded.robots)), encoding="utf-8")
    except OSError as error:
        raise McapError(f"{path}: cannot be written ({error.strerror or error})") from error
    except RuntimeError as error:  # as the SDK says it, FoxgloveError, which is none of its public names
        if "Mcap" not in str(error) and "MCAP" not in str(error):
            raise
        raise McapError(f"{path}: cannot be written ({error}); is the disk full?") from error
    except OverflowError as error:
        raise McapError(f"{folder.path}: holds a time that MCAP cannot (1970 to 2106)") from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
    return path


def check_mcap_target(path: Path) -> None:
    """Refuse to replace what is no MCAP file: a device, a folder, a part of the run.

    Raises:
        McapError: Such a thing stands there.
    """
    if not path.exists():
        return
    if not path.is_file():
        raise McapError(f"{path}: cannot be written (it is no file)")
    with path.open("rb") as file:
        first = file.read(len(MCAP_MAGIC))
    if first and first != MCAP_MAGIC:
        raise McapError(f"{path}: cannot be written (it is a file of something else than MCAP)")


def epoch_ns(folder: RunFolder) -> int:
    """Start of a run, nanoseconds since 1970; 0 on virtual time.

    Raises:
        McapError: The run says no date.
    """
    start = folder.run().start
    if not isinstance(start, str):
        return 0
    try:
        return round(datetime.fromisoformat(start).timestamp()) * 10**9
    except (ValueError, OverflowError) as error:
        raise McapError(f"{folder.path / 'run.json'}: start: {start[:40]!r} is no date") from error


@contextmanager
def foxglove_server(folder: RunFolder, host: str, port: int) -> Iterator[str]:
    """Serve a run folder to Foxglove while it grows; gives the address.

    Raises:
        FoxgloveMissing: foxglove-sdk is not installed.
        McapError: The port is taken.
    """
    foxglove = foxglove_module()
    context = foxglove.Context()
    try:
        server = foxglove.start_server(
            name="flocc", host=host, port=port, context=context, message_backlog_size=BACKLOG_MAX
        )
    except RuntimeError as error:
        raise McapError(f"{host}:{port}: cannot be served ({error})") from error
    ended = threading.Event()

    def follow() -> None:
        while not (folder.path / "run.json").exists():
            if ended.wait(LIVE_PERIOD_S):
                return
        run, tail, drawn_s = folder.run(), RunTail(folder.path), -1.0
        drawing = SceneDrawing(foxglove, context, run.robots, images_of(folder), epoch_ns(folder))
        merged = False
        while not merged and not ended.wait(LIVE_PERIOD_S):
            merged, events = tail.poll()
            for event in events:
                if not merged or event.t > drawn_s:
                    drawing.take(event)
            drawn_s = max([drawn_s, *(event.t for event in events)])

    thread = threading.Thread(target=follow, name="foxglove", daemon=True)
    thread.start()
    try:
        yield f"ws://{host}:{server.port}"
    finally:
        ended.set()
        thread.join(5.0)
        server.stop()
