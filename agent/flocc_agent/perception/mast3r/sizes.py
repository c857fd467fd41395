"""Sizes of the MASt3R network: the official one and the reduced ones of the tests. Pure numbers, no torch."""

from dataclasses import dataclass

PATCH_PX = 16
LOCAL_DIMENSION = 24


@dataclass(frozen=True, slots=True)
class Mast3rSizes:
    """Hyper-parameters that fix every parameter's shape; the default is ViT-Large / base decoder.

    Attributes:
        encoder_depth: Encoder blocks.
        encoder_dim: Channels of the encoder and of a latent.
        encoder_heads: Attention heads of the encoder.
        decoder_depth: Blocks of each of the two decoder branches.
        decoder_dim: Channels of the decoder.
        decoder_heads: Attention heads of the decoder.
        feature_dim: Channels of the DPT head's fusion blocks.
        last_dim: Channels before the DPT head's last convolution.
        layer_dims: Channels of the DPT head's four input levels.
    """

    encoder_depth: int = 24
    encoder_dim: int = 1024
    encoder_heads: int = 16
    decoder_depth: int = 12
    decoder_dim: int = 768
    decoder_heads: int = 12
    feature_dim: int = 256
    last_dim: int = 128
    layer_dims: tuple[int, int, int, int] = (96, 192, 384, 768)

    def __post_init__(self) -> None:
        if self.encoder_dim % (4 * self.encoder_heads) or self.decoder_dim % (4 * self.decoder_heads):
            raise ValueError("the dimension of an attention head must be a multiple of 4 (2-D rotary embedding)")
        if self.decoder_depth < 3:
            raise ValueError(f"decoder depth {self.decoder_depth} leaves the DPT head no four different levels")

    def hooks(self) -> tuple[int, int, int, int]:
        """Entries of the decoder's token list that feed the DPT head: the latent and three block outputs."""
        return 0, self.decoder_depth * 2 // 4, self.decoder_depth * 3 // 4, self.decoder_depth


FULL = Mast3rSizes()
SMALL = Mast3rSizes(3, 128, 2, 12, 128, 2)
TINY = Mast3rSizes(2, 64, 4, 4, 48, 3, 16, 8, (8, 12, 16, 24))
NAMED_SIZES = {"full": FULL, "small": SMALL, "tiny": TINY}
