"""`python -m flocc_lab.bench.front_end_costs A.jpg B.jpg`: CPU of each front end beside the library calls inside it.

Two pictures, brought to 640x480, are encoded and registered. Beside each stands what OpenCV's or kornia's own calls
take for the same: features, or matches and an essential matrix. Times are CPU seconds of this process, the least of so
many rounds, with one thread where the environment says so (OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1).

With `--memory` an agent sees the pictures instead, and the peak of its process and of its workers' is printed.
"""

import asyncio
import resource
import sys
import time
from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent import Agent, AgentConfig
from flocc_agent.config import ClassicalConfig, TransportConfig
from flocc_agent.core.interfaces import Camera, Image, Perception
from flocc_agent.geometry import pose
from flocc_agent.perception.backends import build_perception
from flocc_agent.perception.classical.features import CONTRAST_THRESHOLD
from flocc_agent.perception.multiview.picture import reduced_to
from flocc_agent.perception.multiview.two_view import usac_parameters
from flocc_agent.perception.multiview.view_parameters import Geometry
from flocc_lab.bench.acceptance_rows import perception_of

SIZE_PX = (640, 480)
FOCAL_PX = 457.0
FRONT_ENDS = ("classical", "xfeat-lighterglue", "aliked-lightglue")
MATCH_RATIO = 0.8
KIB_PER_MIB = 1024.0
ALONE = TransportConfig(
    control_listen=("tcp/127.0.0.1:0",), bulk_listen=("tcp/127.0.0.1:0",), multicast=False, gossip=False
)
Work = Callable[[], object]


@dataclass(frozen=True, slots=True)
class Costs:
    """CPU seconds of one front end.

    Attributes:
        describe_s: A place descriptor.
        encode_s: A latent.
        features_s: The library's own call for its features.
        register_s: A pair, without odometry pair.
        match_s: The library's own calls for matches and, with OpenCV's robust estimator, an essential matrix.
    """

    describe_s: float
    encode_s: float
    features_s: float
    register_s: float
    match_s: float


def costs(front_end: str, images: Sequence[Image], rounds: int) -> Costs:
    """Measure one front end on two images."""
    skills = build_perception(perception_of(front_end))
    latents = [skills.encode(image) for image in images]
    calls = _of_opencv(images) if front_end == "classical" else _of_kornia(skills, images, latents)
    works: list[Work] = [
        lambda: skills.describe(images[0]),
        lambda: skills.encode(images[0]),
        calls[0],
        lambda: skills.register(latents[0], latents[1], None),
        calls[1],
    ]
    return Costs(*cpu_s(works, rounds))


def cpu_s(works: Sequence[Work], rounds: int) -> list[float]:
    """Least CPU seconds of each call: they take turns, so that what else runs meets all of them alike."""
    times: list[list[float]] = [[] for _ in works]
    for _ in range(rounds + 1):
        for work, of_work in zip(works, times, strict=True):
            began_s = time.process_time()
            work()
            of_work.append(time.process_time() - began_s)
    return [min(of_work[1:]) for of_work in times]


def _of_opencv(images: Sequence[Image]) -> tuple[Work, Work]:
    """SIFT as the classical front end asks for it; both directions of a brute-force match, and MAGSAC."""
    given = ClassicalConfig()
    sift = cv2.SIFT.create(nfeatures=given.features_max, contrastThreshold=CONTRAST_THRESHOLD)
    greys = [reduced_to(cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY), given.pixels_max) for image in images]  # type: ignore[arg-type]
    found = [sift.detectAndCompute(grey, None) for grey in greys]
    matcher = cv2.BFMatcher(cv2.NORM_L2)

    def match() -> object:
        both = [matcher.knnMatch(found[k][1], found[1 - k][1], k=2) for k in (0, 1)]
        near = [m for m, second in both[0] if m.distance < MATCH_RATIO * second.distance]
        points = [
            np.array([found[0][0][m.queryIdx].pt for m in near]) / FOCAL_PX,
            np.array([found[1][0][m.trainIdx].pt for m in near]) / FOCAL_PX,
        ]
        return _essential(points[0], points[1])

    return lambda: sift.detectAndCompute(greys[0], None), match


def _of_kornia(skills: Perception, images: Sequence[Image], latents: Sequence[bytes]) -> tuple[Work, Work]:
    """The extractor's and the matcher's forward calls, as the learned front end holds them, and MAGSAC."""
    import torch

    encoder: Any = skills.encoder
    registrar: Any = skills.registrar
    networks = encoder._networks
    image = torch.from_numpy(images[0].pixels.copy()).permute(2, 0, 1)[None].float() / 255.0
    first, second = (registrar._read(latent) for latent in latents)
    data = {"image0": networks._input(first), "image1": networks._input(second)}

    def features() -> object:
        with torch.inference_mode():
            return networks._detect(image)

    def match() -> object:
        with torch.inference_mode():
            pairs = networks._matcher(data)["matches"][0].numpy()
        return _essential(first.points[pairs[:, 0]].astype(float), second.points[pairs[:, 1]].astype(float))

    return features, match


def _essential(first: NDArray[np.float64], second: NDArray[np.float64]) -> object:
    K = np.eye(3)
    return cv2.findEssentialMat(first, second, K, K, None, None, usac_parameters(Geometry(), FOCAL_PX))


def image_of(path: Path) -> Image:
    """A picture of 640x480."""
    pixels = cv2.resize(np.asarray(cv2.imread(str(path)), np.uint8), SIZE_PX, interpolation=cv2.INTER_CUBIC)
    camera = Camera(*SIZE_PX, FOCAL_PX, FOCAL_PX, SIZE_PX[0] / 2 - 0.5, SIZE_PX[1] / 2 - 0.5)
    return Image(np.ascontiguousarray(pixels[..., ::-1], np.uint8), camera)


async def peak_mib(front_end: str, images: Sequence[Image]) -> tuple[float, float]:
    """Peak resident memory of an agent that saw these images and registered two of them, and of its largest worker."""
    config, skills = AgentConfig(name="r1", transport=ALONE), build_perception(perception_of(front_end))
    async with Agent(config, images[0].camera, perception=skills) as agent:
        for k, image in enumerate(images):
            await agent.add_keyframe(image.pixels, pose(np.eye(3), np.array([float(k), 0.0, 0.0])), 1.0 + k)
        while agent.status().busy:
            await asyncio.sleep(0.1)
        latents = [skills.encode(image) for image in images[:2]]
        await asyncio.to_thread(skills.register, latents[0], latents[1], None)
    usage = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    own, worker = (resource.getrusage(who).ru_maxrss / KIB_PER_MIB for who in usage)
    return own, worker


def line(front_end: str, found: Costs) -> str:
    """One row of the table."""
    ratios = f"{found.encode_s / found.features_s:.2f}", f"{found.register_s / found.match_s:.2f}"
    times = [f"{1000.0 * t:.0f}" for t in (found.describe_s, found.encode_s, found.features_s)]
    pair = [f"{1000.0 * t:.0f}" for t in (found.register_s, found.match_s)]
    return f"| {' | '.join([front_end, *times, ratios[0], *pair, ratios[1]])} |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("pictures", type=Path, nargs="+")
    parser.add_argument("--front-end", choices=FRONT_ENDS, action="append")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--memory", action="store_true")
    given = parser.parse_args(arguments)
    images = [image_of(path) for path in given.pictures]
    if given.memory:
        (front_end,) = given.front_end or FRONT_ENDS[:1]  # a process has one peak
        own, worker = asyncio.run(peak_mib(front_end, images))
        sys.stdout.write(f"{front_end}: agent {own:.0f} MiB, its largest worker {worker:.0f} MiB\n")
        return
    heads = ("CPU, ms", "describe", "encode", "library", "ratio", "register", "library", "ratio")
    sys.stdout.write(f"| {' | '.join(heads)} |\n{'| --- ' * len(heads)}|\n")
    for front_end in given.front_end or FRONT_ENDS:
        sys.stdout.write(f"{line(front_end, costs(front_end, images, given.rounds))}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
