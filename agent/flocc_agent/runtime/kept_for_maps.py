"""What a robot's store keeps beside its logs so that a map can be made of them: front end, cameras, the opened map."""

import json
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import BackendConfig, PerceptionConfig
from flocc_agent.core.interfaces import Camera, Perception
from flocc_agent.geometry import pose7
from flocc_agent.runtime.map_folder import LensModel, MapFolder, MapFrontEnd, MapPart
from flocc_agent.runtime.store import Store

Float = NDArray[np.float64]

FRONT_END_FACT, BACK_END_FACT, CAMERA_FACT, MAP_FACT = "front_end", "back_end", "camera", "map"
"""Names of facts; of the camera's, the log follows after a space."""


class UsedMap(MapPart):
    """The map in which a robot works."""

    path: str
    frame: str
    is_fixed: bool = False


def keep_front_end(store: Store, method: str | None, config: PerceptionConfig, perception: Perception) -> None:
    """Keep what made descriptors and latents; a program's own front end has no method."""
    front_end = MapFrontEnd(
        method=method,
        model=perception.encoder.model,
        dimension=perception.describer.dimension,
        settings=config.model_dump(mode="json"),
    )
    store.put_fact(FRONT_END_FACT, front_end.model_dump_json().encode())


def keep_back_end(store: Store, config: BackendConfig) -> None:
    """Keep how the robot solves, so that its map is solved alike."""
    store.put_fact(BACK_END_FACT, config.model_dump_json().encode())


def keep_camera(store: Store, camera: Camera, T_body_camera: Float) -> None:
    """Keep the intrinsics of the own log's camera, and where it sits."""
    kept = {"camera": lens_of(camera).model_dump(mode="json"), "T_body_camera": pose7(T_body_camera)}
    store.put_fact(f"{CAMERA_FACT} {store.identity.log}", json.dumps(kept).encode())


def keep_map(store: Store, opened: MapFolder, is_fixed: bool) -> None:
    """Keep which map the robot works in."""
    used = UsedMap(path=str(opened.path.resolve()), frame=opened.manifest.frame, is_fixed=is_fixed)
    store.put_fact(MAP_FACT, used.model_dump_json().encode())


def lens_of(camera: Camera) -> LensModel:
    """A camera as a map says it."""
    return LensModel.model_validate(asdict(camera))
