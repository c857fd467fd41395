"""HTTP servers that idle connections cannot use up: few are open at one time, and those that say nothing are short."""

import logging
import threading
from socketserver import ThreadingMixIn
from typing import Any

logger = logging.getLogger(__name__)

CONNECTIONS_MAX = 32
"""Open at one time; a further one is closed at once, so that idle ones cannot use up the agent's threads and files."""
IDLE_S = 10.0
"""A connection that says nothing, or takes nothing, for so long is closed: the `timeout` of a server's handlers."""


class FewConnections(ThreadingMixIn):
    """Answers each connection from a thread of its own, a bounded number of them. Stands before the server's class."""

    daemon_threads = True

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self._free = threading.BoundedSemaphore(CONNECTIONS_MAX)
        super().__init__(*arguments, **options)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Give a connection a thread, or close it."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)  # type: ignore[attr-defined]

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer one connection, then make room for another."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ARG002
        """Whoever hangs up or is silent is no news."""
        logger.debug("a connection from %s ended early", client_address, exc_info=True)
