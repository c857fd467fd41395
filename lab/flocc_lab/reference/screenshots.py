"""Make the pages' pictures, with Chromium installed: `python -m flocc_lab.reference.screenshots RUN docs/images`.

Of a run with its report: `report.png`, `closure.jpg` (a pair of keyframes with its matches), `phone.png` and
`dashboard.png`; of a run in which the swarm was split, `--split RUN`, `split.png`: the dashboard at that moment; of the
built site, `--site site`, `site.png`.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from flocc_agent.core.reports import Fact
from flocc_agent.runtime.event_lines import Reported
from flocc_launch.dashboard import Dashboard
from flocc_launch.dashboard.state import SwarmState
from flocc_launch.runs.run_folder import RunFolder
from flocc_protocol.errors import FloccError

REPORT_PX = (1120, 1180)
CLOSURE_PX = (1120, 600)
PHONE_PX = (390, 844)
DASHBOARD_PX = (1280, 900)
SITE_PX = (1280, 900)
WINDOW_MIN_PX = 500
"""Chromium's window is no narrower; a phone's page is shown in a frame."""
SPLIT_MIN_S = 3.0
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--virtual-time-budget=3000",
    "--allow-file-access-from-files",
)  # fmt: skip


class ScreenshotError(FloccError):
    """A picture cannot be made; one sentence says why."""


def shoot(url: str, out: Path, size_px: tuple[int, int]) -> None:
    """Write a PNG of a page as Chromium draws it.

    Raises:
        ScreenshotError: Chromium is not installed, or made no picture.
    """
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        raise ScreenshotError("screenshots need Chromium: apt-get install chromium")
    out.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as profile:
        where = [f"--user-data-dir={profile}", f"--screenshot={out}", f"--window-size={size_px[0]},{size_px[1]}"]
        ran = subprocess.run([chromium, *FLAGS, *where, url], capture_output=True, text=True, check=False)
    if not out.exists():
        raise ScreenshotError(f"{out}: Chromium made no picture: {ran.stderr.strip()[-200:]}")


def shoot_phone(url: str, out: Path) -> None:
    """Write a PNG of a page as wide as a phone.

    Raises:
        ScreenshotError: Chromium is not installed, or made no picture.
    """
    width, height = PHONE_PX
    frame = f'<iframe src="{url}" style="width:{width}px;height:{height}px;border:0;display:block"></iframe>'
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "phone.html"
        page.write_text(f"<!doctype html><body style='margin:0 {(WINDOW_MIN_PX - width) // 2}px'>{frame}</body>")
        shoot(page.as_uri(), out, (WINDOW_MIN_PX, height))


def screenshots(run: Path, out: Path) -> list[Path]:
    """Write the pictures of a run folder that has its report.

    Raises:
        RunFolderError: It is not a run folder.
        ScreenshotError: Chromium is not installed, or made no picture.
    """
    folder = RunFolder.open(run)
    out.mkdir(parents=True, exist_ok=True)
    page = (run / "report.html").resolve()
    names = ("report.png", "closure.jpg", "phone.png", "dashboard.png")
    report, closure, phone, dashboard = ((out / name).resolve() for name in names)
    shoot(page.as_uri(), report, REPORT_PX)
    sheet = re.search(r'<section id="([^"]*)"', page.read_text(encoding="utf-8"))
    if sheet is not None:
        drawn = closure.with_suffix(".png")
        shoot(f"{page.as_uri()}#{sheet[1]}", drawn, CLOSURE_PX)
        cv2.imwrite(str(closure), np.asarray(cv2.imread(str(drawn))), [cv2.IMWRITE_JPEG_QUALITY, 80])
        drawn.unlink()
    shoot_phone(page.as_uri(), phone)
    with Dashboard(folder, port=0) as served:
        shoot(served.url, dashboard, DASHBOARD_PX)
    return [path for path in (report, closure, phone, dashboard) if path.exists()]


def shoot_split(run: Path, out: Path) -> Path:
    """Write the dashboard of a run at a moment when its swarm was split.

    Raises:
        RunFolderError: It is not a run folder.
        ScreenshotError: The swarm was never split, Chromium is not installed, or made no picture.
    """
    folder, picture = RunFolder.open(run), (out / "split.png").resolve()
    at_s = split_s(folder.events(), folder.run().robots)
    if at_s is None:
        raise ScreenshotError(f"{run}: the swarm was never split for {SPLIT_MIN_S:g} s")
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        cut = RunFolder.create(Path(place) / "run")
        cut.write_run(folder.run().model_copy(update={"start": None}))
        lines = (run / "events.jsonl").read_text(encoding="utf-8").splitlines()
        for line, event in zip(lines, folder.iterate_events(), strict=True):
            if event.t <= at_s:
                own = cut.path / "robots" / event.robot
                own.mkdir(exist_ok=True)
                with (own / "events.jsonl").open("a", encoding="utf-8") as file:
                    file.write(line + "\n")
        with Dashboard(cut, port=0) as served:
            shoot(served.url, picture, DASHBOARD_PX)
    return picture


def split_s(events: Sequence[Reported[Fact]], robots: Sequence[str]) -> float | None:
    """End of the longest time in which not all robots were in one group of hearers; None where they always were."""
    state, since_s = SwarmState(robots), 0.0
    longest: tuple[float, float | None] = SPLIT_MIN_S, None
    for event in events:
        before_s = state.t
        state.apply(event)
        if len(state.snapshot(event.t, "").ranges) > 1:
            longest = max(longest, (event.t - since_s, before_s), key=lambda split: split[0])
        else:
            since_s = event.t
    return longest[1]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--split", type=Path, help="a run in which the swarm was split")
    parser.add_argument("--site", type=Path, help="the built site of the documentation")
    given = parser.parse_args()
    try:
        screenshots(given.run, given.out)
        if given.split is not None:
            shoot_split(given.split, given.out)
        if given.site is not None:
            shoot((given.site / "index.html").resolve().as_uri(), (given.out / "site.png").resolve(), SITE_PX)
    except FloccError as error:
        sys.exit(f"error: {error}")
