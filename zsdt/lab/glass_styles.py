"""How a scene with a glass looks: backdrop, table, tint, light, highlights, drawn from two disjoint pools.

Vision is trained on the pool `train` and judged on `unseen`, whose backdrops, tables, kinds of clutter and colours of
liquids appear in no training picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from zsdt.lab.styles import Paint, Pool, draw_colour


@dataclass(frozen=True)
class GlassPalette:
    """What a pool has to offer: backdrops, tables, kinds of clutter, and hues of liquids."""

    backdrops: tuple[str, ...]
    tables: tuple[str, ...]
    clutter: tuple[str, ...]
    liquids: tuple[Paint, ...]


GLASS_PALETTES = {
    Pool.train: GlassPalette(
        backdrops=("plaster", "gradient", "planks", "tiles", "books", "checks", "velvet"),
        tables=("planks", "gradient", "plaster", "cloth", "velvet"),
        clutter=("rectangles", "discs", "lines", "square_grid", "capitals", "bottles"),
        liquids=(
            ((0.0, 360.0), (0.0, 0.05), (0.94, 1.0)),  # clear
            ((0.0, 360.0), (0.0, 0.05), (0.94, 1.0)),
            ((44.0, 58.0), (0.03, 0.22), (0.9, 1.0)),  # oil
            ((24.0, 38.0), (0.1, 0.35), (0.82, 0.97)),  # tea
            ((190.0, 225.0), (0.04, 0.25), (0.85, 1.0)),  # blue
        ),
    ),
    Pool.unseen: GlassPalette(
        backdrops=("bricks", "curtain", "cork", "shelves"),
        tables=("cork", "marble", "steel"),
        clutter=("polygons", "cables", "diamond_lattice", "window", "sentence", "cans"),
        liquids=(
            ((0.0, 360.0), (0.0, 0.05), (0.94, 1.0)),  # clear
            ((0.0, 360.0), (0.0, 0.05), (0.94, 1.0)),
            ((330.0, 352.0), (0.05, 0.25), (0.85, 1.0)),  # rose
            ((90.0, 140.0), (0.05, 0.25), (0.85, 1.0)),  # green
            ((4.0, 16.0), (0.12, 0.35), (0.85, 0.97)),  # orange
        ),
    ),
}


@dataclass(frozen=True)
class GlassStyle:
    """One look. Colours are BGR as displayed; lengths in m.

    backdrop, clutter, pieces, seed: as `zsdt.lab.styles.Style` has them. table: kind. distance: of the upright
    backdrop behind the plane y = 0; backdrop_width: of its picture, which stands on the table and is centred about
    x = 0; table_size (along x, along y) about the origin. liquid_tint, glass_tint [3]: share of light that passes one
    centimetre. ambient [3]: colour of all that is not backdrop or table, 0 to 255. windows [windows, 5]: lights far
    away: azimuth (from y to x) and elevation [rad] of the middle, half width, half height [rad], brightness (255 is
    white; more is what a highlight is made of). shadow: strength of the soft shadow around the foot, 0 to 1. gradient
    [2]: change of brightness over half a picture. blur [px], noise (grey levels at mid grey), exposure: factor.
    """

    pool: Pool
    backdrop: str
    clutter: tuple[str, ...]
    pieces: int
    table: str
    distance: float
    backdrop_width: float
    table_size: tuple[float, float]
    liquid_tint: Float[np.ndarray, "3"]
    glass_tint: Float[np.ndarray, "3"]
    ambient: Float[np.ndarray, "3"]
    windows: Float[np.ndarray, "windows 5"]
    shadow: float
    gradient: Float[np.ndarray, "2"]
    blur: float
    noise: float
    exposure: float
    seed: int


def _windows(rng: np.random.Generator) -> Float[np.ndarray, "windows 5"]:
    """One to three lights in front of the glass, to its sides or above: their mirror images are the highlights."""
    rows = []
    for _ in range(int(rng.integers(1, 4))):
        azimuth = rng.uniform(0.45, 1.0) * np.pi * rng.choice([-1.0, 1.0])
        rows.append(
            [
                azimuth,
                rng.uniform(0.15, 1.1),
                rng.uniform(0.06, 0.4),
                rng.uniform(0.1, 0.45),
                255.0 * rng.uniform(1.5, 6.0),
            ]
        )
    return np.array(rows)


def draw_glass_style(rng: np.random.Generator, pool: Pool) -> GlassStyle:
    """A random look of a pool."""
    palette = GLASS_PALETTES[pool]
    liquid = palette.liquids[rng.integers(len(palette.liquids))]
    per_glass = draw_colour(rng, liquid) / 255.0  # of light through about three centimetres
    return GlassStyle(
        pool=pool,
        backdrop=str(rng.choice(palette.backdrops)),
        clutter=palette.clutter,
        pieces=int(rng.integers(0, 12)),
        table=str(rng.choice(palette.tables)),
        distance=rng.uniform(0.12, 0.5),
        backdrop_width=rng.uniform(0.8, 1.2),
        table_size=(1.2, 1.2),
        liquid_tint=per_glass ** (1.0 / 3.0),
        glass_tint=np.clip(1.0 - rng.uniform(0.0, 0.04) * np.array([1.0, 0.35, 1.3]), 0.0, 1.0),
        ambient=draw_colour(rng, ((0.0, 360.0), (0.0, 0.15), (0.25, 0.75))),
        windows=_windows(rng),
        shadow=rng.uniform(0.15, 0.6),
        gradient=rng.uniform(-0.25, 0.25, 2),
        blur=rng.uniform(0.35, 0.9),
        noise=rng.uniform(0.8, 4.5),
        exposure=rng.uniform(0.8, 1.15),
        seed=int(rng.integers(2**31)),
    )
