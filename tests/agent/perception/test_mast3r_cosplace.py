"""CosPlace against the reference's descriptors on keyed random weights."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch, an optional extra, is not installed")

from tests.agent.perception.mast3r_examples import golden, keyed_cosplace  # noqa: E402

from flocc_agent.perception.mast3r.cosplace import CosPlace  # noqa: E402
from flocc_agent.perception.mast3r.keyed import COSPLACE_SEED, keyed_image  # noqa: E402
from flocc_agent.perception.mast3r.preprocess import place_input  # noqa: E402

OFFICIAL = [
    ("ResNet18", 512, 123, 11_439_169),
    ("ResNet50", 512, 321, 24_557_121),
    ("ResNet101", 512, 627, 43_549_249),
    ("VGG16", 512, 29, 14_977_345),
]


@pytest.mark.golden
@pytest.mark.parametrize("dimension", [64, 512])
def test_describes_as_the_reference(dimension: int) -> None:
    case = golden(f"cosplace_ResNet18_{dimension}.pt")
    network = keyed_cosplace(case["backbone"], case["dim"])
    assert {key: list(value.shape) for key, value in network.state_dict().items()} == case["shapes"]
    for record in case["recs"]:
        height, width, batch = record["size"]
        images = keyed_image(COSPLACE_SEED, f"image/cos/{height}x{width}", batch, height, width)
        with torch.inference_mode():
            descriptors = network(torch.from_numpy(images))
        assert float((descriptors - record["desc"]).abs().max()) < 1e-6


@pytest.mark.golden
def test_prepares_pictures_as_the_official_code_and_swarm_slam() -> None:
    case = golden("cosplace_pre.pt")
    pixels = case["inp"].numpy()
    assert np.array_equal(place_input(pixels, "swarm-slam")[0], case["swarmslam_376_224"].numpy())
    assert np.array_equal(place_input(pixels, "shorter-side", 320)[0][:, ::7, ::7], case["resize320"].numpy())
    plain = place_input(pixels, "native")[0]
    assert np.array_equal(plain[:, ::31, ::29], case["plain_probe"].numpy())


@pytest.mark.parametrize(("backbone", "dimension", "tensors", "parameters"), OFFICIAL)
def test_has_the_official_number_of_tensors_and_parameters(
    backbone: str, dimension: int, tensors: int, parameters: int
) -> None:
    with torch.device("meta"):
        network = CosPlace(backbone, dimension)
    assert len(network.state_dict()) == tensors
    assert sum(parameter.numel() for parameter in network.parameters()) == parameters


def test_vgg16_has_the_official_names() -> None:
    with torch.device("meta"):
        names = list(CosPlace("VGG16", 64).state_dict())
    convolutions = [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]
    expected = [f"backbone.{k}.{part}" for k in convolutions for part in ("weight", "bias")]
    assert names == [*expected, "aggregation.1.p", "aggregation.3.weight", "aggregation.3.bias"]


@pytest.mark.parametrize("backbone", ["ResNet50", "VGG16"])
def test_other_backbones_give_unit_descriptors_of_any_picture_size(backbone: str) -> None:
    network = keyed_cosplace(backbone, 32)
    with torch.inference_mode():
        descriptors = network(torch.from_numpy(keyed_image(COSPLACE_SEED, "other", 2, 64, 90)))
    assert descriptors.shape == (2, 32)
    assert torch.allclose(descriptors.norm(dim=1), torch.ones(2), atol=1e-5)
