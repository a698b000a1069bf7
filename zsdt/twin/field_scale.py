"""How a field is shown: its name and unit for people, its colours, and a scale with round numbers for a whole clip."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float

from zsdt.errors import DataError
from zsdt.twin.colours import Palette, robust_top


class ShownName(StrEnum):
    """Fields of a solid that an overlay can show."""

    von_mises = "von_mises"
    axial_stress = "axial_stress"
    displacement = "displacement"
    speed = "speed"
    innovation = "innovation"


class LiquidName(StrEnum):
    """Fields of a liquid that an overlay can show."""

    vertical_velocity = "vertical_velocity"
    speed = "speed"
    internal_energy = "internal_energy"


@dataclass(frozen=True)
class Look:
    """Title, colour map, units as (factor from SI, name) from small to large, whether zero is in the middle, and
    whether the scale begins at zero (what only rises from some level does not)."""

    title: str
    colour_map: str
    units: tuple[tuple[float, str], ...]
    signed: bool = False
    from_zero: bool = True


_STRESS = ((1.0, "Pa"), (1e-3, "kPa"), (1e-6, "MPa"))
_LENGTH = ((1e3, "mm"),)
_SPEED = ((1e3, "mm/s"), (1.0, "m/s"))
LIQUID_LOOKS: dict[str, Look] = {
    LiquidName.vertical_velocity: Look("vertical velocity", "RdBu_r", _SPEED, signed=True),
    LiquidName.speed: Look("speed", "viridis", _SPEED),
    LiquidName.internal_energy: Look("internal energy", "inferno", ((1e3, "mJ/kg"), (1.0, "J/kg")), from_zero=False),
}
LOOKS: dict[str, Look] = {
    ShownName.von_mises: Look("von Mises stress", "turbo", _STRESS),
    ShownName.axial_stress: Look("axial stress", "RdBu_r", _STRESS, signed=True),
    ShownName.displacement: Look("displacement", "viridis", _LENGTH),
    ShownName.speed: Look("speed", "viridis", _SPEED),
    ShownName.innovation: Look("innovation", "magma", _LENGTH),
}
# Upper limits of a scale, as a mantissa, and the distance of its ticks.
_ROUND = ((1.0, 0.25), (1.2, 0.3), (1.5, 0.5), (2.0, 0.5), (2.5, 0.5), (3.0, 1.0), (4.0, 1.0), (5.0, 1.0), (6.0, 2.0))
_ROUNDER = (*_ROUND, (8.0, 2.0), (10.0, 2.5))
_ENOUGH = 2.0  # a unit is large enough when the largest value is at least this many of it


@dataclass(frozen=True)
class FieldScale:
    """A field between two fixed limits; the palette is in `unit`, which is `factor` times SI."""

    name: str
    title: str
    unit: str
    factor: float
    palette: Palette
    step: float

    @property
    def ticks(self) -> tuple[float, ...]:
        """Values [unit] that the legend names, from the lower to the upper limit."""
        count = round((self.palette.high - self.palette.low) / self.step)
        return tuple(float(t) for t in np.linspace(self.palette.low, self.palette.high, count + 1))

    @property
    def label(self) -> str:
        """Title and unit."""
        return f"{self.title} [{self.unit}]"

    def words(self, value: float) -> str:
        """A tick as text, without digits that say nothing."""
        return f"{value:.10g}" if value else "0"


def scale_of(name: str, values: Float[np.ndarray, "frames *nodes"], top: float | None = None) -> FieldScale:
    """A scale that fits all frames of a clip: 99 % of the nodes lie within it in every frame.

    values: in SI, what is not finite is passed over. top: upper limit in SI instead of the one from the values.

    Raises: DataError where the field is unknown.
    """
    looks = {**LOOKS, **LIQUID_LOOKS}
    if name not in looks:
        raise DataError(f"There is no picture for the field {name}; choose one of {', '.join(looks)}.")
    look = looks[name]
    flat = np.abs(values.reshape(len(values), -1))
    known = flat[np.isfinite(flat).any(axis=1)]
    most = robust_top(np.nan_to_num(known, nan=0.0)) if known.size else 1e-6
    if top is not None:
        most = top
    factor, unit = next((u for u in reversed(look.units) if most * u[0] >= _ENOUGH), look.units[0])
    if not look.from_zero and known.size:
        return _floating(name, look, factor * values[np.isfinite(values)], unit, factor, most * factor)
    limit, step = round_limit(most * factor)
    low = -limit if look.signed else 0.0
    step = limit / 2 if look.signed else step
    return FieldScale(name, look.title, unit, factor, Palette(look.colour_map, low, limit), step)


def _floating(
    name: str, look: Look, values: Float[np.ndarray, " values"], unit: str, factor: float, most: float
) -> FieldScale:
    """A scale from a round number below nearly all values (in `unit`) to one above `most`."""
    least = min(float(np.percentile(values, 1)), most)
    step = round_limit(max(most - least, 1e-9 * max(abs(most), 1.0)))[1]
    low, high = (float(f"{step * whole(end / step):.10g}") for whole, end in ((math.floor, least), (math.ceil, most)))
    while round((high - low) / step) > 5:  # moving the ends to round numbers may cost more ticks than fit
        step = round_limit(1.001 * step * 2)[0] if step > 0 else 1.0
        low, high = step * math.floor(least / step), step * math.ceil(most / step)
    return FieldScale(name, look.title, unit, factor, Palette(look.colour_map, low, max(high, low + step)), step)


def round_limit(value: float) -> tuple[float, float]:
    """The next round number from `value` up, and the distance of the ticks from 0 to it.

    >>> round_limit(0.047)
    (0.05, 0.01)
    """
    power = 10.0 ** math.floor(math.log10(max(value, 1e-12)))
    for mantissa, step in _ROUNDER:
        if value <= mantissa * power * (1 + 1e-9):
            return float(f"{mantissa * power:.6g}"), float(f"{step * power:.6g}")
    raise AssertionError("a mantissa is at most 10")
