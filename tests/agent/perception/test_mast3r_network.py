"""MASt3R's networks against the reference's outputs on keyed random weights."""

import pytest

torch = pytest.importorskip("torch", reason="torch, an optional extra, is not installed")

from tests.agent.perception.mast3r_examples import (  # noqa: E402
    deviation,
    golden,
    golden_folder,
    keyed_mast3r,
)

from flocc_agent.perception.mast3r.keyed import (  # noqa: E402
    MAST3R_SEED,
    keyed_image,
    keyed_weight,
)
from flocc_agent.perception.mast3r.rope import grid_rotation, patch_positions, rotate  # noqa: E402
from flocc_agent.perception.mast3r.sizes import FULL, SMALL, TINY, Mast3rSizes  # noqa: E402
from flocc_agent.perception.mast3r.transformer_blocks import AttentionKind, set_attention  # noqa: E402
from flocc_agent.perception.mast3r.two_view_network import Mast3r, patch_grid, postprocess  # noqa: E402

pytestmark = pytest.mark.golden

TINY_CASES = ("tiny_sq", "tiny_land_odd", "tiny_portrait", "tiny_min")
CASES = [*((name, TINY, 1e-5) for name in TINY_CASES), ("small_land", SMALL, 5e-5)]
PARTS = ("pts3d", "conf", "desc", "desc_conf")


@pytest.mark.parametrize("record", range(3))
def test_rotates_as_the_reference(record: int) -> None:
    case = golden("rope.pt")[record]
    assert torch.equal(patch_positions(*case["hw"]), case["pos"][0])
    out = rotate(case["tokens"], grid_rotation(*case["hw"], case["head_dim"], torch.device("cpu")))
    assert deviation(out, case["out"]) < 1e-6


def test_rotation_is_computed_in_float32_for_bfloat16_tokens() -> None:
    tokens = torch.randn(1, 1, 768, 64, generator=torch.Generator().manual_seed(0))
    rotation = grid_rotation(24, 32, 64, torch.device("cpu"))
    assert rotation[0].dtype == rotation[1].dtype == torch.float32
    error = (rotate(tokens.bfloat16(), rotation).float() - rotate(tokens.bfloat16().float(), rotation)).abs().max()
    assert float(error) < 2**-7 * 4.5  # one rounding of a value below 4.5, not of the angle


@pytest.mark.parametrize(("name", "sizes", "tolerance"), CASES)
def test_encodes_and_decodes_as_the_reference(name: str, sizes: Mast3rSizes, tolerance: float) -> None:
    case = golden(f"{name}.pt")
    out = case["out"]
    network = keyed_mast3r(sizes)
    latents = [network.encode(case[image]) for image in ("img1", "img2")]
    views = network.decode(latents[0], tuple(case["size1"]), latents[1], tuple(case["size2"]))
    for k in (0, 1):
        assert deviation(latents[k], out[f"feat{k + 1}"]) < tolerance
        for part in PARTS:
            assert deviation(getattr(views[k], part), out[f"res{k + 1}"][part]) < tolerance, part


@pytest.mark.parametrize("name", TINY_CASES)
def test_inner_values_equal_the_reference(name: str) -> None:
    case = golden(f"{name}.pt")
    out, raw = case["out"], case["out"]["raw"]
    network = keyed_mast3r(TINY)
    grid = patch_grid(*case["size1"])
    tokens = network.decoder_tokens(out["feat1"], grid, out["feat2"], grid)
    for branch, head in ((1, network.downstream_head1), (2, network.downstream_head2)):
        for found, expected in zip(tokens[branch - 1], out[f"dec{branch}"], strict=True):
            assert deviation(found, expected) < 1e-5
        levels = head.dpt.levels(tokens[branch - 1], grid)
        paths = head.dpt.fuse(levels, grid)
        for k, level in enumerate(levels):
            assert deviation(level, raw[f"act{k + 1}_head{branch}"]) < 1e-5
        for k, path in zip((4, 3, 2, 1), paths, strict=True):
            expected = raw[f"path_{k}_head{branch}"]
            assert deviation(path, expected[:, :, : path.shape[2], : path.shape[3]]) < 1e-5
        assert deviation(head.dpt(tokens[branch - 1], grid), raw[f"dpt_raw{branch}"]) < 1e-5
        assert deviation(head.local(tokens[branch - 1]), raw[f"mlp_raw{branch}"]) < 1e-5


def test_keyed_pictures_and_weights_are_the_golden_ones() -> None:
    case, small = golden("tiny_land_odd.pt"), golden("small_keys.pt")
    assert (torch.from_numpy(keyed_image(MAST3R_SEED, "image/land_odd/2", 2, 48, 80)) == case["img2"]).all()
    with torch.device("meta"):
        network = Mast3r(SMALL)
    assert {key: list(value.shape) for key, value in network.state_dict().items()} == small["shapes"]
    for key, expected in small["probe"].items():
        found = torch.from_numpy(keyed_weight(MAST3R_SEED, key, tuple(small["shapes"][key]))).flatten()[:4]
        assert torch.equal(found, expected), key


def test_has_the_1017_official_names_and_shapes() -> None:
    lines = (golden_folder() / "mast3r_keys.txt").read_text().splitlines()
    with torch.device("meta"):
        network, encoder = Mast3r(FULL), Mast3r(FULL, with_decoder=False)
    names = {key: str(tuple(value.shape)) for key, value in network.state_dict().items()}
    assert names == dict(line.split("\t") for line in lines)
    assert len(names) == 1017
    assert sum(parameter.numel() for parameter in network.parameters()) == 688_638_856
    assert len(encoder.state_dict()) == 292
    assert sum(parameter.numel() for parameter in encoder.parameters()) == 303_098_880


def test_post_processes_as_the_reference() -> None:
    case = golden("geom.pt")["postprocess"]
    view = postprocess(case["inp"][:, :4], case["inp"][:, 4:])
    for part in PARTS:
        assert deviation(getattr(view, part), case[part]) < 1e-6


def test_fused_and_unfused_attention_agree() -> None:
    network = keyed_mast3r(TINY)
    images = torch.from_numpy(keyed_image(MAST3R_SEED, "attention", 1, 64, 96))
    fused = network.encode(images)
    set_attention(network, AttentionKind.EAGER)
    assert deviation(network.encode(images), fused) < 1e-5


def test_images_of_two_sizes_decode_together_and_a_batch_equals_its_parts() -> None:
    network = keyed_mast3r(TINY)
    first = torch.from_numpy(keyed_image(MAST3R_SEED, "mixed/1", 2, 48, 80))
    second = torch.from_numpy(keyed_image(MAST3R_SEED, "mixed/2", 2, 64, 32))
    a, b = network.encode(first), network.encode(second)
    view_1, view_2 = network.decode(a, (48, 80), b, (64, 32))
    assert view_1.pts3d.shape == (2, 48, 80, 3)
    assert view_2.desc.shape == (2, 64, 32, 24)
    alone, _ = network.decode(a[1:], (48, 80), b[1:], (64, 32))
    assert deviation(alone.pts3d, view_1.pts3d[1:]) < 1e-5
    assert torch.allclose(view_2.desc.norm(dim=-1), torch.ones(()), atol=1e-5)
    assert float(view_1.conf.min()) >= 1.0
    assert float(view_2.desc_conf.min()) > 0.0


@pytest.mark.parametrize("size", [(30, 48), (0, 16), (16, 8)])
def test_refuses_sizes_that_are_no_multiples_of_the_patch(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="multiples of 16"):
        patch_grid(*size)


def test_refuses_a_latent_that_does_not_fit_its_size_and_a_missing_decoder() -> None:
    network = keyed_mast3r(TINY)
    latent = torch.zeros(1, 6, TINY.encoder_dim)
    with pytest.raises(ValueError, match="does not fit"):
        network.decode(latent, (32, 48), latent, (32, 32))
    with pytest.raises(ValueError, match="encoder only"):
        keyed_mast3r(TINY, with_decoder=False).decode(latent, (32, 48), latent, (32, 48))
