"""Make the README's pictures: `python -m flocc_lab.reference.screenshots RUN docs/images`, with Chromium installed."""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from flocc_launch.dashboard import Dashboard
from flocc_launch.runs.run_folder import RunFolder
from flocc_protocol.errors import FloccError

REPORT_PX = (1120, 1180)
DASHBOARD_PX = (1200, 900)
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--virtual-time-budget=3000",
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
    with tempfile.TemporaryDirectory() as profile:
        where = [f"--user-data-dir={profile}", f"--screenshot={out}", f"--window-size={size_px[0]},{size_px[1]}"]
        ran = subprocess.run([chromium, *FLAGS, *where, url], capture_output=True, text=True, check=False)
    if not out.exists():
        raise ScreenshotError(f"{out}: Chromium made no picture: {ran.stderr.strip()[-200:]}")


def screenshots(run: Path, out: Path) -> list[Path]:
    """Write report.png and dashboard.png of a run folder that has its report.

    Raises:
        RunFolderError: It is not a run folder.
        ScreenshotError: Chromium is not installed, or made no picture.
    """
    folder = RunFolder.open(run)
    out.mkdir(parents=True, exist_ok=True)
    report, dashboard = (out / "report.png").resolve(), (out / "dashboard.png").resolve()
    shoot((run / "report.html").resolve().as_uri(), report, REPORT_PX)
    with Dashboard(folder, port=0) as page:
        shoot(page.url, dashboard, DASHBOARD_PX)
    return [report, dashboard]


if __name__ == "__main__":
    try:
        screenshots(Path(sys.argv[1]), Path(sys.argv[2]))
    except FloccError as error:
        sys.exit(f"error: {error}")
