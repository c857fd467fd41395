"""`flocc view --live`: a swarm in rerun while it runs.

From a run folder that grows, which costs the swarm nothing; or from the air, as a passive observer that only subscribes
(`runtime/zenoh_observer`). From the air there are no links and no images: robots do not say whom they hear, and images
are sent only where a closure needs them. A robot that was heard late is drawn from there on: the knots of its
correction, which say how its earlier poses were corrected, go to that robot alone.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from flocc_agent.core.reports import Fact
from flocc_agent.geometry import Float, pose_from_tq
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.zenoh_observer import Observer
from flocc_launch.dashboard.tail import RunTail
from flocc_launch.runs.heard import Heard
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.view.drawing import Colour, Drawing
from flocc_launch.view.run_view import closed, images_of, opened, rerun_module
from flocc_protocol.errors import DecodeError, FloccError
from flocc_protocol.ids import LogId
from flocc_protocol.messages import CorrectionBatch, Envelope, Heartbeat, LogCorrection, RecordBatch, Records
from flocc_protocol.records import SIGNATURE_BYTES, KeyframeRecord, decode_record

PERIOD_S = 0.25
SILENT_S_MAX = 10.0
RECORDS_MAX = 200_000


class NobodyHeard(FloccError):
    """No robot of the swarm was heard; one sentence says which swarm."""


def view_growing(folder: RunFolder, save: Path | None, is_over: Callable[[], bool]) -> str:
    """Draw a run folder while it grows.

    Args:
        folder: The run.
        save: Where to write an `.rrd` file; None opens the viewer.
        is_over: Asked now and then; the end of the run ends it as well.

    Raises:
        ViewError: rerun is not installed, or there is no display.
    """
    rr, run, tail = rerun_module(), folder.run(), RunTail(folder.path)
    recording = opened(rr, run.scenario, save)
    drawing = Drawing(rr, recording, run.robots, images_of(folder))
    drawn_s, merged = -1.0, False
    with suppress(KeyboardInterrupt):
        while not merged and not is_over():
            merged, events = tail.poll()
            for event in events:
                if not merged or event.t > drawn_s:
                    drawing.take(event)
            drawn_s = max([drawn_s, *(event.t for event in events)])
            time.sleep(PERIOD_S)
    return closed(recording, save, "showed the run")


def view_swarm(observer: Observer, save: Path | None, steepness: float, is_over: Callable[[], bool]) -> str:
    """Draw a running swarm from what it broadcasts.

    Args:
        observer: Who listens, not yet open.
        save: Where to write an `.rrd` file; None opens the viewer.
        steepness: k of Eq. (2), for the probability of closures.
        is_over: Asked now and then.

    Raises:
        ViewError: rerun is not installed, or there is no display.
        NobodyHeard: Nobody was heard in time.
        TransportError: The network cannot be used as configured.
    """
    rr = rerun_module()
    recording = opened(rr, observer.swarm, save)
    overheard = Overheard(steepness, observer.signed)
    drawing = Drawing(rr, recording, [], {})
    began_s = time.monotonic()
    with observer, suppress(KeyboardInterrupt):
        while not is_over():
            now_s = time.monotonic() - began_s
            for envelope in observer.heard():
                for event in overheard.events(envelope, now_s):
                    drawing.take(event)
                for correction in corrections_of(envelope):
                    colour = drawing.colour(correction.log.robot)
                    log_corrected(rr, recording, correction, overheard.positions_m(correction.log), colour)
            if not overheard.anybody and now_s > SILENT_S_MAX:
                raise NobodyHeard(f"swarm {observer.swarm}: no robot was heard within {SILENT_S_MAX:g} s")
            time.sleep(PERIOD_S)
    return closed(recording, save, "showed the swarm")


class Overheard:
    """Envelopes as facts, each record once. Signatures are taken off, not checked: this is for eyes only.

    Attributes:
        anybody: Whether any robot was heard.
    """

    def __init__(self, steepness: float, signed: bool = False) -> None:
        self.anybody = False
        self._heard = Heard(steepness)
        self._signature_bytes = SIGNATURE_BYTES if signed else 0
        self._seen: set[tuple[LogId, int]] = set()
        self._positions_m: dict[LogId, dict[int, tuple[float, float, float]]] = {}

    def events(self, envelope: Envelope, t: float) -> Iterator[Reported[Fact]]:
        """What one message tells."""
        self.anybody = True
        match envelope.message:
            case Heartbeat():
                event = self._heard.heartbeat(envelope.sender, envelope.message, t)
                if event is not None:
                    yield event
            case Records(batches):
                for batch in batches:
                    yield from self._records(batch, t)
            case CorrectionBatch(corrections):
                for correction in corrections:
                    applied = self._heard.correction(correction, t)
                    if applied is not None:
                        yield applied

    def positions_m(self, log: LogId) -> Float:
        """Positions (N, 3) of a log's keyframes that were heard, in its odom frame."""
        heard = self._positions_m.get(log, {})
        return np.array([heard[index] for index in sorted(heard)]).reshape(-1, 3)

    def _records(self, batch: RecordBatch, t: float) -> Iterator[Reported[Fact]]:
        for number, data in enumerate(batch.records, start=batch.first):
            if (batch.log, number) in self._seen or len(self._seen) >= RECORDS_MAX:
                continue
            self._seen.add((batch.log, number))
            try:
                record = decode_record(data[: len(data) - self._signature_bytes])
                event = self._heard.record(batch.log, record, t)
                if isinstance(record, KeyframeRecord):
                    self._positions_m.setdefault(batch.log, {})[record.index] = record.T_odom_camera[:3]
            except DecodeError:
                continue
            if event is not None:
                yield event


def corrections_of(envelope: Envelope) -> tuple[LogCorrection, ...]:
    """Corrections that a message holds."""
    message = envelope.message
    return message.corrections if isinstance(message, CorrectionBatch) else ()


def log_corrected(rr: Any, recording: Any, correction: LogCorrection, positions_odom_m: Float, colour: Colour) -> None:
    """A robot's trajectory as far as its keyframes were heard, laid into the map as its leader said last."""
    T_map_odom = pose_from_tq(np.array(correction.T_map_odom))
    positions_m = positions_odom_m @ T_map_odom[:3, :3].T + T_map_odom[:3, 3]
    recording.log(f"corrected/{correction.log.robot}", rr.LineStrips3D([positions_m], colors=[colour]))
