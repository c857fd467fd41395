"""The page of a swarm that runs: a browser sees a new leader, a partition and the map that is one again."""

import re
import threading
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.launch.test_dashboard import browse, rows

from flocc_launch.dashboard import live_dashboard
from flocc_launch.doctor.network_check import free_port
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.scenarios.shipped import read_shipped
from flocc_launch.swarm.launching import Watch, launch

LOOP = [[0, 0], [9, 0], [9, 6], [0, 6], [0, 0]]
KILL_S, PARTITION_S, HEAL_S, END_S = 8.0, 15.0, 27.0, 36.0


class Looks:
    """Opens the page once in a browser at each of several moments, without keeping the launcher waiting."""

    def __init__(self, url: str, profiles: Path, moments: dict[str, Callable[[Watch], bool]]) -> None:
        self.seen: dict[str, str] = {}
        self._url, self._profiles, self._left = url, profiles, dict(moments)
        self._threads: list[threading.Thread] = []

    def __call__(self, watch: Watch) -> None:
        name = next(iter(self._left), None)
        if name is None or not self._left[name](watch):
            return
        del self._left[name]
        self._threads.append(threading.Thread(target=self._look, args=(name,)))
        self._threads[-1].start()

    def _look(self, name: str) -> None:
        self.seen[name] = browse(self._url, self._profiles / name)

    def all(self) -> dict[str, str]:
        for thread in self._threads:
            thread.join()
        return self.seen


def states(watch: Watch, key: str) -> list[object]:
    return [getattr(agent.said, key) for agent in watch.agents if agent.name != "r1"]


def text_of(html: str) -> str:
    """What a reader sees."""
    shown = re.sub(r"<(script|style)>.*?</\1>", " ", html, flags=re.DOTALL)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", shown))


@pytest.mark.swarm
@pytest.mark.beside
@pytest.mark.slow
def test_a_browser_sees_the_new_leader_the_partition_and_the_merged_map(tmp_path: Path) -> None:
    faults = [
        {"at_s": KILL_S, "kind": "kill", "robots": ["r1"]},
        {"at_s": PARTITION_S, "kind": "partition", "groups": [["r2"], ["r3"]]},
        {"at_s": HEAL_S, "kind": "heal"},
    ]
    routes = {name: LOOP[k:] + LOOP[1 : k + 1] for k, name in enumerate(("r1", "r2", "r3"))}
    scenario = read_shipped("meeting", {"faults": faults, "duration_s": END_S, "tracks.routes_m": routes})
    port = free_port()
    looks = Looks(
        f"http://127.0.0.1:{port}/",
        tmp_path,
        {
            "killed": lambda watch: watch.elapsed_s > KILL_S and states(watch, "leader") == ["r2", "r2"],
            "partition": lambda watch: watch.elapsed_s > PARTITION_S and states(watch, "neighbours") == [(), ()],
            "healed": lambda watch: (
                watch.elapsed_s > HEAL_S
                and states(watch, "leader") == ["r2", "r2"]
                and len(set(states(watch, "map_frame")) - {None}) == 1
            ),
        },
    )
    with live_dashboard(RunFolder(tmp_path / "run"), port, looks) as show:
        launch(scenario, tmp_path / "run", show)
    seen = looks.all()
    assert sorted(seen) == ["healed", "killed", "partition"]

    killed = rows(seen["killed"])
    assert {name: row["state"] for name, row in killed.items()} == {"r1": "died", "r2": "running", "r3": "running"}
    assert (killed["r2"]["leader"], killed["r3"]["leader"]) == ("r2", "r2")
    assert "leader r2 (term" in text_of(seen["killed"])
    assert "no longer hears r1" in text_of(seen["killed"])

    assert "partition: r2 | r3" in text_of(seen["partition"])
    assert "partition:" not in text_of(seen["killed"])

    healed = rows(seen["healed"])
    frame = healed["r2"]["frame"]
    assert frame.startswith("map/")
    assert healed["r3"]["frame"] == frame
    assert f"one map: {frame}" in text_of(seen["healed"])
    assert re.search(rf'data-map="{frame}".*?data-path="r2".*?data-path="r3"', seen["healed"], re.DOTALL)
    assert "partition:" not in text_of(seen["healed"])
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=1.0)
