"""The paper's front end in a whole swarm: encode, gossip, fetch, decode, accept or reject, over real zenoh.

The weights are keyed random numbers, so nothing is recognised; what is shown is the path.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from flocc_agent.core.interfaces import Camera
from flocc_agent.geometry import pose
from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.datasets.writer import RecordingWriter
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.swarm.launching import launch

torch = pytest.importorskip("torch", reason="needs the extra flocc[mast3r]")

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow]

CAMERA = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)
FRAMES = 5


def recording(path: Path, seed: int) -> Path:
    """Pictures of coloured noise along a straight way."""
    import cv2

    rng = np.random.default_rng(seed)
    stamps_s = np.arange(FRAMES, dtype=float)
    way = Trajectory(stamps_s, np.array([pose(np.eye(3), np.array([0.6 * k, 0.0, 0.0])) for k in range(FRAMES)]))
    with RecordingWriter(path, f"noise {seed}") as writer:
        writer.write_camera(CAMERA, np.eye(4))
        writer.write_trajectories(way, None)
        for stamp_s in stamps_s:
            coarse = rng.integers(0, 256, (15, 20, 3), dtype=np.uint8)
            _, png = cv2.imencode(".png", cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_CUBIC))
            writer.add(float(stamp_s), png.tobytes(), ".png")
    return path


def test_every_candidate_is_decoded_and_decided(tmp_path: Path) -> None:
    from flocc_launch.setup.weight_files import synthesize

    weights = synthesize(tmp_path / "weights")
    scenario = Scenario.model_validate(
        {
            "name": "mast3r",
            "settle_s": 4.0,
            "robots": {name: {"recording": str(recording(tmp_path / name, k))} for k, name in enumerate(("r1", "r2"))},
            "core": {"place_recognition": {"similarity_threshold": -1.0}},
            "perception": {
                "method": "mast3r",
                "mast3r": {
                    "weights": str(weights["mast3r"]),
                    "place_weights": str(weights["cosplace"]),
                    "network": "tiny",
                    "image_size_px": 224,
                    "threads": 1,
                    "exchange": "auto",
                },
            },
        }
    )
    report = launch(scenario, tmp_path / "run")
    results = [json.loads(p.read_text()) for p in sorted((tmp_path / "run" / "robots").glob("*/result.json"))]
    assert [len(result["keyframes"]) for result in results] == [FRAMES, FRAMES]
    assert results[0]["logs"] == results[1]["logs"]
    assert report.bytes["latent"] > 0
    assert report.closures.candidates >= FRAMES
    assert report.closures.accepted + report.closures.rejected == report.closures.candidates
    assert not any("failed" in warning for warning in report.warnings)
