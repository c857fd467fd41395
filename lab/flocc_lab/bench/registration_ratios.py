"""`flocc bench registration`: what the paper's front end costs, as ratios measured in one run.

The yardstick of encode and decode is this project's own float32 network with unfused attention (the mathematics of
the reference); that of matching is the same algorithm on SciPy's KD-tree. Weights are keyed random ones.
"""

import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from flocc_lab.bench.memory import measure

if TYPE_CHECKING:
    from torch import Tensor

    from flocc_agent.perception.mast3r.search import Search
    from flocc_agent.perception.mast3r.two_view_network import DenseView, Mast3r

Network = Literal["full", "small", "tiny"]
Json = dict[str, Any]

COMMAND = "flocc bench registration --json"
HEIGHT, WIDTH = 384, 512
LIMITS = {"encode": 0.30, "decode": 0.40, "matching": 0.20}
FIELD_CELLS = {"matching": 48, "matching_smooth": 12}
FIELD_NOISE = 0.38
ENCODE_FLOP, DECODE_FLOP = 523e9, 991e9
ACCELERATOR_ROUNDS = 20


@dataclass(frozen=True, slots=True)
class Cost:
    """Wall time and CPU time of one run, seconds."""

    wall_s: float
    cpu_s: float


def run(network: Network = "full", rounds: int = 3, threads: int = 2, height: int = HEIGHT, width: int = WIDTH) -> Json:
    """Measure the front end and compare it with its yardsticks.

    Args:
        network: Size of MASt3R; ratios of reduced sizes say little.
        rounds: Times that each pair of runs is repeated, yardstick and product in turns.
        threads: CPU threads of both.
        height: Of the pictures, pixels.
        width: Of the pictures, pixels.

    Returns:
        The object of DESIGN.md section 8: `ratios` (name to median, min, max; null where this machine has no fast
        bfloat16), `limits`, `errors` (of bfloat16 against float32), `memory`, `pose`, `accelerator` (null without one),
        `machine`, `command`.
    """
    import torch

    from flocc_agent.perception.mast3r.device import cpu_has_fast_bf16

    with threads_set_to(threads):
        ratios, errors = network_ratios(network, rounds, (height, width)) if cpu_has_fast_bf16() else (_none(), None)
        for name, cells in FIELD_CELLS.items():
            ratios |= matching_ratios(name, cells, rounds, (height, width))
    with threads_set_to(1):
        for name, cells in FIELD_CELLS.items():
            ratios |= matching_ratios(f"{name}_one_thread", cells, rounds, (height, width))
    return {
        "ratios": ratios,
        "limits": LIMITS,
        "errors": errors,
        "memory": measure(network, height, width, threads=threads),
        "pose": pose_rows(),
        "accelerator": accelerator(network, (height, width)) if torch.cuda.is_available() else None,
        "machine": machine(threads),
        "command": COMMAND,
    }


def _none() -> Json:
    """Ratios that this machine cannot show."""
    return dict.fromkeys(("encode", "encode_cpu", "decode", "decode_cpu"))


@contextmanager
def threads_set_to(threads: int) -> Iterator[None]:
    """Pin torch's threads for a measurement."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    yield
    torch.set_num_threads(before)


def cost(function: Callable[[], object]) -> Cost:
    """Run once and measure."""
    wall, cpu = time.perf_counter(), time.process_time()
    function()
    return Cost(time.perf_counter() - wall, time.process_time() - cpu)


def paired(name: str, product: Callable[[], object], yardstick: Callable[[], object], rounds: int) -> Json:
    """Ratios of both kinds of time, the two run in turns; both must have run before."""
    pairs = [(cost(product), cost(yardstick)) for _ in range(rounds)]
    return {
        name: spread([a.wall_s / b.wall_s for a, b in pairs]),
        f"{name}_cpu": spread([a.cpu_s / b.cpu_s for a, b in pairs]),
    }


def spread(values: list[float]) -> Json:
    """Median, minimum and maximum."""
    return {kind: round(float(f(values)), 4) for kind, f in (("median", np.median), ("min", min), ("max", max))}


def keyed_pair(network: Network) -> tuple["Mast3r", "Mast3r"]:
    """The float32 network with unfused attention, and the product's in bfloat16."""
    import torch

    from flocc_agent.perception.mast3r.device import Compute
    from flocc_agent.perception.mast3r.engine import prepared
    from flocc_agent.perception.mast3r.keyed import MAST3R_SEED, keyed_state
    from flocc_agent.perception.mast3r.sizes import NAMED_SIZES
    from flocc_agent.perception.mast3r.transformer_blocks import AttentionKind
    from flocc_agent.perception.mast3r.two_view_network import Mast3r

    with torch.device("meta"):
        plain = Mast3r(NAMED_SIZES[network], attention=AttentionKind.EAGER)
        fast = Mast3r(NAMED_SIZES[network])
    state = keyed_state(plain, MAST3R_SEED)
    plain.load_state_dict(state, strict=True, assign=True)
    fast.load_state_dict({key: value.bfloat16() for key, value in state.items()}, strict=True, assign=True)
    compute = Compute(torch.device("cpu"), torch.bfloat16, torch.bfloat16)
    return plain.eval().requires_grad_(False), prepared(fast, compute)


def keyed_images(size: tuple[int, int]) -> list["Tensor"]:
    """Two keyed pictures."""
    import torch

    from flocc_agent.perception.mast3r.keyed import MAST3R_SEED, keyed_image

    return [torch.from_numpy(keyed_image(MAST3R_SEED, f"image/bench/{k}", 1, *size)) for k in (1, 2)]


def network_ratios(network: Network, rounds: int, size: tuple[int, int]) -> tuple[Json, Json]:
    """Ratios of encode and decode, and the errors of bfloat16 beside them."""
    import torch

    plain, fast = keyed_pair(network)
    images = keyed_images(size)
    with torch.inference_mode():
        latents = [plain.encode(image) for image in images]
        rough = [fast.encode(image) for image in images]
        ratios = paired("encode", lambda: fast.encode(images[0]), lambda: plain.encode(images[0]), rounds)
        exact_views = plain.decode(latents[0], size, latents[1], size)
        rough_views = fast.decode(rough[0], size, rough[1], size)
        ratios |= paired(
            "decode",
            lambda: fast.decode(rough[0], size, rough[1], size),
            lambda: plain.decode(latents[0], size, latents[1], size),
            rounds,
        )
    errors = {"latent": relative(rough[0].float(), latents[0]), **view_errors(rough_views, exact_views)}
    return ratios, errors


def view_errors(found: tuple["DenseView", "DenseView"], expected: tuple["DenseView", "DenseView"]) -> Json:
    """Frobenius-relative errors of both views' points and descriptors."""
    return {
        f"{part}_view_{k + 1}": relative(getattr(found[k], part), getattr(expected[k], part))
        for part in ("pts3d", "desc")
        for k in (0, 1)
    }


def relative(found: "Tensor", expected: "Tensor") -> float:
    """Frobenius norm of the difference over that of the expected values."""
    return round(float((found.cpu() - expected.cpu()).norm() / expected.cpu().norm()), 6)


def descriptor_fields(cells: int, size: tuple[int, int], seed: int = 0) -> tuple["Tensor", "Tensor"]:
    """A random descriptor field with so many independent cells across, and its shifted, noisy copy.

    Like the golden fields: true matches have a cosine of about 0.93.
    """
    import torch
    from torch.nn.functional import interpolate, normalize

    generator = torch.Generator().manual_seed(seed)
    coarse = torch.randn(1, 24, cells * size[0] // size[1] + 1, cells, generator=generator)
    first = normalize(interpolate(coarse, size=size, mode="bicubic")[0].permute(1, 2, 0), dim=-1).contiguous()
    noise = FIELD_NOISE / 24**0.5 * torch.randn(first.shape, generator=generator)
    return first, normalize(torch.roll(first, (11, -7), (0, 1)) + noise, dim=-1)


def kd_tree_index(desc: "Tensor", workers: int = 1) -> "Search":
    """Nearest neighbours on SciPy's KD-tree."""
    import torch

    tree = cKDTree(desc.flatten(0, 1).numpy())
    return lambda queries: torch.from_numpy(tree.query(queries.numpy(), workers=workers)[1])


def matching_ratios(name: str, cells: int, rounds: int, size: tuple[int, int]) -> Json:
    """Ratio of reciprocal matching to its KD-tree version with as many threads, and whether the matches are equal."""
    import torch

    from flocc_agent.perception.mast3r.reciprocal_matching import reciprocal_matches

    first, second = descriptor_fields(cells, size)
    workers = torch.get_num_threads()
    found = reciprocal_matches(first, second)
    expected = reciprocal_matches(first, second, index=lambda desc: kd_tree_index(desc, workers))
    if not (np.array_equal(found.xy1, expected.xy1) and np.array_equal(found.xy2, expected.xy2)):
        raise AssertionError("the matches of the two searches differ")
    return paired(
        name,
        lambda: reciprocal_matches(first, second),
        lambda: reciprocal_matches(first, second, index=lambda desc: kd_tree_index(desc, workers)),
        rounds,
    )


def pose_rows() -> list[Json]:
    """The table of relative-pose errors on synthetic pointmaps."""
    from flocc_lab.bench.pose_table import table

    return [dict(row) for row in table()]


def accelerator(network: Network, size: tuple[int, int]) -> Json:
    """Times on the GPU, errors against float32 on the CPU, and the arithmetic rate reached."""
    import torch

    from flocc_agent.perception.mast3r.device import choose_compute
    from flocc_agent.perception.mast3r.engine import prepared
    from flocc_agent.perception.mast3r.reciprocal_matching import reciprocal_matches

    plain, fast = keyed_pair(network)
    compute = choose_compute("cuda", "auto")
    fast = prepared(fast, compute)
    images = keyed_images(size)
    on_gpu = [image.to(compute.device) for image in images]
    with torch.inference_mode():
        exact = [plain.encode(image) for image in images]
        expected = plain.decode(exact[0], size, exact[1], size)
        latents = [fast.encode(image) for image in on_gpu]
        views = fast.decode(latents[0], size, latents[1], size)
        desc = [view.desc[0] for view in views]
        seconds = {
            "encode_s": synchronised_s(lambda: fast.encode(on_gpu[0])),
            "decode_s": synchronised_s(lambda: fast.decode(latents[0], size, latents[1], size)),
            "match_s": synchronised_s(lambda: reciprocal_matches(desc[0], desc[1])),
        }
    return {
        "name": torch.cuda.get_device_name(),
        "dtype": str(compute.dtype),
        **seconds,
        "encode_tflop_per_s": ENCODE_FLOP / seconds["encode_s"] / 1e12,
        "decode_tflop_per_s": DECODE_FLOP / seconds["decode_s"] / 1e12,
        "errors": view_errors(views, expected),
    }


def synchronised_s(function: Callable[[], object]) -> float:
    """Median time of a function that leaves work on the GPU, seconds."""
    import torch

    times = []
    for _ in range(ACCELERATOR_ROUNDS):
        torch.cuda.synchronize()
        start = time.perf_counter()
        function()
        torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def machine(threads: int) -> Json:
    """What this was measured on."""
    import torch

    from flocc_agent.perception.mast3r.device import cpu_has_fast_bf16

    lines = Path("/proc/cpuinfo").read_text(encoding="ascii", errors="ignore") if Path("/proc/cpuinfo").exists() else ""
    names = [line.split(":", 1)[1].strip() for line in lines.splitlines() if line.startswith("model name")]
    return {
        "cpu": names[0] if names else platform.processor(),
        "threads": threads,
        "fast_bf16": cpu_has_fast_bf16(),
        "torch": str(torch.__version__),
        "python": platform.python_version(),
    }
