"""Colours for fields: perceptual maps with common limits, and the bar that says what a colour means."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


@dataclass(frozen=True)
class Palette:
    """A named colour map between two limits, in the unit of the field."""

    name: str
    low: float
    high: float

    def colours(self, values: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape 4"]:
        """RGBA of values; those beyond the limits get the colour of the limit, those that are not finite grey."""
        span = max(self.high - self.low, 1e-30)
        finite = np.isfinite(values)
        place = np.clip((np.where(finite, values, self.low) - self.low) / span, 0.0, 1.0)
        return np.where(finite[..., None], self.table[(255 * place).round().astype(int)], np.uint8(128))

    @property
    def table(self) -> UInt8[np.ndarray, "256 4"]:
        """RGBA of the map, from the lower to the upper limit."""
        return (255 * matplotlib.colormaps[self.name](np.linspace(0.0, 1.0, 256))).round().astype(np.uint8)


@dataclass(frozen=True)
class ShownField:
    """One choice of the field selector: values [frames, nodes] of both sides and how they are coloured."""

    name: str
    title: str
    palette: Palette
    values: dict[str, Float[np.ndarray, "frames nodes"]]


def robust_top(values: Float[np.ndarray, "frames nodes"]) -> float:
    """Upper limit of a colour bar: 99 % of the nodes in the frame where that is most, so that one corner does not
    darken the rest.
    """
    top = float(np.percentile(values, 99, axis=1).max())
    return top if top > 0 else max(float(values.max()), 1e-6)


def colour_bar(palette: Palette, title: str) -> UInt8[np.ndarray, "height width 3"]:
    """A horizontal colour bar with ticks and `title` (which names the unit), dark like the viewer."""
    figure = Figure(figsize=(9.0, 0.9), dpi=150, facecolor="#0d1011")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.05, 0.56, 0.9, 0.32))
    axes.imshow(
        np.linspace(0.0, 1.0, 512)[None],
        aspect="auto",
        cmap=palette.name,
        extent=(palette.low, palette.high, 0.0, 1.0),
    )
    axes.set_yticks([])
    axes.set_xlabel(title, color="white", fontsize=11, labelpad=2)
    axes.tick_params(colors="white", labelsize=10, length=3)
    for side in axes.spines.values():
        side.set_visible(False)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
