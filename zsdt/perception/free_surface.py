"""The free surface of a liquid as the camera sees it: heights on the wall of the cavity, column by column.

The upper edge of the apparent liquid is where lines of sight, refracted by the wall in front, just miss it: the contact
line on the far wall for a camera that looks down on the surface, on the near wall for one that looks up (see
`zsdt.perception.glass_rays`). The vessel moves along x, so the surface is taken as level into the depth; heights at the
far wall are heights over x. Flashes, drops on the wall and hands leave columns that no smooth surface explains.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from zsdt.errors import OptionError
from zsdt.perception.glass_geometry import VesselFit
from zsdt.perception.glass_rays import FAR, contacts
from zsdt.perception.glass_sight import rays
from zsdt.perception.mask_edges import MaskEdges


@dataclass
class SurfaceOptions:
    """degree: of the smooth curve over x that columns are held against. least_columns: that a curve needs. reach: of
    the half-width of the cavity: columns farther out are seen through too much glass. rejected_px: a column may lie
    off the curve by this much, or by `rejected_spread` times the columns' own spread if that is more. least_above: px
    of container over the surface, else something covers it. least_depth: px of liquid below it."""

    degree: int = 5
    least_columns: int = 15
    reach: float = 0.94
    rejected_px: float = 1.5
    rejected_spread: float = 3.5
    least_above: float = 2.0
    least_depth: float = 4.0

    def __post_init__(self) -> None:
        if not 1 <= self.degree <= 8 or self.least_columns < 2 * (self.degree + 1):
            raise OptionError(
                "degree of a surface must be from 1 to 8, with two columns at least for each coefficient."
            )
        if not 0.2 <= self.reach <= 1.0 or min(self.rejected_px, self.rejected_spread) <= 0:
            raise OptionError("reach must be from 0.2 to 1, rejected_px and rejected_spread positive.")


@dataclass(frozen=True)
class SurfaceProfile:
    """A free surface on the wall of the cavity.

    places [columns, 2] m: (x, y) in the axes of the vessel, on the wall that is seen. height [columns] m: above the
    cavity's floor. seen [columns]: which of them are believed; the others are NaN or outliers. pixels [columns, 2]:
    where they are in the picture. degree: of the curve that `at` draws through them. scale [m]: half-width of the
    cavity at the surface; spread [m]: of the believed columns about the curve.
    """

    places: Float[np.ndarray, "columns 2"]
    height: Float[np.ndarray, " columns"]
    seen: Bool[np.ndarray, " columns"]
    pixels: Float[np.ndarray, "columns 2"]
    degree: int
    scale: float
    spread: float

    @property
    def known(self) -> bool:
        """Whether any column is believed."""
        return bool(self.seen.any())

    @cached_property
    def curve(self) -> Float[np.ndarray, " coefficients"]:
        """Chebyshev coefficients of the height [m] over x / scale."""
        return _curve(self.places[self.seen, 0] / self.scale, self.height[self.seen], self.degree)

    def at(self, x: Float[np.ndarray, " places"]) -> Float[np.ndarray, " places"]:
        """Height [m] at places x [m]; straight on beyond what is seen, NaN where no column is believed."""
        if not self.known:
            return np.full(len(x), np.nan)
        u = np.asarray(x, np.float64) / self.scale
        low, high = (float(f(self.places[self.seen, 0])) / self.scale for f in (np.min, np.max))
        inside = np.clip(u, low, high)
        slope = np.polynomial.chebyshev.chebder(self.curve)
        climb = np.polynomial.chebyshev.chebval(inside, slope)
        return np.asarray(np.polynomial.chebyshev.chebval(inside, self.curve) + climb * (u - inside))

    @property
    def level(self) -> float:
        """Mean height [m] over the width of the cavity."""
        return float(self.at(np.linspace(-0.95, 0.95, 39) * self.scale).mean())

    @property
    def highest(self) -> float:
        """Height [m] of the highest point over the width of the cavity."""
        return float(self.at(np.linspace(-1.0, 1.0, 41) * self.scale).max())


def _curve(
    u: Float[np.ndarray, " columns"], height: Float[np.ndarray, " columns"], degree: int
) -> Float[np.ndarray, " coefficients"]:
    """Least squares with a ridge that only bends where the columns do not speak."""
    basis = np.polynomial.chebyshev.chebvander(u, degree)
    ridge = 1e-3 * len(u) * np.diag(np.arange(degree + 1) ** 4.0) / max(degree, 1) ** 4
    middle = float(np.median(height))
    found = np.linalg.solve(basis.T @ basis + ridge + 1e-12 * np.eye(degree + 1), basis.T @ (height - middle))
    found[0] += middle
    return np.asarray(found)


def observe_surface(
    edges: MaskEdges, fit: VesselFit, x: float, options: SurfaceOptions | None = None
) -> SurfaceProfile:
    """Heights of the surface in one picture, with the axis of the vessel at `x` [m] in the room.

    One entry for each column that has liquid; `seen` is false where the column is covered, is refracted too much, or
    is an outlier. No entry is believed where fewer than `least_columns` agree.
    """
    chosen = options or SurfaceOptions()
    fair = np.isfinite(edges.surface)
    pixels = np.column_stack([edges.columns[fair], edges.surface[fair]])
    points, met = contacts(fit.walls, fit.camera.center - fit.origin(x), rays(fit.camera, pixels))
    height = points[:, 2]
    with np.errstate(invalid="ignore"):
        scale = float(np.interp(np.nanmedian(height) if np.isfinite(height).any() else 0.0,
                                fit.shape.heights, fit.shape.radii))  # fmt: skip
        seen = (met >= FAR) & (np.abs(points[:, 0]) < chosen.reach * scale)
        seen &= (height > 0) & (height < fit.shape.rim)
    seen &= (edges.above[fair] >= chosen.least_above) & (edges.depth[fair] >= chosen.least_depth)
    metres = _metres_per_pixel(fit, x)
    seen, spread = _agreeing(points[:, 0] / scale, height, seen, chosen, metres)
    return SurfaceProfile(points[:, :2], height, seen, pixels, chosen.degree, scale, spread)


def _metres_per_pixel(fit: VesselFit, x: float) -> float:
    """Height [m] of a pixel at the axis."""
    return float(fit.camera.depths(fit.origin(x)[None])[0] / fit.camera.matrix[1, 1])


def _agreeing(
    u: Float[np.ndarray, " columns"],
    height: Float[np.ndarray, " columns"],
    seen: Bool[np.ndarray, " columns"],
    options: SurfaceOptions,
    metres: float,
) -> tuple[Bool[np.ndarray, " columns"], float]:
    """Columns that one smooth curve explains, and their spread [m]. From a stiff curve to a free one, so that a run of
    wrong columns does not draw the curve to itself."""
    found = seen & np.isfinite(height)
    spread = np.nan
    start = found.copy()
    for degree in (1, 1, 2, 3, options.degree, options.degree):
        if found.sum() < options.least_columns:
            return np.zeros_like(seen), float("nan")
        curve = _curve(u[found], height[found], degree)
        with np.errstate(invalid="ignore"):
            off = np.abs(height - np.polynomial.chebyshev.chebval(u, curve))
            spread = 1.4826 * float(np.median(off[found]))
            found = start & (off < max(options.rejected_px * metres, options.rejected_spread * spread))
    return found, spread


def project_surface(
    fit: VesselFit, x: float, places: Float[np.ndarray, "columns 2"], height: Float[np.ndarray, " columns"]
) -> Float[np.ndarray, "columns 2"]:
    """Pixels in which heights [m] at places [m] on the wall of the cavity appear, through the wall in front.

    The opposite of `observe_surface`; x [m]: of the axis of the vessel in the room. NaN where a height is NaN.
    """
    points = np.column_stack([places, height])
    known = np.isfinite(points).all(axis=1)
    target = fit.camera.project(np.where(known[:, None], points, 0.0) + fit.origin(x))
    pixels = target.copy()
    for _ in range(3):
        landed, met = contacts(fit.walls, fit.camera.center - fit.origin(x), rays(fit.camera, pixels))
        fair = (met >= FAR) & np.isfinite(landed).all(axis=1)
        shown = fit.camera.project(np.where(fair[:, None], landed, 0.0) + fit.origin(x))
        pixels = np.where(fair[:, None], pixels + target - shown, pixels)
    return np.where(known[:, None], pixels, np.nan)


def seen_wall(
    fit: VesselFit, x: float, across: Float[np.ndarray, " columns"], height: Float[np.ndarray, " columns"]
) -> Float[np.ndarray, "columns 2"]:
    """Places (x, y) [m] on the wall that the camera sees at heights [m]: far for a camera above the surface, else near.

    across [columns] m: their x in the axes of the vessel; those beyond the cavity are put on its side.
    """
    shape = fit.shape
    half = np.interp(height, shape.heights, shape.radii)
    share = np.clip(np.abs(across) / half, 0.0, 1.0)
    deep = shape.aspect * half * (1.0 - share**shape.exponent) ** (1.0 / shape.exponent)
    above = fit.camera.center[2] > fit.told.floor + np.nanmean(height)
    return np.column_stack([np.clip(across, -half, half), deep if above else -deep])
