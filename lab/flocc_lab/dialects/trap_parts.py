"""What the traps share: an input that was drawn, what is right to make of it, and what became of it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import pose, so3_exp
from flocc_lab.dialects.bags import BagScript, Draw
from flocc_lab.dialects.folder_writers import HEIGHT, WIDTH

Float = NDArray[np.float64]
Rng = np.random.Generator

CAMERA = f"width: {WIDTH}\nheight: {HEIGHT}\nfx: 30\nfy: 30\ncx: 16\ncy: 12\n"


@dataclass(frozen=True, slots=True)
class TrapVerdict:
    """What became of one input.

    Attributes:
        kind: Of the trap.
        wrong: What was read wrongly, or None.
        refusal: What a reader said that refused it, or None.
        may_be_refused: Whether that is right, too.
        must_be_refused: Whether nothing else is right.
    """

    kind: str
    wrong: str | None
    refusal: str | None = None
    may_be_refused: bool = False
    must_be_refused: bool = False

    @property
    def good(self) -> bool:
        """Whether it is what it has to be."""
        if self.refusal is not None:
            return self.may_be_refused or self.must_be_refused
        return self.wrong is None and not self.must_be_refused


@dataclass(frozen=True, slots=True)
class Trap:
    """An input that was drawn, and what is right to make of it.

    Attributes:
        look: Reads it; returns what is wrong, or None.
        may_be_refused: Whether a refusal is right, too.
        must_be_refused: Whether only a refusal is right.
    """

    look: Callable[[], str | None]
    may_be_refused: bool = False
    must_be_refused: bool = False


def written(path: Path, text: str) -> Path:
    """A file with a text, in a folder that is made where it is not there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def moving(rng: Rng, count: int) -> Float:
    """Poses that start anywhere, go on and turn."""
    T, poses = pose(so3_exp(rng.uniform(-2, 2, 3)), rng.uniform(-20, 20, 3)), []
    for _ in range(count):
        poses.append(T)
        T = T @ pose(so3_exp(rng.normal(0, 0.1, 3)), rng.normal(0, 0.3, 3))
    return np.array(poses)


def unlike(found: Float, wanted: Float, what: str, tolerance: float = 1e-5) -> str | None:
    """What is wrong where values are others than they should be, or None."""
    same = found.shape == wanted.shape and np.allclose(found, wanted, atol=tolerance)
    return None if same else f"{what} is {np.round(found, 4).tolist()}, not {np.round(wanted, 4).tolist()}"


def drawn_bag(rng: Rng, poses: str, mounted: bool) -> BagScript:
    """An empty bag of a drawn kind."""
    kind = str(rng.choice(["bag", "db3", "mcap"]))
    return BagScript(Draw(kind, 1, poses, mounted, bool(rng.integers(2)), "one", 0))


def written_bag(script: BagScript, folder: Path, rng: Rng) -> Path:
    """The bag's file or folder, once it is written."""
    path = folder / ("run.bag" if script.draw.kind == "bag" else "run")
    script.write(path, rng)
    return path
