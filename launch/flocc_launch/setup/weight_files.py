"""`flocc weights`: which checkpoints the mast3r front end needs, under which terms; check, synthesize and fetch them.

Nothing is downloaded without an explicit URL and the user's acceptance, and this project holds no weights.
"""

import argparse
import hashlib
import json
import urllib.error
import urllib.parse
import urllib.request
from dataclasses import asdict, dataclass
from http.client import HTTPException, HTTPResponse
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from flocc_agent.config import Mast3rConfig
from flocc_protocol.errors import FloccError

if TYPE_CHECKING:
    from flocc_agent.perception.mast3r.checkpoint import Checkpoint

Kind = Literal["mast3r", "cosplace"]
Network = Literal["full", "small", "tiny"]

CHUNK_BYTES = 1 << 20
FETCH_BYTES_MAX = 16 * 10**9
ATTEMPTS_MAX = 5
TIMEOUT_S = 30.0
RECORD_NAME = "accepted.json"
MODEL_STRING = "keyed random weights, not trained; img_size=(512, 512)"


class WeightsError(FloccError):
    """Weights that cannot be fetched or used; the message says why."""


@dataclass(frozen=True, slots=True)
class NeededFile:
    """One checkpoint that the front end needs.

    Attributes:
        kind: Which network it is for.
        file: Its official name.
        key: The configuration key that takes its path.
        licence: Terms of the weights, in one sentence.
        page: Where its authors describe and publish it.
    """

    kind: Kind
    file: str
    key: str
    licence: str
    page: str


NEEDED = (
    NeededFile(
        "mast3r",
        "MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth",
        "perception.mast3r.weights",
        "CC BY-NC-SA 4.0 (Naver) plus the terms of the training sets (CHECKPOINTS_NOTICE): non-commercial use only",
        "https://github.com/naver/mast3r",
    ),
    NeededFile(
        "cosplace",
        "ResNet101_512_cosplace.pth (or another backbone and dimension of release v1.0)",
        "perception.mast3r.place_weights",
        "code MIT; weights unclear: trained on Street View images, the author says that MIT does not apply",
        "https://github.com/gmberton/CosPlace",
    ),
)


@dataclass(frozen=True, slots=True)
class CheckpointStatus:
    """A needed checkpoint, and whether it is there; the first fields are those of `NeededFile`.

    Attributes:
        path: As configured, None where it is not.
        present: Whether that file is there.
        size_bytes: Of the file, None where it is not there.
    """

    kind: Kind
    file: str
    key: str
    licence: str
    page: str
    path: str | None
    present: bool
    size_bytes: int | None


def status(config: Mast3rConfig) -> list[CheckpointStatus]:
    """For each needed checkpoint: its licence, its page, the configured path and whether that file is there."""
    paths: dict[Kind, Path | None] = {"mast3r": config.weights, "cosplace": config.place_weights}
    return [_status(needed, paths[needed.kind]) for needed in NEEDED]


def _status(needed: NeededFile, path: Path | None) -> CheckpointStatus:
    size_bytes = path.stat().st_size if path is not None and path.is_file() else None
    shown = None if path is None else str(path)
    return CheckpointStatus(**asdict(needed), path=shown, present=size_bytes is not None, size_bytes=size_bytes)


@dataclass(frozen=True, slots=True)
class Checked:
    """A checkpoint that passed.

    Attributes:
        path: The file.
        kind: mast3r or cosplace.
        network: Size or backbone, for example full, or ResNet18-512.
        encoder_only: Whether it holds MASt3R's encoder alone.
        tensors: Named tensors in the file.
        parameters: Numbers in the network, aliases once.
        model: Identity that travels in latents.
        sha256: Of the file.
        self_test: What was run and held.
    """

    path: str
    kind: Kind
    network: str
    encoder_only: bool
    tensors: int
    parameters: int
    model: str
    sha256: str
    self_test: str


def check(path: Path) -> Checked:
    """Verify a checkpoint: names, shapes, finite values, hash, and a small run of the network.

    Raises:
        FloccError: The file is damaged, unsafe, of another model, or fails the self-test.
    """
    from flocc_agent.perception.mast3r.checkpoint import read_checkpoint, sha256_of

    checkpoint = read_checkpoint(path)
    file = _FileFacts(str(path), len(checkpoint.state), sha256_of(path))
    cosplace = "aggregation.3.weight" in checkpoint.state
    return _check_cosplace(path, file) if cosplace else _check_mast3r(path, checkpoint, file)


class _FileFacts(NamedTuple):
    """Of `Checked`, what every file has."""

    path: str
    tensors: int
    sha256: str


def _check_cosplace(path: Path, file: _FileFacts) -> Checked:
    """Load a CosPlace file and describe one picture."""
    import torch

    from flocc_agent.perception.mast3r.keyed import COSPLACE_SEED, keyed_image
    from flocc_agent.perception.mast3r.weights import load_cosplace

    loaded = load_cosplace(path)
    with torch.inference_mode():
        descriptor = loaded.network(torch.from_numpy(keyed_image(COSPLACE_SEED, "self-test", 1, 224, 224)))
    if not bool(torch.isfinite(descriptor).all()) or abs(float(descriptor.norm()) - 1.0) > 1e-4:
        raise WeightsError(f"{path}: the self-test gave no descriptor of unit length")
    return Checked(
        **file._asdict(),
        kind="cosplace",
        network=f"{loaded.backbone}-{loaded.network.dimension}",
        encoder_only=False,
        parameters=sum(parameter.numel() for parameter in loaded.network.parameters()),
        model=loaded.model,
        self_test="one 224x224 picture: unit descriptor",
    )


def _check_mast3r(path: Path, checkpoint: "Checkpoint", file: _FileFacts) -> Checked:
    """Load a MASt3R file strictly and run a small picture pair through it."""
    import torch

    from flocc_agent.perception.mast3r.checkpoint import ENCODER_PREFIXES
    from flocc_agent.perception.mast3r.keyed import MAST3R_SEED, keyed_image
    from flocc_agent.perception.mast3r.sizes import NAMED_SIZES
    from flocc_agent.perception.mast3r.weights import load_mast3r

    encoder_only = all(key.startswith(ENCODER_PREFIXES) for key in checkpoint.state)
    name = size_name(checkpoint)
    loaded = load_mast3r(path, NAMED_SIZES[name], with_decoder=not encoder_only)
    images = [torch.from_numpy(keyed_image(MAST3R_SEED, f"self-test/{k}", 1, 32, 48)) for k in (1, 2)]
    with torch.inference_mode():
        latents = [loaded.network.encode(image) for image in images]
        finite = all(bool(torch.isfinite(latent).all()) for latent in latents)
        if finite and not encoder_only:
            views = loaded.network.decode(latents[0], (32, 48), latents[1], (32, 48))
            finite = all(bool(torch.isfinite(v.pts3d).all() and torch.isfinite(v.desc).all()) for v in views)
    if not finite:
        raise WeightsError(f"{path}: the self-test gave values that are not finite")
    return Checked(
        **file._asdict(),
        kind="mast3r",
        network=name,
        encoder_only=encoder_only,
        parameters=sum(parameter.numel() for parameter in loaded.network.parameters()),
        model=loaded.model,
        self_test="two 32x48 pictures encoded" + ("" if encoder_only else " and decoded") + ": all values finite",
    )


def size_name(checkpoint: "Checkpoint") -> str:
    """The named size whose encoder a file has; the official one where none fits, so that strict loading complains."""
    from flocc_agent.perception.mast3r.sizes import NAMED_SIZES

    embed = checkpoint.state.get("patch_embed.proj.bias")
    width = 0 if embed is None else len(embed)
    return next((name for name, sizes in NAMED_SIZES.items() if sizes.encoder_dim == width), "full")


def synthesize(
    folder: Path, network: Network = "tiny", backbone: str = "ResNet18", dimension: int = 64, seed: int | None = None
) -> dict[Kind, Path]:
    """Write keyed random weights in the official formats, for tests and timings; they recognise nothing.

    Args:
        folder: Where `mast3r_NETWORK.pth` and `BACKBONE_DIMENSION_cosplace.pth` go; made if missing.
        network: Size of MASt3R; full takes 2.8 GB.
        backbone: CosPlace's backbone.
        dimension: Length of CosPlace's descriptors.
        seed: Of both; None takes the seeds of the golden vectors.

    Returns:
        Path of each file.

    Raises:
        WeightsError: A file cannot be written.
    """
    import torch

    from flocc_agent.perception.mast3r.cosplace import CosPlace
    from flocc_agent.perception.mast3r.keyed import COSPLACE_SEED, MAST3R_SEED, keyed_state
    from flocc_agent.perception.mast3r.sizes import NAMED_SIZES
    from flocc_agent.perception.mast3r.two_view_network import Mast3r

    folder.mkdir(parents=True, exist_ok=True)
    paths: dict[Kind, Path] = {
        "mast3r": folder / f"mast3r_{network}.pth",
        "cosplace": folder / f"{backbone}_{dimension}_cosplace.pth",
    }
    with torch.device("meta"):
        mast3r, place = Mast3r(NAMED_SIZES[network]), CosPlace(backbone, dimension)
    arguments = argparse.Namespace(model=MODEL_STRING)
    state = keyed_state(mast3r, MAST3R_SEED if seed is None else seed)
    _save({"model": state, "args": arguments}, paths["mast3r"])
    _save(keyed_state(place, COSPLACE_SEED if seed is None else seed), paths["cosplace"])
    return paths


def _save(content: object, path: Path) -> None:
    """Write a file of torch's, which tells of full disks by RuntimeError."""
    import torch

    try:
        torch.save(content, path)
    except (RuntimeError, OSError) as error:
        path.unlink(missing_ok=True)
        raise WeightsError(f"{path}: cannot be written; is the disk full?") from error


def fetch(url: str, target: Path, accepted: bool, sha256: str | None = None) -> Path:
    """Download one file that the user named, continuing an earlier attempt, and verify it.

    Args:
        url: http, https or file URL.
        target: Where the file goes; `target.part` holds an unfinished download.
        accepted: Whether the user accepted the weights' licence; recorded beside the file with its hash.
        sha256: Expected hash, hexadecimal; None records what came.

    Raises:
        WeightsError: Not accepted, not reachable, cut off, or not the file expected.
    """
    if not accepted:
        raise WeightsError(
            "nothing was downloaded: the licence of the weights must be accepted first (--accept-licence)"
        )
    if urllib.parse.urlsplit(url).scheme not in ("http", "https", "file"):
        raise WeightsError(f"{url!r} is no http, https or file URL")
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(target.name + ".part")
    complaint = "it gave no data"
    for _ in range(ATTEMPTS_MAX):
        before = part.stat().st_size if part.exists() else 0
        try:
            if _continue(url, part):
                return _accept(url, part, target, sha256)
            complaint = "the connection closed early"
        except urllib.error.HTTPError as error:
            raise WeightsError(f"{url}: the server answered {error.code} {error.reason}") from error
        except (OSError, HTTPException, ValueError) as error:
            complaint = str(getattr(error, "reason", error)) or type(error).__name__
        if part.exists() and part.stat().st_size <= before:
            break
    raise WeightsError(f"{url}: the download stopped: {complaint}; run it again to continue from {part}")


def _continue(url: str, part: Path) -> bool:
    """Append what is missing; true when the file is whole."""
    have = part.stat().st_size if part.exists() else 0
    marker = part.with_name(part.name + ".etag")
    request = urllib.request.Request(url)
    if have and marker.exists():
        request.add_header("Range", f"bytes={have}-")
        request.add_header("If-Range", marker.read_text(encoding="utf-8"))
    with _opened(request) as response:
        resumed = response.status == 206 and f"bytes {have}-" in response.headers.get("Content-Range", "")
        start = have if resumed else 0
        tag = response.headers.get("ETag") or response.headers.get("Last-Modified")
        marker.unlink(missing_ok=True)
        if tag:
            marker.write_text(tag, encoding="utf-8")
        length = response.headers.get("Content-Length")
        total = None if length is None else start + int(length)
        if total is not None and total > FETCH_BYTES_MAX:
            raise WeightsError(f"{url}: {total} bytes are more than {FETCH_BYTES_MAX}, no checkpoint is that large")
        written = _append(response, part, start)
    return total is None or written == total


def _opened(request: urllib.request.Request) -> HTTPResponse:
    """Open a request; a range that is already complete counts as answered from its start."""
    try:
        response: HTTPResponse = urllib.request.urlopen(request, timeout=TIMEOUT_S)
    except urllib.error.HTTPError as error:
        if error.code != 416 or not request.has_header("Range"):
            raise
        response = urllib.request.urlopen(urllib.request.Request(request.full_url), timeout=TIMEOUT_S)
    return response


def _append(response: HTTPResponse, part: Path, start: int) -> int:
    """Write a response behind the first `start` bytes; gives the size reached."""
    with part.open("r+b" if start else "wb") as file:
        file.seek(start)
        file.truncate()
        while chunk := response.read(CHUNK_BYTES):
            file.write(chunk)
            if file.tell() > FETCH_BYTES_MAX:
                raise WeightsError(f"more than {FETCH_BYTES_MAX} bytes came: no checkpoint is that large")
        return file.tell()


def _accept(url: str, part: Path, target: Path, sha256: str | None) -> Path:
    """Verify a whole download, put it in place and note what was accepted."""
    with part.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if sha256 is not None and found != sha256.lower():
        part.unlink()
        part.with_name(part.name + ".etag").unlink(missing_ok=True)
        raise WeightsError(f"{url}: its SHA-256 is {found}, not {sha256}; the download was removed")
    part.replace(target)
    part.with_name(part.name + ".etag").unlink(missing_ok=True)
    record = target.parent / RECORD_NAME
    known: dict[str, object] = json.loads(record.read_text(encoding="utf-8")) if record.exists() else {}
    known[target.name] = {"url": url, "sha256": found, "licence_accepted": True}
    record.write_text(json.dumps(known, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    return target
