"""The page over HTTP: two paths, read-only, this machine only unless told otherwise."""

import logging
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from types import TracebackType
from typing import Any

from flocc_launch.dashboard.source import RunSource
from flocc_launch.run_folder import RunFolder
from flocc_protocol.errors import FloccError

logger = logging.getLogger(__name__)

PORT = 8642
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self'; img-src data:; frame-ancestors 'none'",
}


class DashboardError(FloccError):
    """The page cannot be served; one sentence says why."""


class Dashboard:
    """Serves the page of one run folder from a thread of its own, until it is closed.

    Use it in a `with`; `url` is where the page is.
    """

    def __init__(self, folder: RunFolder, port: int = PORT, host: str = "127.0.0.1") -> None:
        """Bind the port.

        Args:
            folder: The run folder; its `run.json` must be there.
            port: TCP port; 0 takes a free one.
            host: Address to listen on; 0.0.0.0 shows the page to the whole network.

        Raises:
            DashboardError: The port is in use or the address is not this machine's.
        """
        handler = handler_of(RunSource(folder))
        try:
            self._server = ThreadingHTTPServer((host, port), handler)
        except OSError as error:
            raise DashboardError(f"dashboard: port {port} on {host}: {error.strerror}; choose another") from error
        self._server.daemon_threads = True
        self.url = f"http://{host}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, name="dashboard", daemon=True)

    def __enter__(self) -> "Dashboard":
        self._thread.start()
        logger.info("dashboard at %s", self.url)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def page() -> bytes:
    """The page; everything in it is inline."""
    return files("flocc_launch.dashboard").joinpath("page.html").read_bytes()


def handler_of(source: RunSource) -> type[BaseHTTPRequestHandler]:
    """A request handler for one run."""

    class Handler(BaseHTTPRequestHandler):
        """GET / and /state.json."""

        def do_GET(self) -> None:
            """Answer."""
            if self.path == "/":
                self._answer(HTTPStatus.OK, "text/html; charset=utf-8", page())
            elif self.path == "/state.json":
                self._answer(HTTPStatus.OK, "application/json", source.snapshot_text().encode())
            else:
                self._answer(HTTPStatus.NOT_FOUND, "text/plain; charset=utf-8", b"there is only / and /state.json\n")

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
