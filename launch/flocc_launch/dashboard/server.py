"""The page over HTTP: two paths, read-only, this machine only unless told otherwise."""

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, HTTPServer
from importlib.resources import files
from types import TracebackType
from typing import Any, TypeVar

from flocc_agent.runtime.few_connections import IDLE_S, FewConnections
from flocc_launch.dashboard.page_source import RunSource, SnapshotSource
from flocc_launch.runs.run_folder import RunFolder
from flocc_protocol.errors import FloccError

logger = logging.getLogger(__name__)

W = TypeVar("W")

PORT = 8642
PORT_MAX = 65535
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self'; img-src data:; frame-ancestors 'none'",
}


class DashboardError(FloccError):
    """The page cannot be served; one sentence says why."""


class _Server(FewConnections, HTTPServer):
    """Answers nothing by itself."""

    def __init__(self, address: tuple[str, int]) -> None:
        super().__init__(address, BaseHTTPRequestHandler)


class Dashboard:
    """Serves the page of one swarm from a thread of its own, until it is closed.

    Making it takes the port; `with` starts to answer. `url` is where the page is.
    """

    def __init__(self, source: RunFolder | SnapshotSource, port: int = PORT, host: str = "127.0.0.1") -> None:
        """Bind the port.

        Args:
            source: A run folder, whose `run.json` need not be there before `start`; or who else knows the swarm.
            port: TCP port; 0 takes a free one.
            host: Address to listen on; 0.0.0.0 shows the page to the whole network.

        Raises:
            DashboardError: The port is in use or the address is not this machine's.
        """
        self._source = source
        try:
            self._server = _Server((host, port))
        except OSError as error:
            why = error.strerror or str(error)
            raise DashboardError(f"dashboard: port {port} on {host}: {why}; choose another") from error
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, name="dashboard", daemon=True)

    def __enter__(self) -> "Dashboard":
        self.start()
        return self

    def start(self) -> None:
        """Begin to answer.

        Raises:
            RunFolderError: The folder has no `run.json`.
        """
        source = RunSource(self._source) if isinstance(self._source, RunFolder) else self._source
        self._server.RequestHandlerClass = handler_of(source)
        self._thread.start()
        logger.info("dashboard at %s", self.url)

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Stop answering and give the port back."""
        if self._thread.is_alive():
            self._server.shutdown()
            self._thread.join()
        self._server.server_close()


@contextmanager
def live_dashboard(
    folder: RunFolder, port: int, on_watch: Callable[[W], None], host: str = "127.0.0.1"
) -> Iterator[Callable[[W], None]]:
    """Serve the page of a launch from the first state that its launcher shows.

    Args:
        folder: Where the run will lie.
        port: TCP port, taken at once, so that a port in use stops the launch before it begins.
        on_watch: What the launcher shows its states to anyway.
        host: Address to listen on.

    Yields:
        What to give the launcher in its place.

    Raises:
        DashboardError: The port is in use.
    """
    dashboard = Dashboard(folder, port, host)
    started = False

    def show(watch: W) -> None:
        nonlocal started
        if not started:
            dashboard.start()
            started = True
        on_watch(watch)

    try:
        yield show
    finally:
        dashboard.close()


def address(text: str, what: str = "dashboard") -> tuple[str, int]:
    """Read [HOST:]PORT of `what`; without a host, this machine only.

    Raises:
        DashboardError: It is not that.
    """
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or int(port) > PORT_MAX:
        raise DashboardError(f"{what}: {text!r} is not [HOST:]PORT, such as 8642 or 0.0.0.0:8642")
    return host.strip("[]") or "127.0.0.1", int(port)


def page() -> bytes:
    """The page; everything in it is inline."""
    return files("flocc_launch.dashboard").joinpath("page.html").read_bytes()


def handler_of(source: SnapshotSource) -> type[BaseHTTPRequestHandler]:
    """A request handler for one source."""

    class Handler(BaseHTTPRequestHandler):
        """GET / and state.json."""

        timeout = IDLE_S

        def do_GET(self) -> None:
            """Answer, also below a path that a reverse proxy left in front."""
            name = self.path.split("?")[0].rpartition("/")[2]
            if name == "":
                self._answer(HTTPStatus.OK, "text/html; charset=utf-8", page())
            elif name == "state.json":
                self._answer_state()
            else:
                self._answer(HTTPStatus.NOT_FOUND, "text/plain; charset=utf-8", b"there is only / and state.json\n")

        def _answer_state(self) -> None:
            try:
                self._answer(HTTPStatus.OK, "application/json", source.snapshot_text().encode())
            except TimeoutError:
                self._answer(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain; charset=utf-8", b"too busy\n")

        def _answer(self, status: HTTPStatus, kind: str, body: bytes) -> None:
            self.send_response(status)
            for name, value in {"Content-Type": kind, "Content-Length": str(len(body)), **HEADERS}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            """Requests are logged for debugging only."""
            logger.debug(format, *args)

    return Handler
