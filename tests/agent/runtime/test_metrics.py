"""Claims on the metrics: read over HTTP as Prometheus does, named by its conventions, and documented."""

import asyncio
import re
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from flocc_agent.config import ConfigError, MetricsConfig
from flocc_agent.runtime import few_connections, metrics
from flocc_agent.runtime.metrics import Look, MetricsError, MetricsServer, metrics_of
from flocc_agent.runtime.transport import TrafficCounter
from flocc_agent.stages import BOUNDS_S, StageTimes

PAGE = Path(__file__).parents[3] / "docs" / "metrics.md"


def look() -> Look:
    counter, stages = TrafficCounter(), StageTimes()
    counter.count_sent("heartbeat", 100, ("r2", "r3"))
    counter.count_sent("latent", 5000, ("r2",))
    counter.count_received("records", 70, "r3")
    counter.count_lost("records", 30, "r3")
    counter.count_dropped("radio-loss", 2)
    for lasted_s in (0.0003, 0.03, 0.04, 500.0):
        stages.observe("match", lasted_s)
    gauges = {"keyframes": 7.0, "neighbours": 2.0, "leading": 1.0}
    return Look(counter.snapshot(), stages.snapshot(), {"refused x": 1}, gauges, {"inbox": (3, 8192)}, {"robot": "r1"})


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def read(url: str) -> str:
    with urllib.request.urlopen(url, timeout=5.0) as answer:
        assert "text/plain" in answer.headers["Content-Type"]
        return str(answer.read().decode())


async def scraped(given: Callable[[], Look] = look) -> str:
    server = MetricsServer(MetricsConfig(port=free_port()), "r1", given)
    try:
        return await asyncio.to_thread(read, f"http://127.0.0.1:{server.port}/metrics")
    finally:
        await server.close()


def samples(text: str) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    families = text_string_to_metric_families(text)
    return {(s.name, tuple(sorted(s.labels.items()))): s.value for family in families for s in family.samples}


async def test_bytes_are_counters_by_kind_and_peer_and_a_broadcast_once_beside() -> None:
    found = samples(await scraped())
    for peer in ("r2", "r3"):
        assert found["flocc_sent_bytes_total", (("kind", "heartbeat"), ("peer", peer))] == 100
    assert found["flocc_sent_bytes_total", (("kind", "latent"), ("peer", "r2"))] == 5000
    assert found["flocc_published_bytes_total", (("kind", "heartbeat"),)] == 100
    assert found["flocc_received_bytes_total", (("kind", "records"), ("peer", "r3"))] == 70
    assert found["flocc_lost_bytes_total", (("kind", "records"), ("peer", "r3"))] == 30
    assert found["flocc_dropped_messages_total", (("reason", "radio-loss"),)] == 2
    assert found["flocc_dropped_messages_total", (("reason", "refused x"),)] == 1


async def test_stages_are_cumulative_histograms_in_seconds() -> None:
    found = samples(await scraped())
    assert found["flocc_stage_seconds_count", (("stage", "match"),)] == 4
    assert found["flocc_stage_seconds_sum", (("stage", "match"),)] == pytest.approx(500.0703)
    buckets = [found["flocc_stage_seconds_bucket", (("le", le), ("stage", "match"))] for le in edges()]
    assert buckets == sorted(buckets)
    assert buckets[edges().index("0.05")] == 3
    assert (buckets[-2], buckets[-1]) == (3, 4)


def edges() -> list[str]:
    return [*(f"{bound_s:g}" for bound_s in BOUNDS_S), "+Inf"]


async def test_gauges_and_queues_tell_what_is_now() -> None:
    found = samples(await scraped())
    assert found["flocc_keyframes", ()] == 7
    assert found["flocc_leading", ()] == 1
    assert found["flocc_queue_items", (("queue", "inbox"),)] == 3
    assert found["flocc_queue_items_max", (("queue", "inbox"),)] == 8192
    assert found["flocc_agent_info", (("robot", "r1"),)] == 1


async def test_a_port_in_use_is_one_clear_sentence() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(MetricsError, match=f"^robot r1: port {port} for metrics is in use; choose another one$"):
            MetricsServer(MetricsConfig(port=port), "r1", look)


async def test_an_address_of_another_machine_is_one_clear_sentence() -> None:
    with pytest.raises(MetricsError, match=r"^robot r1: metrics cannot be served at 192\.0\.2\.1:"):
        MetricsServer(MetricsConfig(port=free_port(), host="192.0.2.1"), "r1", look)


async def test_a_look_that_fails_is_an_error_of_that_scrape_alone() -> None:
    def broken() -> Look:
        raise ValueError("no look")

    server = MetricsServer(MetricsConfig(port=free_port()), "r1", broken)
    try:
        with pytest.raises(urllib.error.HTTPError, match="500"):
            await asyncio.to_thread(read, f"http://127.0.0.1:{server.port}/metrics")
    finally:
        await server.close()


def most_threads(for_s: float = 1.0) -> int:
    """The most threads of this process at one time, from now on."""
    end_s, most = time.monotonic() + for_s, 0
    while time.monotonic() < end_s:
        most = max(most, threading.active_count())
        time.sleep(0.01)
    return most


async def test_idle_connections_are_few_and_leave_room_for_a_scrape(monkeypatch: pytest.MonkeyPatch) -> None:
    """More at once than a server's backlog holds would wait for the kernel to try again."""
    few = 3
    monkeypatch.setattr(few_connections, "CONNECTIONS_MAX", few)
    monkeypatch.setattr(metrics._Silent, "timeout", 2.0)
    server = MetricsServer(MetricsConfig(port=free_port()), "r1", look)
    threads = threading.active_count()
    idle = [socket.create_connection(("127.0.0.1", server.port), timeout=10.0) for _ in range(3 * few)]
    assert await asyncio.to_thread(most_threads) <= threads + 1 + few
    ends = [await asyncio.to_thread(connection.recv, 1) for connection in reversed(idle)]
    assert ends == [b""] * len(idle)
    assert "flocc_" in await asyncio.to_thread(read, f"http://127.0.0.1:{server.port}/metrics")
    await server.close()
    for connection in idle:
        connection.close()


async def test_nothing_listens_after_close() -> None:
    server = MetricsServer(MetricsConfig(port=free_port()), "r1", look)
    await server.close()
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", server.port)) != 0


def test_the_page_lists_every_metric() -> None:
    from flocc_agent.runtime.metrics import GAUGES

    names = {family.name + ("_total" if family.type == "counter" else "") for family in metrics_of(look())}
    names = {f"{name}_info" if name == "flocc_agent" else name for name in names} | {f"flocc_{name}" for name in GAUGES}
    listed = set(re.findall(r"^\| `(flocc_[a-z_]+)", PAGE.read_text(), re.MULTILINE))
    assert listed == names


def test_an_address_is_a_port_or_a_host_and_a_port_and_robots_take_one_after_the_other() -> None:
    assert MetricsConfig.at("9100", 2) == (MetricsConfig(port=9100), MetricsConfig(port=9101))
    assert MetricsConfig.at("0.0.0.0:9100") == (MetricsConfig(port=9100, host="0.0.0.0"),)
    assert MetricsConfig.at("[::]:9100") == (MetricsConfig(port=9100, host="::"),)


@pytest.mark.parametrize("text", ["", "here", "0", "65536", "host:", "host:x", "-1"])
def test_what_is_no_address_is_one_clear_sentence(text: str) -> None:
    with pytest.raises(ConfigError, match=r"^metrics: '.*' is not \[HOST:\]PORT, such as 9100 or 0\.0\.0\.0:9100$"):
        MetricsConfig.at(text)


def test_ports_that_do_not_suffice_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"^metrics: from port 65535 there are no ports for 2 robots$"):
        MetricsConfig.at("65535", 2)
