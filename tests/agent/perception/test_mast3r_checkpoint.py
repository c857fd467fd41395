"""Loading checkpoints: strictly, safely, from either format; and what is refused."""

import json
import os
import struct
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch", reason="torch, an optional extra, is not installed")

from tests.agent.perception.mast3r_examples import (  # noqa: E402
    deviation,
    keyed_cosplace,
    keyed_mast3r,
    write_pth,
)

from flocc_agent.perception.mast3r.checkpoint import BadCheckpoint, read_checkpoint  # noqa: E402
from flocc_agent.perception.mast3r.keyed import MAST3R_SEED, canonical, keyed_image  # noqa: E402
from flocc_agent.perception.mast3r.sizes import FULL, TINY  # noqa: E402
from flocc_agent.perception.mast3r.weights import load_cosplace, load_mast3r  # noqa: E402

DTYPE_NAMES = {torch.float32: "F32", torch.int64: "I64"}


@pytest.fixture(scope="module")
def state() -> dict[str, Any]:
    return dict(keyed_mast3r(TINY).state_dict())


def write_safetensors(path: Path, state: dict[str, Any]) -> Path:
    table, data, at = {}, b"", 0
    for key, value in state.items():
        raw = value.contiguous().numpy().tobytes()
        bounds = [at, at + len(raw)]
        table[key] = {"dtype": DTYPE_NAMES[value.dtype], "shape": list(value.shape), "data_offsets": bounds}
        data, at = data + raw, at + len(raw)
    header = json.dumps({"__metadata__": {"format": "pt"}, **table}).encode()
    path.write_bytes(struct.pack("<Q", len(header)) + header + data)
    return path


def without_aliases(state: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in state.items() if canonical(key) == key}


def test_both_formats_give_the_same_network_and_identity(tmp_path: Path, state: dict[str, Any]) -> None:
    assert len(state) - len(without_aliases(state)) == 8
    from_pth = load_mast3r(write_pth(tmp_path / "a.pth", state), TINY)
    from_safetensors = load_mast3r(write_safetensors(tmp_path / "a.safetensors", without_aliases(state)), TINY)
    assert from_pth.model == from_safetensors.model
    for loaded in (from_pth.network, from_safetensors.network):
        found = loaded.state_dict()
        assert list(found) == list(state)
        assert all(torch.equal(found[key], state[key]) for key in state)
        names = ("layer1_rn", "layer_rn.0")
        pointers = {found[f"downstream_head1.dpt.scratch.{name}.weight"].data_ptr() for name in names}
        assert len(pointers) == 1


def test_a_file_written_by_the_safetensors_package_loads(tmp_path: Path, state: dict[str, Any]) -> None:
    safetensors = pytest.importorskip("safetensors.torch", reason="the safetensors package is not installed")
    contiguous = {key: value.contiguous().clone() for key, value in without_aliases(state).items()}
    safetensors.save_file(contiguous, tmp_path / "a.safetensors")
    assert load_mast3r(tmp_path / "a.safetensors", TINY).network.with_decoder


def test_loading_keeps_the_tensors_mapped_from_the_file(tmp_path: Path, state: dict[str, Any]) -> None:
    path = write_pth(tmp_path / "mapped.pth", state)
    network = load_mast3r(path, TINY).network
    assert network.patch_embed.proj.weight.device.type == "cpu"
    if Path("/proc/self/maps").exists():
        assert str(path) in Path("/proc/self/maps").read_text()


def test_the_encoder_alone_loads_from_a_whole_file_and_encodes_the_same(tmp_path: Path, state: dict[str, Any]) -> None:
    path = write_pth(tmp_path / "a.pth", state)
    whole, encoder = load_mast3r(path, TINY), load_mast3r(path, TINY, with_decoder=False)
    image = torch.from_numpy(keyed_image(MAST3R_SEED, "encoder", 1, 32, 48))
    assert torch.equal(whole.network.encode(image), encoder.network.encode(image))
    assert whole.model == encoder.model
    part = {key: value for key, value in state.items() if key.startswith(("patch_embed", "enc_"))}
    only = load_mast3r(write_pth(tmp_path / "encoder.pth", part), TINY, with_decoder=False)
    assert only.model == whole.model


def test_other_weights_have_another_identity(tmp_path: Path, state: dict[str, Any]) -> None:
    changed = {**state, "enc_norm.bias": state["enc_norm.bias"] + 1e-6}
    first = load_mast3r(write_pth(tmp_path / "a.pth", state), TINY)
    assert load_mast3r(write_pth(tmp_path / "b.pth", changed), TINY).model != first.model


def test_bfloat16_weights_stay_close_to_float32(tmp_path: Path, state: dict[str, Any]) -> None:
    path = write_pth(tmp_path / "a.pth", state)
    exact, rough = load_mast3r(path, TINY), load_mast3r(path, TINY, dtype=torch.bfloat16)
    image = torch.from_numpy(keyed_image(MAST3R_SEED, "bf16", 1, 32, 48))
    assert rough.network.enc_norm.weight.dtype == torch.bfloat16
    assert deviation(rough.network.encode(image).float(), exact.network.encode(image)) < 0.1


def test_cosplace_files_name_their_own_backbone_and_dimension(tmp_path: Path) -> None:
    for backbone, dimension in (("ResNet18", 64), ("ResNet50", 32), ("VGG16", 64)):
        network = keyed_cosplace(backbone, dimension)
        path = tmp_path / f"{backbone}.pth"
        torch.save(network.state_dict(), path)
        loaded = load_cosplace(path)
        assert (loaded.backbone, loaded.network.dimension) == (backbone, dimension)


class Evil:
    """Runs a command when unpickled."""

    def __reduce__(self) -> Any:
        return os.system, ("touch /tmp/flocc-must-not-exist",)


def broken(name: str, state: dict[str, Any]) -> dict[str, Any]:
    """A state of another network."""
    kept = dict(state)
    if name == "DUSt3R":
        kept = {key: value for key, value in kept.items() if "head_local_features" not in key}
    elif name == "linear head":
        kept = {key: value for key, value in kept.items() if "downstream" not in key}
        kept["downstream_head1.proj.weight"] = torch.zeros(3, 3)
    elif name == "no second decoder":
        kept = {key: value for key, value in kept.items() if not key.startswith("dec_blocks2.")}
    elif name == "missing key":
        del kept["dec_blocks.1.norm_y.bias"]
    elif name == "extra key":
        kept["surplus.weight"] = torch.zeros(1)
    elif name == "other shape":
        kept["enc_norm.bias"] = torch.zeros(7)
    elif name == "integers":
        kept["enc_norm.bias"] = torch.zeros(64, dtype=torch.int64)
    elif name == "not finite":
        kept["enc_norm.bias"] = torch.full((64,), float("nan"))
    elif name == "nothing of it":
        kept = {"fc.weight": torch.zeros(2, 2)}
    return kept


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("DUSt3R", "is a DUSt3R checkpoint"),
        ("linear head", "linear head"),
        ("no second decoder", "dec_blocks2"),
        ("missing key", "lacks 1 of .* 'dec_blocks.1.norm_y.bias'"),
        ("extra key", "does not have: 'surplus.weight'"),
        ("other shape", r"'enc_norm.bias' is \(7,\), not \(64,\)"),
        ("integers", "int64"),
        ("not finite", "not finite"),
        ("nothing of it", "another model"),
    ],
)
def test_files_of_another_network_are_refused_with_the_reason(
    tmp_path: Path, state: dict[str, Any], name: str, sentence: str
) -> None:
    path = write_pth(tmp_path / "wrong.pth", broken(name, state))
    with pytest.raises(BadCheckpoint, match=sentence) as refused:
        load_mast3r(path, TINY)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_trained_at_224_pixels_is_refused_without_evaluating_its_arguments(
    tmp_path: Path, state: dict[str, Any]
) -> None:
    path = write_pth(tmp_path / "small.pth", state, "AsymmetricMASt3R(img_size=(224, 224), head_type='catmlp+dpt')")
    with pytest.raises(BadCheckpoint, match="224x224"):
        load_mast3r(path, TINY)


def test_the_official_size_refuses_a_reduced_network(tmp_path: Path, state: dict[str, Any]) -> None:
    with pytest.raises(BadCheckpoint, match="lacks"):
        load_mast3r(write_pth(tmp_path / "tiny.pth", state), FULL)


def test_pickled_code_is_refused_and_not_run(tmp_path: Path) -> None:
    marker = Path("/tmp/flocc-must-not-exist")
    path = tmp_path / "evil.pth"
    torch.save({"model": {"a": torch.zeros(1)}, "args": Evil()}, path)
    with pytest.raises(BadCheckpoint, match="pickled code"):
        read_checkpoint(path)
    assert not marker.exists()


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.99])
@pytest.mark.parametrize("suffix", ["pth", "safetensors"])
def test_truncated_files_are_refused(tmp_path: Path, state: dict[str, Any], share: float, suffix: str) -> None:
    writer = write_pth if suffix == "pth" else write_safetensors
    path = writer(tmp_path / f"cut.{suffix}", without_aliases(state))
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(BadCheckpoint, match="truncated"):
        load_mast3r(path, TINY)


@pytest.mark.parametrize(
    "entry",
    [
        {"dtype": "F32", "shape": [2, 2], "data_offsets": [0, 8]},
        {"dtype": "F32", "shape": [2], "data_offsets": [-8, 0]},
        {"dtype": "F32", "shape": [-1], "data_offsets": [0, 4]},
        {"dtype": "F99", "shape": [2], "data_offsets": [0, 8]},
        {"dtype": "F32", "shape": [2**62], "data_offsets": [0, 8]},
        {"dtype": "F32"},
        [],
    ],
)
def test_malformed_safetensors_tables_are_refused(tmp_path: Path, entry: Any) -> None:
    header = json.dumps({"a": entry}).encode()
    path = tmp_path / "bad.safetensors"
    path.write_bytes(struct.pack("<Q", len(header)) + header + bytes(8))
    with pytest.raises(BadCheckpoint, match=r"bad\.safetensors"):
        read_checkpoint(path)


def test_missing_files_and_folders_are_refused(tmp_path: Path) -> None:
    for path, said in ((tmp_path / "nothing.pth", "cannot be read"), (tmp_path, "is not a file")):
        with pytest.raises(BadCheckpoint, match=said):
            read_checkpoint(path)


def test_a_text_file_and_a_cosplace_file_are_no_mast3r(tmp_path: Path) -> None:
    text = tmp_path / "page.pth"
    text.write_text("<html>accept the licence first</html>")
    with pytest.raises(BadCheckpoint, match="no torch checkpoint"):
        load_mast3r(text, TINY)
    place = tmp_path / "place.pth"
    torch.save(keyed_cosplace().state_dict(), place)
    with pytest.raises(BadCheckpoint, match="CosPlace"):
        load_mast3r(place, TINY)
