"""How a painted scene looks: colours, lines, light, backdrop, lens and noise, drawn from two disjoint pools.

Vision is trained on the pool `train` and judged on `unseen`, whose foam and line colours, backgrounds and kinds of
clutter appear in no training picture.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Float


class Pool(Enum):
    """Which styles may be drawn."""

    train = "train"
    unseen = "unseen"


Range = tuple[float, float]
Paint = tuple[Range, Range, Range]  # hue in degrees, saturation, brightness


@dataclass(frozen=True)
class Palette:
    """What a pool has to offer: pairs of (foam, lines) that can be told apart, backdrops and kinds of clutter."""

    pairs: tuple[tuple[Paint, Paint], ...]
    backdrops: tuple[str, ...]
    clutter: tuple[str, ...]


_BLACK: Paint = ((0.0, 360.0), (0.0, 0.25), (0.03, 0.16))
_RED: Paint = ((-8.0, 8.0), (0.7, 0.95), (0.35, 0.7))
_BLUE: Paint = ((212.0, 235.0), (0.7, 0.95), (0.3, 0.65))
_WHITE: Paint = ((0.0, 360.0), (0.0, 0.06), (0.85, 1.0))
_BROWN: Paint = ((18.0, 30.0), (0.6, 0.85), (0.18, 0.35))
_PURPLE: Paint = ((272.0, 305.0), (0.6, 0.9), (0.25, 0.55))
_TEAL: Paint = ((172.0, 192.0), (0.7, 0.95), (0.2, 0.42))
_YELLOW: Paint = ((50.0, 60.0), (0.5, 0.8), (0.85, 1.0))

PALETTES = {
    Pool.train: Palette(
        pairs=(
            (((35.0, 50.0), (0.08, 0.3), (0.65, 0.95)), _BLACK),  # cream upholstery foam, felt pen
            (((200.0, 230.0), (0.05, 0.25), (0.55, 0.85)), _BLACK),  # grey-blue packing foam
            (((95.0, 140.0), (0.2, 0.45), (0.5, 0.8)), _BLACK),  # green
            (((35.0, 50.0), (0.08, 0.3), (0.65, 0.95)), _RED),
            (((35.0, 50.0), (0.08, 0.3), (0.65, 0.95)), _BLUE),
            (((200.0, 230.0), (0.05, 0.3), (0.15, 0.35)), _WHITE),  # dark foam, chalk
        ),
        backdrops=("plaster", "gradient", "planks", "tiles"),
        clutter=("rectangles", "discs", "lines", "square_grid", "capitals"),
    ),
    Pool.unseen: Palette(
        pairs=(
            (((330.0, 352.0), (0.15, 0.4), (0.65, 0.95)), _PURPLE),  # pink bath sponge
            (((52.0, 64.0), (0.35, 0.65), (0.7, 0.95)), _TEAL),  # yellow sponge
            (((160.0, 180.0), (0.15, 0.4), (0.6, 0.9)), _BROWN),  # mint
            (((14.0, 26.0), (0.35, 0.6), (0.7, 0.95)), _PURPLE),  # salmon
            (((285.0, 310.0), (0.15, 0.35), (0.16, 0.32)), _YELLOW),  # dark violet, light lines
        ),
        backdrops=("bricks", "curtain", "cork"),
        clutter=("polygons", "cables", "diamond_lattice", "window", "sentence"),
    ),
}


@dataclass(frozen=True)
class Style:
    """One look. Colours are BGR, 0 to 255.

    foam, line [3]; line_width, line_wobble, line_bleed [m]: of the painted lines, their deviation between crossings
    (crossings stay where they are) and their soft edge; fading: how unevenly the pen covered, 0 to 1. pores: share of
    the surface. blotch: contrast of large stains. clamp [3]: colour; clamp_reach (above, below, outward, forward) [m].
    backdrop, clutter: kinds, and how many pieces. ambient: light without direction, 0 to 1; light [3]: unit vector
    towards the lamp in the camera's frame; gradient [2]: change of brightness over half a picture; shade: strength of
    a soft shadow across the scene; wall [m]: distance behind the beam. blur [px], noise (grey levels at mid grey),
    exposure: factor on all brightness. seed: of everything that is drawn at random within the look.
    """

    pool: Pool
    foam: Float[np.ndarray, "3"]
    line: Float[np.ndarray, "3"]
    line_width: float
    line_wobble: float
    line_bleed: float
    fading: float
    pores: float
    blotch: float
    clamp: Float[np.ndarray, "3"]
    clamp_reach: tuple[float, float, float, float]
    backdrop: str
    clutter: tuple[str, ...]
    pieces: int
    ambient: float
    light: Float[np.ndarray, "3"]
    gradient: Float[np.ndarray, "2"]
    shade: float
    wall: float
    blur: float
    noise: float
    exposure: float
    seed: int


def draw_colour(rng: np.random.Generator, paint: Paint) -> Float[np.ndarray, "3"]:
    """BGR colour, 0 to 255, from ranges of hue [degrees], saturation and brightness."""
    hue, saturation, brightness = (rng.uniform(*limits) for limits in paint)
    return 255.0 * np.array(colorsys.hsv_to_rgb(hue / 360.0 % 1.0, saturation, brightness)[::-1])


def draw_style(rng: np.random.Generator, pool: Pool) -> Style:
    """A random look of a pool."""
    palette = PALETTES[pool]
    foam, line = palette.pairs[rng.integers(len(palette.pairs))]
    light = np.array([rng.uniform(-0.7, 0.7), rng.uniform(-1.3, -0.4), -1.0])
    return Style(
        pool=pool,
        foam=draw_colour(rng, foam),
        line=draw_colour(rng, line),
        line_width=rng.uniform(0.0045, 0.0085),
        line_wobble=rng.uniform(0.0, 0.0009),
        line_bleed=rng.uniform(0.0, 0.0008),
        fading=rng.uniform(0.0, 0.22),
        pores=rng.uniform(0.004, 0.03),
        blotch=rng.uniform(0.02, 0.09),
        clamp=draw_colour(rng, ((0.0, 360.0), (0.0, 0.35), (0.12, 0.6))),
        clamp_reach=(rng.uniform(0.01, 0.08), rng.uniform(0.01, 0.08), rng.uniform(0.03, 0.2), rng.uniform(0.0, 0.015)),
        backdrop=str(rng.choice(palette.backdrops)),
        clutter=palette.clutter,
        pieces=int(rng.integers(3, 13)),
        ambient=rng.uniform(0.4, 0.75),
        light=light / np.linalg.norm(light),
        gradient=rng.uniform(-0.3, 0.3, 2),
        shade=rng.uniform(0.2, 0.5) if rng.random() < 0.5 else 0.0,
        wall=rng.uniform(0.05, 0.4),
        blur=rng.uniform(0.35, 0.9),
        noise=rng.uniform(0.8, 4.5),
        exposure=rng.uniform(0.8, 1.15),
        seed=int(rng.integers(2**31)),
    )
