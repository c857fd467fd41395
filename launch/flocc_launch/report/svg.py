"""Small pieces of SVG: escaped elements, linear axes, nice ticks."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

PALETTE_SIZE = 8
POINTS_MAX = 1500


def element(name: str, *content: str, **attributes: object) -> str:
    """An element; `class_` is the attribute class, underscores become hyphens, None is left out.

    Content is markup already: escape text with `text_of`.
    """
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(shown(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    return f"<{name}{written}>{''.join(content)}</{name}>"


def shown(value: object) -> str:
    """Attribute value: floats with two decimals at most."""
    return f"{value:.2f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)


def text_of(text: object) -> str:
    """Text as markup."""
    return escape(str(text))


def title(text: object) -> str:
    """What shows when the pointer rests on the element."""
    return element("title", text_of(text))


def svg(width: float, height: float, *content: str, label: str) -> str:
    """A whole drawing that scales with its container."""
    return element("svg", *content, viewBox=f"0 0 {width:g} {height:g}", role="img", aria_label=label)


def path(points: Iterable[tuple[float, float]], class_: str) -> str:
    """A line through points, thinned where there are very many."""
    kept = thinned(list(points))
    d = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in kept) if kept else ""
    return element("path", d=d, class_=class_)


def thinned(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """At most `POINTS_MAX` of the points, the last one among them."""
    step = max(1, math.ceil(len(points) / POINTS_MAX))
    kept = list(points[::step])
    return kept if not points or kept[-1] == points[-1] else [*kept, points[-1]]


@dataclass(frozen=True, slots=True)
class Axis:
    """Linear map from values to pixels."""

    low: float
    high: float
    from_px: float
    to_px: float

    def __call__(self, value: float) -> float:
        """Pixels of a value."""
        span = self.high - self.low or 1.0
        return self.from_px + (value - self.low) / span * (self.to_px - self.from_px)

    def ticks(self, count: int = 6) -> list[float]:
        """Round values within the axis, about `count` of them."""
        step = nice_step((self.high - self.low) / max(count, 1))
        first = math.ceil(self.low / step - 1e-9)
        last = math.floor(self.high / step + 1e-9)
        return [k * step for k in range(first, last + 1)]


def nice_step(rough: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that is not below `rough`."""
    if rough <= 0 or not math.isfinite(rough):
        return 1.0
    power = 10.0 ** math.floor(math.log10(rough))
    return next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= rough * (1 - 1e-9))
