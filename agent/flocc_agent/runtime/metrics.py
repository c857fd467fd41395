"""Figures of one agent for Prometheus, over HTTP, while it runs; docs/metrics.md lists them.

The server has its own threads. A scrape takes one look at the agent, on the event loop's thread, and waits for it; an
agent that does not answer in time gives an error to that scrape and is not disturbed further. Needs the extra
`metrics`.
"""

import asyncio
import errno
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from flocc_agent.config import MetricsConfig
from flocc_agent.extras import to_install
from flocc_agent.runtime.few_connections import IDLE_S, FewConnections
from flocc_agent.runtime.transport import ByPeer, TransportCounters
from flocc_agent.stages import BOUNDS_S, Histogram
from flocc_protocol.errors import FloccError

if TYPE_CHECKING:
    from prometheus_client.core import HistogramMetricFamily, Metric

LOOK_TIMEOUT_S = 2.0


class MetricsError(FloccError):
    """Metrics cannot be served as configured; one sentence says why."""


@dataclass(frozen=True, slots=True)
class Look:
    """What a scrape sees of an agent.

    Attributes:
        counters: What went through its transport.
        stages: Time by stage.
        refused: Messages refused after they were received, by reason.
        gauges: Name without prefix -> value now.
        queues: Queue, table or cache -> (how much is in it, its maximum).
        info: Facts that are words.
    """

    counters: TransportCounters
    stages: Mapping[str, Histogram]
    refused: Mapping[str, int]
    gauges: Mapping[str, float]
    queues: Mapping[str, tuple[int, int]]
    info: Mapping[str, str]


class MetricsServer:
    """Serves `/metrics` until it is closed."""

    def __init__(self, config: MetricsConfig, whose: str, look: Callable[[], Look]) -> None:
        """Listen; call it on the event loop's thread.

        Args:
            config: Where.
            whose: Name of the robot, for errors.
            look: Gives the figures; called on the event loop's thread.

        Raises:
            MetricsError: The port is in use, the host is none of this machine, or the extra is missing.
        """
        try:
            from prometheus_client import CollectorRegistry, make_wsgi_app
        except ImportError as error:
            raise MetricsError(f"metrics need prometheus-client: {to_install('metrics')}") from error
        assert config.port is not None
        registry = CollectorRegistry()
        registry.register(_Collector(asyncio.get_running_loop(), look))
        try:
            self._server = make_server(
                config.host, config.port, make_wsgi_app(registry), _server_of(config.host), _Silent
            )
        except OSError as error:
            raise MetricsError(f"robot {whose}: {_sentence(config, error)}") from error
        self._thread = threading.Thread(target=self._server.serve_forever, name=f"{whose}-metrics", daemon=True)
        self._thread.start()
        self.port: int = self._server.server_port

    async def close(self) -> None:
        """Stop listening and wait for scrapes that are under way."""
        await asyncio.to_thread(self._close_blocking)

    def _close_blocking(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Silent(WSGIRequestHandler):
    """Logs nothing, and waits for nobody."""

    timeout = IDLE_S

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing."""


class _Server4(FewConnections, WSGIServer):
    """At an address of IPv4."""


class _Server6(_Server4):
    """At an address of IPv6."""

    address_family = socket.AF_INET6


def _server_of(host: str) -> type[WSGIServer]:
    return _Server6 if ":" in host else _Server4


def _sentence(config: MetricsConfig, error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"port {config.port} for metrics is in use; choose another one"
    return f"metrics cannot be served at {config.host}:{config.port}: {error.strerror or error}"


class _Collector:
    """Turns looks into metrics, for prometheus-client."""

    def __init__(self, loop: asyncio.AbstractEventLoop, look: Callable[[], Look]) -> None:
        self._loop = loop
        self._look = look

    def describe(self) -> "list[Metric]":
        """Nothing is known before the first scrape."""
        return []

    def collect(self) -> "Iterator[Metric]":
        """One scrape."""
        taken = asyncio.run_coroutine_threadsafe(self._take(), self._loop).result(LOOK_TIMEOUT_S)
        return metrics_of(taken)

    async def _take(self) -> Look:
        return self._look()


def metrics_of(look: Look) -> "Iterator[Metric]":
    """All metrics of one look."""
    from prometheus_client.core import GaugeMetricFamily, InfoMetricFamily

    yield InfoMetricFamily("flocc_agent", "What runs.", value=dict(look.info))
    yield from _traffic(look.counters)
    dropped = {**look.counters.dropped, **look.refused}
    yield _counter("flocc_dropped_messages", "Messages given up, refused or lost, by reason.", "reason", dropped)
    yield _stages(look.stages)
    for name, value in look.gauges.items():
        yield GaugeMetricFamily(f"flocc_{name}", GAUGES[name], value=value)
    for number, (name, what) in enumerate(QUEUES.items()):
        family = GaugeMetricFamily(name, what, labels=("queue",))
        for queue, sizes in sorted(look.queues.items()):
            family.add_metric((queue,), sizes[number])
        yield family


GAUGES = {
    "keyframes": "Keyframes in this robot's own log.",
    "closures": "Loop closures in all logs that it holds.",
    "candidates": "Pairs that it is to register and can.",
    "neighbours": "Robots in range.",
    "logs": "Logs that it holds, its own included.",
    "leading": "1 while this robot leads, else 0.",
    "term": "Term that it follows, 0 for none.",
    "round": "Round of the correction that it applied, 0 for none.",
}
QUEUES = {
    "flocc_queue_items": "What is in a queue, table or cache.",
    "flocc_queue_items_max": "Its maximum.",
}


def _traffic(counters: TransportCounters) -> "Iterator[Metric]":
    """Bytes and messages by kind and peer."""
    from prometheus_client.core import CounterMetricFamily

    tables: dict[str, tuple[str, ByPeer]] = {
        "flocc_sent_bytes": ("Payload bytes sent, a broadcast on each link.", counters.sent_to),
        "flocc_received_bytes": ("Payload bytes that reached the robot.", counters.received_from),
        "flocc_lost_bytes": ("Payload bytes that arrived and were kept away.", counters.lost_from),
    }
    for name, (what, peers) in tables.items():
        family = CounterMetricFamily(name, what, labels=("kind", "peer"))
        for peer, kinds in peers.items():
            for kind, traffic in kinds.items():
                family.add_metric((kind, peer), traffic.payload_bytes)
        yield family
    for name, what, kinds in (
        ("flocc_published_bytes", "Payload bytes sent, a broadcast once.", counters.sent),
        ("flocc_taken_bytes", "Payload bytes that reached the robot, of all peers.", counters.received),
    ):
        yield _counter(name, what, "kind", {kind: traffic.payload_bytes for kind, traffic in kinds.items()})
    for name, what, kinds in (
        ("flocc_published_messages", "Messages and pieces of latents sent, a broadcast once.", counters.sent),
        ("flocc_taken_messages", "Messages and pieces of latents that reached the robot.", counters.received),
    ):
        yield _counter(name, what, "kind", {kind: traffic.messages for kind, traffic in kinds.items()})


def _counter(name: str, what: str, label: str, values: Mapping[str, int]) -> "Metric":
    from prometheus_client.core import CounterMetricFamily

    family = CounterMetricFamily(name, what, labels=(label,))
    for key, value in sorted(values.items()):
        family.add_metric((key,), value)
    return family


def _stages(stages: Mapping[str, Histogram]) -> "HistogramMetricFamily":
    """Time by stage, as cumulative buckets."""
    from prometheus_client.core import HistogramMetricFamily

    family = HistogramMetricFamily("flocc_stage_seconds", "How long stages of the work took.", labels=("stage",))
    for stage, histogram in stages.items():
        below, buckets = 0, []
        for bound_s, count in zip((*BOUNDS_S, float("inf")), histogram.counts, strict=True):
            below += count
            buckets.append(("+Inf" if bound_s == float("inf") else f"{bound_s:g}", float(below)))
        family.add_metric((stage,), buckets, histogram.total_s)
    return family
