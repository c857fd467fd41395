"""Measure what it costs a swarm to be watched: `python -m flocc_lab.observers [--latent-bytes 136000] [--runs 3]`.

The same swarm runs over real zenoh without observers and with a dashboard that is polled and a live view that is drawn.
A witness hears heartbeats in both cases and notes when they come. Prints one JSON object: intervals between heartbeats
(seconds), payload bytes that agents sent to each other, and what the live view received on top.
"""

import argparse
import json
import statistics
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from flocc_agent.config import AgentConfig, BackendConfig
from flocc_agent.runtime.event_lines import of_kind
from flocc_agent.runtime.facts import AccountKept
from flocc_agent.runtime.zenoh_observer import Observer
from flocc_launch.dashboard import live_dashboard
from flocc_launch.report.model import RunReport
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.scenarios.shipped import read_shipped
from flocc_launch.swarm.launching import Watch, launch
from flocc_launch.swarm.processes import free_ports
from flocc_launch.view.live_view import view_swarm
from flocc_protocol.keys import Kind

LOOK_S = 0.02
POLL_S = 1.0
LATENT_BYTES = 136_000
"""Size of a classical latent with 1000 features."""


@dataclass(slots=True)
class Witness:
    """Notes when heartbeats of each robot come.

    Attributes:
        heard_s: Robot -> times, seconds.
    """

    observer: Observer
    heard_s: dict[str, list[float]] = field(default_factory=dict)

    def listen(self, is_over: Callable[[], bool]) -> None:
        """Note until it is over."""
        with self.observer:
            while not is_over():
                now_s = time.monotonic()
                for envelope in self.observer.heard():
                    self.heard_s.setdefault(envelope.sender.robot, []).append(now_s)
                time.sleep(LOOK_S)

    def intervals_s(self) -> list[float]:
        """Times between heartbeats of one robot, of all robots together."""
        return [later - earlier for times_s in self.heard_s.values() for earlier, later in pairwise(times_s)]


@dataclass(frozen=True, slots=True)
class Watched:
    """One run.

    Attributes:
        intervals_s: Between heartbeats, as a witness heard them.
        sent_bytes: Payload that agents sent to each other, a broadcast once for each receiver.
        observer_bytes: Payload that the live view received on top; 0 without.
        report: What came of the run.
    """

    intervals_s: list[float]
    sent_bytes: int
    observer_bytes: int
    report: RunReport


def watched(scenario: Scenario, folder: Path, observed: bool) -> Watched:
    """Run a scenario with or without observers.

    Raises:
        FloccError: The scenario or the network cannot be used.
    """
    with _attached(scenario, folder, observed) as (show, witness, view):
        report = launch(scenario, folder, show)
    accounts = {account.robot: account.fact for account in of_kind(RunFolder(folder).events(), AccountKept)}
    sent = sum(size for account in accounts.values() for kinds in account.sent_to.values() for size in kinds.values())
    intervals_s = witness[0].intervals_s() if witness else []
    return Watched(intervals_s, sent, view[0].payload_bytes if view else 0, report)


@contextmanager
def _attached(
    scenario: Scenario, folder: Path, observed: bool
) -> "Iterator[tuple[Callable[[Watch], None], list[Witness], list[Observer]]]":
    """Everybody who watches, from the moment when all agents have answered."""
    over, threads = threading.Event(), list[threading.Thread]()
    witnesses, views = list[Witness](), list[Observer]()

    def start(target: Callable[..., object], *arguments: object) -> None:
        threads.append(threading.Thread(target=target, args=arguments))
        threads[-1].start()

    def show(watch: Watch) -> None:
        if witnesses or not all(agent.status is not None for agent in watch.agents):
            return
        transport = AgentConfig.read(watch.agents[-1].folder / "config.json").transport
        witnesses.append(Witness(Observer(transport, scenario.name, (Kind.HEARTBEAT,))))
        start(witnesses[0].listen, over.is_set)
        if observed:
            views.append(Observer(transport, scenario.name))
            start(view_swarm, views[0], folder.parent / f"{folder.name}.rrd", BackendConfig().steepness, over.is_set)
            start(_poll, f"http://127.0.0.1:{port}/state.json", over)

    with ExitStack() as stack:
        (port,) = free_ports(1)
        shown = stack.enter_context(live_dashboard(RunFolder(folder), port, show)) if observed else show
        try:
            yield shown, witnesses, views
        finally:
            over.set()
            for thread in threads:
                thread.join()


def _poll(url: str, over: threading.Event) -> None:
    """Ask as an open page does."""
    while not over.wait(POLL_S):
        with urllib.request.urlopen(url, timeout=10.0) as answer:
            answer.read()


def watched_scenario(latent_bytes: int, length_m: float = 40.0) -> Scenario:
    """Three robots that merge, with latents of a given size."""
    changes: dict[str, Any] = {"tracks.length_m": length_m, "perception.synthetic.latent_bytes": latent_bytes}
    return read_shipped("meeting", changes)


def measure(folder: Path, runs: int, latent_bytes: int) -> dict[str, Any]:
    """Runs with and without observers, in turn."""
    scenario = watched_scenario(latent_bytes)
    cases = {name: [watched(scenario, folder / f"{name}-{k}", name == "with") for k in range(runs)] for name in CASES}
    intervals = {name: [s for run in done for s in run.intervals_s] for name, done in cases.items()}
    extra = [run.observer_bytes / run.sent_bytes for run in cases["with"]]
    return {
        "latent_bytes": latent_bytes,
        "runs": runs,
        "heartbeat_intervals_s": {name: spread(values) for name, values in intervals.items()},
        "sent_bytes": {name: [run.sent_bytes for run in done] for name, done in cases.items()},
        "observer_bytes": [run.observer_bytes for run in cases["with"]],
        "observer_ratio": {"median": round(statistics.median(extra), 4), "max": round(max(extra), 4)},
        "merged_after_s": {name: [run.report.merged_after_s for run in done] for name, done in cases.items()},
    }


CASES = ("without", "with")


def spread(values: list[float]) -> dict[str, float]:
    """Median, 99 % and longest."""
    ordered = sorted(values)
    return {
        "median": round(statistics.median(ordered), 3),
        "p99": round(ordered[min(len(ordered) - 1, int(0.99 * len(ordered)))], 3),
        "max": round(ordered[-1], 3),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--latent-bytes", type=int, default=LATENT_BYTES)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        measured = measure(Path(folder), given.runs, given.latent_bytes)
    sys.stdout.write(json.dumps({**measured, "command": " ".join(sys.argv[1:])}) + "\n")


if __name__ == "__main__":
    main()
