"""What a simulated robot leaves for those who save a map: its own logs and latents, as a store on a real disk."""

from pathlib import Path

from flocc_agent.core.interfaces import Perception
from flocc_agent.runtime.kept_for_maps import keep_back_end, keep_camera, keep_front_end, keep_map
from flocc_agent.runtime.recording import Recording
from flocc_agent.runtime.store import Store, StoredRecord
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation.virtual_robot import Station


def write_store(
    folder: Path, station: Station, scenario: Scenario, perception: Perception, source: Path | None
) -> None:
    """Write the logs and latents of a robot's own name; copies of others' are in the others' stores.

    Args:
        folder: Of the store.
        station: The robot at the end of its run.
        scenario: What ran.
        perception: What it saw with.
        source: Its recording, for its camera; None where there is none.
    """
    disk, log = station.disk, station.log
    folder.mkdir(parents=True, exist_ok=True)
    store = Store.open(folder, log.robot, scenario.store, incarnation=log.incarnation)
    try:
        for each, records in disk.records.items():
            if each.robot == log.robot:
                store.put_records(StoredRecord(each, number, data) for number, data in enumerate(records))
        for keyframe, latent in disk.latents.items():
            if keyframe.log.robot == log.robot:
                store.put_latent(keyframe, latent)
        keep_front_end(store, scenario.perception.method, scenario.perception, perception)
        keep_back_end(store, scenario.backend)
        if source is not None:
            recording = Recording.open(source)
            keep_camera(store, recording.camera, recording.T_body_camera)
        if disk.opened is not None:
            keep_map(store, disk.opened, disk.map_fixed)
    finally:
        store.close()
