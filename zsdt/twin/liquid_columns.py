"""The column-wise correction of the seed: every vertical column of the liquid is stretched to the seen height.

`gamma = (h_target - h_bottom) / (h_pred - h_bottom)`, `z_new = h_bottom + gamma (z - h_bottom)`, and nobody above the
target (seed, "Real-Time Surface Tracking"). The seen line is taken for all depths behind and in front of it; the mean
of the targets is that of the prediction, so that no liquid is made. Neighbouring columns stretch differently, which a
liquid does not do: the crowding that is left behind is why `LiquidMethod.modes` exists.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from zsdt.scene import VesselShape
from zsdt.twin.liquid_assimilation import LiquidAssimilationOptions

DEGREE = 3  # of the polynomial in x through the seen gaps
STRETCH = (0.8, 1.25)  # of a column in one frame


@dataclass(frozen=True)
class Stretch:
    """Moves [n, 3] m of the particles, and which places [c] were believed."""

    move: Float[np.ndarray, "n 3"]
    taken: Bool[np.ndarray, " c"]


def stretch_columns(
    shape: VesselShape,
    position: Float[np.ndarray, "n 3"],
    places: Float[np.ndarray, "c 2"],
    gap: Float[np.ndarray, " c"],
    seen: Bool[np.ndarray, " c"],
    surface: Callable[[Float[np.ndarray, "m 2"]], Float[np.ndarray, " m"]],
    options: LiquidAssimilationOptions,
) -> Stretch:
    """Stretches the columns under seen places, whose surface is `gap` [m] higher than predicted, and those behind.

    surface: predicted heights [m] over places (x, y) [m].
    """
    usual = max(3.0 * options.noise, 1.5 * float(np.median(np.abs(gap[seen]))))
    taken = seen & (np.abs(gap) <= options.gate * usual)
    if taken.sum() <= DEGREE:
        return Stretch(np.zeros_like(position), np.zeros_like(taken))
    x = np.clip(position[:, 0], places[taken, 0].min(), places[taken, 0].max())
    width = float(np.max(shape.radii))
    fit = np.polynomial.polynomial.polyfit(places[taken, 0] / width, gap[taken], DEGREE)
    rise = np.polynomial.polynomial.polyval(x / width, fit)
    bottom = wall_below(shape, position)
    predicted = np.maximum(surface(position[:, :2]), position[:, 2])
    depth = np.maximum(predicted - bottom, 1e-3)
    rise -= float(np.average(rise, weights=1.0 / depth))  # each particle stands for 1/depth of a column's area
    gamma = np.clip(1.0 + options.gain * rise / depth, *STRETCH)
    new = bottom + gamma * (position[:, 2] - bottom)
    new = np.minimum(new, np.maximum(predicted + options.gain * rise, bottom))
    move = np.zeros_like(position)
    move[:, 2] = new - position[:, 2]
    return Stretch(move, taken)


def wall_below(shape: VesselShape, position: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Height [m] of the wall or floor straight below particles at `position` [m]."""
    if not shape.is_round:
        return np.zeros(len(position))
    heights, radii = np.array(shape.heights), np.array(shape.radii)
    widest = int(np.argmax(radii))
    if widest == 0:
        return np.zeros(len(position))
    rising = np.maximum.accumulate(radii[: widest + 1])
    return np.interp(np.hypot(position[:, 0], position[:, 1]), rising, heights[: widest + 1], left=0.0)
