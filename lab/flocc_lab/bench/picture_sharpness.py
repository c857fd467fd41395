"""How sharp pictures of recordings are, and how many features they have: whether remapping explains a difference.

python -m flocc_lab.bench.picture_sharpness RECORDING [RECORDING ...]
"""

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flocc_agent.runtime.recording import Recording

EVERY = 16
BORDER_PX = 8


def sharpness(path: Path) -> dict[str, Any]:
    """Variance of the Laplacian and SIFT features of every 16th picture, without its border, and the size."""
    recording, sift = Recording.open(path), cv2.SIFT.create()
    sharp, features = [], []
    for frame in recording.frames[::EVERY]:
        grey = cv2.cvtColor(recording.load_image(frame).pixels, cv2.COLOR_RGB2GRAY)
        grey = grey[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX]
        sharp.append(float(cv2.Laplacian(grey, cv2.CV_64F).var()))
        features.append(len(sift.detect(grey, None)))
    camera = recording.camera
    return {
        "recording": str(path),
        "size": [camera.width, camera.height],
        "laplacian_variance": float(np.mean(sharp)),
        "sift_features": float(np.mean(features)),
    }


def main() -> None:
    """Print one object for each recording."""
    sys.stdout.write(json.dumps([sharpness(Path(name)) for name in sys.argv[1:]], indent=1) + "\n")


if __name__ == "__main__":
    main()
