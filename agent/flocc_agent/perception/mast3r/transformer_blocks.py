"""Transformer blocks of the encoder and of the two-branch decoder. Parameter names are the official file's."""

from enum import Enum

from torch import Tensor, nn
from torch.nn import functional

from flocc_agent.perception.mast3r.rope import Rotation, rotate

LAYER_NORM_EPS = 1e-6
MLP_RATIO = 4


class AttentionKind(Enum):
    """How softmax(q k^T / sqrt(d)) v is computed; both are the same mathematics."""

    SDPA = "sdpa"
    EAGER = "eager"


def attend(q: Tensor, k: Tensor, v: Tensor, kind: AttentionKind) -> Tensor:
    """Attention of (B, heads, S, d) queries over (B, heads, T, d) keys and values; gives (B, S, heads * d)."""
    if kind is AttentionKind.SDPA:
        out = functional.scaled_dot_product_attention(q, k, v)
    else:
        weights = (q @ k.transpose(-2, -1)) * q.shape[-1] ** -0.5
        out = weights.softmax(dim=-1) @ v
    return out.transpose(1, 2).flatten(2)


def layer_norm(dim: int) -> nn.LayerNorm:
    """LayerNorm with the network's epsilon; torch's default of 1e-5 costs 5e-5 on the outputs."""
    return nn.LayerNorm(dim, eps=LAYER_NORM_EPS)


class Mlp(nn.Module):
    """Two linear layers with the exact (erf) GELU between."""

    def __init__(self, dim: int, hidden: int, out: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, hidden)
        self.fc2 = nn.Linear(hidden, out)

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., dim) to (..., out)."""
        return self.fc2(functional.gelu(self.fc1(x)))  # type: ignore[no-any-return]


class SelfAttention(nn.Module):
    """Multi-head self-attention with rotary positions; one projection gives q, k and v."""

    def __init__(self, dim: int, heads: int, kind: AttentionKind) -> None:
        super().__init__()
        self.heads = heads
        self.kind = kind
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor, rotation: Rotation) -> Tensor:
        """Map (B, S, dim) to (B, S, dim)."""
        batch, count, _ = x.shape
        q, k, v = self.qkv(x).view(batch, count, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        out: Tensor = self.proj(attend(rotate(q, rotation), rotate(k, rotation), v, self.kind))
        return out


class CrossAttention(nn.Module):
    """Multi-head attention of one view's tokens over the other's, rotary positions on both sides."""

    def __init__(self, dim: int, heads: int, kind: AttentionKind) -> None:
        super().__init__()
        self.heads = heads
        self.kind = kind
        self.projq = nn.Linear(dim, dim)
        self.projk = nn.Linear(dim, dim)
        self.projv = nn.Linear(dim, dim)
        self.proj = nn.Linear(dim, dim)

    def _split(self, x: Tensor) -> Tensor:
        return x.view(x.shape[0], x.shape[1], self.heads, -1).transpose(1, 2)

    def forward(self, x: Tensor, y: Tensor, x_rotation: Rotation, y_rotation: Rotation) -> Tensor:
        """Map queries x (B, S, dim) and the other view's tokens y (B, T, dim) to (B, S, dim)."""
        q = rotate(self._split(self.projq(x)), x_rotation)
        k = rotate(self._split(self.projk(y)), y_rotation)
        return self.proj(attend(q, k, self._split(self.projv(y)), self.kind))  # type: ignore[no-any-return]


class EncoderBlock(nn.Module):
    """Pre-norm transformer block."""

    def __init__(self, dim: int, heads: int, kind: AttentionKind) -> None:
        super().__init__()
        self.norm1 = layer_norm(dim)
        self.attn = SelfAttention(dim, heads, kind)
        self.norm2 = layer_norm(dim)
        self.mlp = Mlp(dim, MLP_RATIO * dim, dim)

    def forward(self, x: Tensor, rotation: Rotation) -> Tensor:
        """Map (B, S, dim) to (B, S, dim)."""
        x = x + self.attn(self.norm1(x), rotation)
        return x + self.mlp(self.norm2(x))  # type: ignore[no-any-return]


class DecoderBlock(nn.Module):
    """Pre-norm block that attends to its own view, then to the other view, whose tokens it does not change."""

    def __init__(self, dim: int, heads: int, kind: AttentionKind) -> None:
        super().__init__()
        self.norm1 = layer_norm(dim)
        self.attn = SelfAttention(dim, heads, kind)
        self.norm2 = layer_norm(dim)
        self.norm_y = layer_norm(dim)
        self.cross_attn = CrossAttention(dim, heads, kind)
        self.norm3 = layer_norm(dim)
        self.mlp = Mlp(dim, MLP_RATIO * dim, dim)

    def forward(self, x: Tensor, y: Tensor, x_rotation: Rotation, y_rotation: Rotation) -> Tensor:
        """Map own tokens x (B, S, dim), given the other view's y (B, T, dim), to (B, S, dim)."""
        x = x + self.attn(self.norm1(x), x_rotation)
        x = x + self.cross_attn(self.norm2(x), self.norm_y(y), x_rotation, y_rotation)
        return x + self.mlp(self.norm3(x))  # type: ignore[no-any-return]


def set_attention(module: nn.Module, kind: AttentionKind) -> None:
    """Switch every attention below a module to one implementation."""
    for part in module.modules():
        if isinstance(part, (SelfAttention, CrossAttention)):
            part.kind = kind
