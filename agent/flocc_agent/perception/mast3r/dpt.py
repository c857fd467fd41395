"""The `catmlp+dpt` head: dense points and confidence from a DPT decoder, local descriptors from an MLP."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from flocc_agent.perception.mast3r.sizes import LOCAL_DIMENSION, PATCH_PX, Mast3rSizes
from flocc_agent.perception.mast3r.transformer_blocks import Mlp

POINT_AND_CONFIDENCE_DIM = 4


def as_map(tokens: Tensor, grid: tuple[int, int]) -> Tensor:
    """Tokens (B, S, C) as a map (B, C, gh, gw); a view, whose memory has channels last."""
    batch, _, channels = tokens.shape
    return tokens.transpose(1, 2).reshape(batch, channels, *grid)


def upsample2(x: Tensor) -> Tensor:
    """Bilinear upsampling by two with aligned corners."""
    return functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)


class ResidualConv(nn.Module):
    """x + conv(relu(conv(relu(x))))."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(dim, dim, 3, padding=1)
        self.conv2 = nn.Conv2d(dim, dim, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, dim, h, w) to the same shape."""
        return x + self.conv2(functional.relu(self.conv1(functional.relu(x))))  # type: ignore[no-any-return]


class Fusion(nn.Module):
    """Adds a finer level to the coarser path and doubles its resolution."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(dim, dim, 1)
        self.resConfUnit1 = ResidualConv(dim)
        self.resConfUnit2 = ResidualConv(dim)

    def forward(self, x: Tensor, level: Tensor | None = None) -> Tensor:
        """Map (B, dim, h, w), and a level of that shape, to (B, dim, 2h, 2w)."""
        if level is not None:
            x = x + self.resConfUnit1(level)
        return self.out_conv(upsample2(self.resConfUnit2(x)))  # type: ignore[no-any-return]


class Scratch(nn.Module):
    """The DPT's level convolutions, registered under both of their official names, and its fusion blocks."""

    def __init__(self, layer_dims: Sequence[int], dim: int) -> None:
        super().__init__()
        convs = [nn.Conv2d(layer_dim, dim, 3, padding=1, bias=False) for layer_dim in layer_dims]
        self.layer1_rn, self.layer2_rn, self.layer3_rn, self.layer4_rn = convs
        self.layer_rn = nn.ModuleList(convs)
        self.refinenet1 = Fusion(dim)
        self.refinenet2 = Fusion(dim)
        self.refinenet3 = Fusion(dim)
        self.refinenet4 = Fusion(dim)


def level_adapters(sizes: Mast3rSizes) -> nn.ModuleList:
    """Convolutions that bring the four token maps to strides 4, 8, 16 and 32."""
    d0, d1, d2, d3 = sizes.layer_dims
    return nn.ModuleList(
        [
            nn.Sequential(nn.Conv2d(sizes.encoder_dim, d0, 1), nn.ConvTranspose2d(d0, d0, 4, stride=4)),
            nn.Sequential(nn.Conv2d(sizes.decoder_dim, d1, 1), nn.ConvTranspose2d(d1, d1, 2, stride=2)),
            nn.Sequential(nn.Conv2d(sizes.decoder_dim, d2, 1)),
            nn.Sequential(nn.Conv2d(sizes.decoder_dim, d3, 1), nn.Conv2d(d3, d3, 3, stride=2, padding=1)),
        ]
    )


class Dpt(nn.Module):
    """Dense prediction from four levels of the token list."""

    def __init__(self, sizes: Mast3rSizes) -> None:
        super().__init__()
        dim, last = sizes.feature_dim, sizes.last_dim
        self.hooks = sizes.hooks()
        self.scratch = Scratch(sizes.layer_dims, dim)
        # Index 1 of `head` is the parameter-free upsampling, 3 the ReLU: the numbers are part of the names.
        self.head = nn.Sequential(
            nn.Conv2d(dim, dim // 2, 3, padding=1),
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True),
            nn.Conv2d(dim // 2, last, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(last, POINT_AND_CONFIDENCE_DIM, 1),
        )
        self.act_postprocess = level_adapters(sizes)

    def levels(self, tokens: Sequence[Tensor], grid: tuple[int, int]) -> list[Tensor]:
        """Token maps at strides 4, 8, 16 and 32, each with its own channels."""
        maps = [as_map(tokens[k], grid) for k in self.hooks]
        return [adapter(x) for adapter, x in zip(self.act_postprocess, maps, strict=True)]

    def fuse(self, levels: Sequence[Tensor], grid: tuple[int, int]) -> list[Tensor]:
        """Paths 4 to 1; the coarsest is cut to the patch grid, which matters where that is odd."""
        s = self.scratch
        l1, l2, l3, l4 = (conv(x) for conv, x in zip(s.layer_rn, levels, strict=True))
        path4 = s.refinenet4(l4)[:, :, : grid[0], : grid[1]]
        path3 = s.refinenet3(path4, l3)
        path2 = s.refinenet2(path3, l2)
        return [path4, path3, path2, s.refinenet1(path2, l1)]

    def forward(self, tokens: Sequence[Tensor], grid: tuple[int, int]) -> Tensor:
        """Raw points and confidence (B, 4, H, W) float32 of a token list and its patch grid."""
        path1 = self.fuse(self.levels(tokens, grid), grid)[-1]
        x = self.head[:-1](path1)
        last = self.head[-1]
        assert isinstance(last, nn.Conv2d)
        assert last.bias is not None
        # The exponentials that follow amplify rounding: the last projection is float32 in every mode.
        return functional.conv2d(x.float(), last.weight.float(), last.bias.float())


class DptHead(nn.Module):
    """One branch's head: raw dense outputs from its token list."""

    def __init__(self, sizes: Mast3rSizes) -> None:
        super().__init__()
        self.dpt = Dpt(sizes)
        features = sizes.encoder_dim + sizes.decoder_dim
        self.head_local_features = Mlp(features, 4 * features, (LOCAL_DIMENSION + 1) * PATCH_PX**2)

    def local(self, tokens: Sequence[Tensor]) -> Tensor:
        """Local features per patch (B, S, 25 * 256) from the latent and the last decoder tokens."""
        return self.head_local_features(torch.cat([tokens[0], tokens[-1]], dim=-1))  # type: ignore[no-any-return]

    def forward(self, tokens: Sequence[Tensor], grid: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Raw points and confidence (B, 4, H, W) and raw local features (B, 25, H, W), float32."""
        local = functional.pixel_shuffle(as_map(self.local(tokens), grid), PATCH_PX)
        return self.dpt(tokens, grid), local.float()
