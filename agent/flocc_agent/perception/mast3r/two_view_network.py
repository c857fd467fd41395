"""MASt3R: encoder, two-branch decoder, heads and post-processing, cut after the encoder.

Parameter names equal the official checkpoint's, so that it loads strictly. The network knows nothing of files,
images, wire formats or devices' choice.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from flocc_agent.perception.mast3r.dpt import DptHead
from flocc_agent.perception.mast3r.rope import Rotation, grid_rotation
from flocc_agent.perception.mast3r.sizes import FULL, LOCAL_DIMENSION, PATCH_PX, Mast3rSizes
from flocc_agent.perception.mast3r.transformer_blocks import AttentionKind, DecoderBlock, EncoderBlock, layer_norm

Grid = tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class DenseView:
    """Dense outputs of one view, float32.

    Attributes:
        pts3d: (B, H, W, 3) points in view 1's camera frame (x right, y down, z forward), network units.
        conf: (B, H, W) confidence of the points, >= 1.
        desc: (B, H, W, 24) local descriptors of unit length.
        desc_conf: (B, H, W) confidence of the descriptors, > 0.
    """

    pts3d: Tensor
    conf: Tensor
    desc: Tensor
    desc_conf: Tensor


def postprocess(dense: Tensor, local: Tensor) -> DenseView:
    """Turn raw head outputs into points, descriptors and confidences.

    Args:
        dense: (B, 4, H, W) raw points and confidence.
        local: (B, 25, H, W) raw descriptors and their confidence.
    """
    dense = dense.permute(0, 2, 3, 1)
    local = local.permute(0, 2, 3, 1)
    direction = dense[..., :3]
    length = direction.norm(dim=-1, keepdim=True)
    desc = local[..., :LOCAL_DIMENSION]
    return DenseView(
        pts3d=direction / length.clamp(min=1e-8) * torch.expm1(length),
        conf=1.0 + dense[..., 3].exp(),
        desc=desc / desc.norm(dim=-1, keepdim=True),
        desc_conf=local[..., LOCAL_DIMENSION].exp(),
    )


class PatchEmbed(nn.Module):
    """One convolution from pixels to patches."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, dim, PATCH_PX, stride=PATCH_PX)

    def forward(self, images: Tensor) -> Tensor:
        """Map (B, 3, H, W) to tokens (B, S, dim), row-major."""
        return self.proj(images).flatten(2).transpose(1, 2)  # type: ignore[no-any-return]


def patch_grid(height: int, width: int) -> Grid:
    """Rows and columns of patches.

    Raises:
        ValueError: A side is not a positive multiple of 16.
    """
    if height < PATCH_PX or width < PATCH_PX or height % PATCH_PX or width % PATCH_PX:
        raise ValueError(f"image size {width}x{height} must be positive multiples of {PATCH_PX}")
    return height // PATCH_PX, width // PATCH_PX


class Mast3r(nn.Module):
    """The whole network, or only its encoder for a robot that does not decode.

    ```
    latent_1 = network.encode(images_1)                      # (B, S, 1024)
    latent_2 = network.encode(images_2)
    view_1, view_2 = network.decode(latent_1, (384, 512), latent_2, (384, 512))
    ```
    """

    def __init__(
        self,
        sizes: Mast3rSizes = FULL,
        with_decoder: bool = True,
        attention: AttentionKind = AttentionKind.SDPA,
    ) -> None:
        super().__init__()
        self.sizes = sizes
        self.with_decoder = with_decoder
        encoder = (sizes.encoder_dim, sizes.encoder_heads, attention)
        self.patch_embed = PatchEmbed(sizes.encoder_dim)
        self.enc_blocks = nn.ModuleList([EncoderBlock(*encoder) for _ in range(sizes.encoder_depth)])
        self.enc_norm = layer_norm(sizes.encoder_dim)
        if with_decoder:
            self._add_decoder(attention)

    def _add_decoder(self, attention: AttentionKind) -> None:
        sizes = self.sizes
        decoder = (sizes.decoder_dim, sizes.decoder_heads, attention)
        self.mask_token = nn.Parameter(torch.zeros(1, 1, sizes.decoder_dim))  # unused, but in the official file
        self.decoder_embed = nn.Linear(sizes.encoder_dim, sizes.decoder_dim)
        self.dec_blocks = nn.ModuleList([DecoderBlock(*decoder) for _ in range(sizes.decoder_depth)])
        self.dec_blocks2 = nn.ModuleList([DecoderBlock(*decoder) for _ in range(sizes.decoder_depth)])
        self.dec_norm = layer_norm(sizes.decoder_dim)
        self.downstream_head1 = DptHead(sizes)
        self.downstream_head2 = DptHead(sizes)

    def encode(self, images: Tensor) -> Tensor:
        """Compute latents, the tensors after `enc_norm`.

        Args:
            images: (B, 3, H, W) in [-1, 1]; sides are multiples of 16. Portrait images go in as they are.

        Returns:
            (B, S, encoder_dim) in the network's dtype, S = H / 16 * W / 16.

        Raises:
            ValueError: A side is not a positive multiple of 16.
        """
        grid = patch_grid(images.shape[-2], images.shape[-1])
        x = self.patch_embed(images.to(self.patch_embed.proj.weight.dtype))
        rotation = grid_rotation(*grid, self.sizes.encoder_dim // self.sizes.encoder_heads, x.device)
        for block in self.enc_blocks:
            x = block(x, rotation)
        return self.enc_norm(x)  # type: ignore[no-any-return]

    def _rotation(self, grid: Grid, device: torch.device) -> Rotation:
        return grid_rotation(*grid, self.sizes.decoder_dim // self.sizes.decoder_heads, device)

    def decoder_tokens(
        self, latent_1: Tensor, grid_1: Grid, latent_2: Tensor, grid_2: Grid
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Token lists of both branches: the latent, then each block's output, the last one normalised.

        Both branches of a level read the level below (simultaneously, not one after the other).
        """
        rotation_1, rotation_2 = self._rotation(grid_1, latent_1.device), self._rotation(grid_2, latent_2.device)
        a, b = self.decoder_embed(latent_1), self.decoder_embed(latent_2)
        tokens_1, tokens_2 = [latent_1], [latent_2]
        for block_1, block_2 in zip(self.dec_blocks, self.dec_blocks2, strict=True):
            a, b = block_1(a, b, rotation_1, rotation_2), block_2(b, a, rotation_2, rotation_1)
            tokens_1.append(a)
            tokens_2.append(b)
        tokens_1[-1], tokens_2[-1] = self.dec_norm(a), self.dec_norm(b)
        return tokens_1, tokens_2

    def heads(
        self, tokens_1: Sequence[Tensor], grid_1: Grid, tokens_2: Sequence[Tensor], grid_2: Grid
    ) -> tuple[DenseView, DenseView]:
        """Dense outputs of both views from their token lists."""
        dtype = self.downstream_head1.head_local_features.fc1.weight.dtype
        raw_1 = self.downstream_head1([tokens.to(dtype) for tokens in tokens_1], grid_1)
        raw_2 = self.downstream_head2([tokens.to(dtype) for tokens in tokens_2], grid_2)
        return postprocess(*raw_1), postprocess(*raw_2)

    def compile_parts(self) -> None:
        """Run blocks and heads through torch.compile from now on; the first run of each size takes long."""
        self.encode = torch.compile(self.encode)  # type: ignore[method-assign]
        if self.with_decoder:
            self.decoder_tokens = torch.compile(self.decoder_tokens)  # type: ignore[method-assign]
            self.heads = torch.compile(self.heads)  # type: ignore[method-assign]

    def decode(
        self, latent_1: Tensor, size_1: tuple[int, int], latent_2: Tensor, size_2: tuple[int, int]
    ) -> tuple[DenseView, DenseView]:
        """Decode two latents together; both views' points are in view 1's camera frame.

        Args:
            latent_1: (B, S1, encoder_dim) in any float dtype.
            size_1: Height and width of image 1, pixels.
            latent_2: (B, S2, encoder_dim).
            size_2: Height and width of image 2, pixels; may differ from image 1's.

        Raises:
            ValueError: This network was built without its decoder, or a latent does not fit its image size.
        """
        if not self.with_decoder:
            raise ValueError("this network holds the encoder only and cannot decode")
        grid_1, grid_2 = patch_grid(*size_1), patch_grid(*size_2)
        for latent, grid in ((latent_1, grid_1), (latent_2, grid_2)):
            if latent.shape[1:] != (grid[0] * grid[1], self.sizes.encoder_dim):
                raise ValueError(f"latent {tuple(latent.shape)} does not fit a grid of {grid[1]}x{grid[0]} patches")
        dtype = self.decoder_embed.weight.dtype
        tokens_1, tokens_2 = self.decoder_tokens(latent_1.to(dtype), grid_1, latent_2.to(dtype), grid_2)
        return self.heads(tokens_1, grid_1, tokens_2, grid_2)
