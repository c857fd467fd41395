"""Peak memory of loading MASt3R and running one pair, measured in a process of its own.

python -m flocc_lab.bench.memory CHECKPOINT full 384 512 fp32 2
"""

import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from flocc_launch.setup.weight_files import Network, synthesize

Json = dict[str, Any]

RSS_LIMIT_GIB = 6.0
TIMEOUT_S = 3600.0
KIB_PER_GIB = 1024.0**2


def peak(path: Path, network: Network, height: int, width: int, dtype: str = "fp32", threads: int = 2) -> Json:
    """Load a checkpoint strictly, encode two pictures and decode them, in this process.

    Returns:
        Number of tensors loaded, shape of the pointmap, whether all values are finite, and the peak of the resident
        memory, mapped file included, GiB.
    """
    import torch

    from flocc_agent.perception.mast3r.device import DTYPES
    from flocc_agent.perception.mast3r.keyed import MAST3R_SEED, keyed_image
    from flocc_agent.perception.mast3r.sizes import NAMED_SIZES
    from flocc_agent.perception.mast3r.weights import load_mast3r

    torch.set_num_threads(threads)
    loaded = load_mast3r(path, NAMED_SIZES[network], dtype=DTYPES[dtype])
    images = [torch.from_numpy(keyed_image(MAST3R_SEED, f"image/memory/{k}", 1, height, width)) for k in (1, 2)]
    with torch.inference_mode():
        latents = [loaded.network.encode(image) for image in images]
        views = loaded.network.decode(latents[0], (height, width), latents[1], (height, width))
    return {
        "tensors": len(loaded.network.state_dict()),
        "pts3d": list(views[0].pts3d.shape),
        "finite": all(bool(torch.isfinite(view.pts3d).all() and torch.isfinite(view.desc).all()) for view in views),
        "dtype": dtype,
        "rss_peak_gib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / KIB_PER_GIB, 3),
        "rss_limit_gib": RSS_LIMIT_GIB,
    }


def measure(network: Network, height: int, width: int, dtype: str = "fp32", threads: int = 2) -> Json:
    """Write keyed weights, then run `peak` on them in a fresh process."""
    with tempfile.TemporaryDirectory(prefix="flocc-weights-") as folder:
        path = synthesize(Path(folder), network)["mast3r"]
        arguments = [str(path), network, str(height), str(width), dtype, str(threads)]
        command = [sys.executable, "-m", "flocc_lab.bench.memory", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=True)
    found: Json = json.loads(done.stdout)
    return found


def main(arguments: list[str]) -> None:
    """Print what `peak` found, as JSON."""
    path, network, height, width, dtype, threads = arguments
    names: dict[str, Network] = {"full": "full", "small": "small", "tiny": "tiny"}
    found = peak(Path(path), names[network], int(height), int(width), dtype, int(threads))
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
