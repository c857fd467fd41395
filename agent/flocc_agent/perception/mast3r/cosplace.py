"""CosPlace: a global place descriptor from a ResNet or VGG16 backbone, GeM pooling and one linear layer.

Plain torch; parameter names equal the official files' (`{Backbone}_{dim}_cosplace.pth`, a bare state dict).
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

GEM_CLAMP = 1e-6
NORM_EPS = 1e-12
RESNET_WIDTHS = (64, 128, 256, 512)
VGG16_LAYERS = (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512)  # 0 is a max pooling


def conv_bn(channels_in: int, channels_out: int, kernel: int, stride: int) -> tuple[nn.Conv2d, nn.BatchNorm2d]:
    """A bias-free convolution that keeps the size (up to its stride), and its batch normalisation."""
    conv = nn.Conv2d(channels_in, channels_out, kernel, stride, padding=kernel // 2, bias=False)
    return conv, nn.BatchNorm2d(channels_out)


def downsampling(channels_in: int, channels_out: int, stride: int) -> nn.Sequential | None:
    """The shortcut's projection, where the block changes the shape."""
    if stride == 1 and channels_in == channels_out:
        return None
    return nn.Sequential(*conv_bn(channels_in, channels_out, 1, stride))


class BasicBlock(nn.Module):
    """Two 3x3 convolutions with a shortcut (ResNet18)."""

    EXPANSION = 1

    def __init__(self, channels_in: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = conv_bn(channels_in, width, 3, stride)
        self.conv2, self.bn2 = conv_bn(width, width, 3, 1)
        self.downsample = downsampling(channels_in, width, stride)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to (B, width, H / stride, W / stride)."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = functional.relu(self.bn1(self.conv1(x)))
        return functional.relu(self.bn2(self.conv2(x)) + shortcut)


class Bottleneck(nn.Module):
    """1x1, 3x3 (which carries the stride) and 1x1 convolutions with a shortcut (ResNet50 and deeper)."""

    EXPANSION = 4

    def __init__(self, channels_in: int, width: int, stride: int) -> None:
        super().__init__()
        channels_out = width * self.EXPANSION
        self.conv1, self.bn1 = conv_bn(channels_in, width, 1, 1)
        self.conv2, self.bn2 = conv_bn(width, width, 3, stride)
        self.conv3, self.bn3 = conv_bn(width, channels_out, 1, 1)
        self.downsample = downsampling(channels_in, channels_out, stride)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to (B, 4 * width, H / stride, W / stride)."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = functional.relu(self.bn1(self.conv1(x)))
        x = functional.relu(self.bn2(self.conv2(x)))
        return functional.relu(self.bn3(self.conv3(x)) + shortcut)


Block = type[BasicBlock] | type[Bottleneck]


def resnet_features(block: Block, depths: tuple[int, int, int, int]) -> nn.Sequential:
    """A ResNet without its pooling and classifier, children numbered as in the official files."""
    stages: list[nn.Module] = []
    channels = 64
    for k, (width, depth) in enumerate(zip(RESNET_WIDTHS, depths, strict=True)):
        blocks: list[nn.Module] = []
        for j in range(depth):
            blocks.append(block(channels, width, 2 if j == 0 and k > 0 else 1))
            channels = width * block.EXPANSION
        stages.append(nn.Sequential(*blocks))
    return nn.Sequential(*conv_bn(3, 64, 7, 2), nn.ReLU(), nn.MaxPool2d(3, 2, 1), *stages)


def vgg16_features() -> nn.Sequential:
    """VGG16's convolutions without the last ReLU and max pooling."""
    layers: list[nn.Module] = []
    channels = 3
    for width in VGG16_LAYERS:
        if width == 0:
            layers.append(nn.MaxPool2d(2, 2))
            continue
        layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
        channels = width
    return nn.Sequential(*layers[:-1])


@dataclass(frozen=True, slots=True)
class Backbone:
    """A backbone's constructor and the channels it gives."""

    build: Callable[[], nn.Sequential]
    channels: int


BACKBONES = {
    "ResNet18": Backbone(lambda: resnet_features(BasicBlock, (2, 2, 2, 2)), 512),
    "ResNet50": Backbone(lambda: resnet_features(Bottleneck, (3, 4, 6, 3)), 2048),
    "ResNet101": Backbone(lambda: resnet_features(Bottleneck, (3, 4, 23, 3)), 2048),
    "ResNet152": Backbone(lambda: resnet_features(Bottleneck, (3, 8, 36, 3)), 2048),
    "VGG16": Backbone(vgg16_features, 512),
}


class UnitLength(nn.Module):
    """L2 normalisation over channels."""

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, ...) to the same shape, of unit length along C."""
        return functional.normalize(x, dim=1, eps=NORM_EPS)


class GeM(nn.Module):
    """Generalised mean over all positions, with a learned exponent."""

    def __init__(self) -> None:
        super().__init__()
        self.p = nn.Parameter(torch.full((1,), 3.0))

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to (B, C)."""
        return x.clamp(min=GEM_CLAMP).pow(self.p).mean(dim=(2, 3)).pow(1.0 / self.p)


class CosPlace(nn.Module):
    """Images to unit-length place descriptors.

    Args:
        backbone: One of `BACKBONES`.
        dimension: Length of a descriptor.
    """

    def __init__(self, backbone: str = "ResNet18", dimension: int = 512) -> None:
        super().__init__()
        kind = BACKBONES[backbone]
        self.dimension = dimension
        self.backbone = kind.build()
        # Index 2 is the flattening: the numbers are part of the names.
        self.aggregation = nn.Sequential(
            UnitLength(), GeM(), nn.Flatten(), nn.Linear(kind.channels, dimension), UnitLength()
        )

    def forward(self, images: Tensor) -> Tensor:
        """Map ImageNet-normalised images (B, 3, H, W) of any size to (B, dimension)."""
        return self.aggregation(self.backbone(images))  # type: ignore[no-any-return]
