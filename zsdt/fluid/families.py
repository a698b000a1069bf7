"""Five families of glasses, parametrised: how wide, how full, how much wall above the liquid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from zsdt.errors import OptionError
from zsdt.scene import VesselFamily, VesselShape

CURVE_POINTS = 12  # along each curved part of a profile


def draw_shape(
    family: VesselFamily, radius: float, fill: float, freeboard: float, rng: np.random.Generator
) -> VesselShape:
    """A random vessel of `family` for a liquid that stands `fill` [m] high, its rim `freeboard` [m] above that.

    radius [m]: of the cylinder; of the tumbler at half the fill; the largest of the bowl and of the flask's body; the
    larger half-width of the jar. The rest (taper, foot, shoulder, neck, corners) is drawn.

    Raises: OptionError for lengths that are not positive.
    """
    if min(radius, fill, freeboard) <= 0:
        raise OptionError("Radius, fill and freeboard of a vessel must be positive.")
    return _DRAW[family](radius, fill, fill + freeboard, rng)


def _rounded(family: VesselFamily, profile: list[tuple[float, float]]) -> VesselShape:
    """Round vessel of (height, radius) pairs, on whole micrometres so that options and files say the same."""
    return VesselShape(family, [round(float(z), 6) for z, _ in profile], [round(float(r), 6) for _, r in profile])


def _cylinder(radius: float, fill: float, rim: float, rng: np.random.Generator) -> VesselShape:
    return _rounded(VesselFamily.cylinder, [(0.0, radius), (rim, radius)])


def _tumbler(radius: float, fill: float, rim: float, rng: np.random.Generator) -> VesselShape:
    slope = rng.uniform(0.06, 0.16)  # of the wall against the vertical
    return _rounded(
        VesselFamily.tumbler, [(0.0, radius - slope * fill / 2.0), (rim, radius + slope * (rim - fill / 2.0))]
    )


def _bowl(radius: float, fill: float, rim: float, rng: np.random.Generator) -> VesselShape:
    """Ellipse from a flat foot to the widest place, then a parabola that narrows to the rim."""
    widest, foot, mouth = radius * rng.uniform(0.8, 1.0), rng.uniform(0.35, 0.5), rng.uniform(0.7, 0.85)
    angles = np.linspace(np.arccos(foot), 0.0, CURVE_POINTS)
    lower = [(widest * (1.0 - np.sin(a) / np.sin(angles[0])), radius * np.cos(a)) for a in angles]
    upper = [
        (widest + s * (rim - widest), radius * (1.0 - (1.0 - mouth) * s * s))
        for s in np.linspace(0.0, 1.0, CURVE_POINTS)[1:]
    ]
    return _rounded(VesselFamily.bowl, [*lower, *upper])


def _flask(radius: float, fill: float, rim: float, rng: np.random.Generator) -> VesselShape:
    """Cylindrical body, a shoulder of half a cosine, a straight neck."""
    neck = max(radius * rng.uniform(0.5, 0.65), min(radius, 0.016))
    shoulder = fill * rng.uniform(0.85, 1.2)
    height = min((radius - neck) * rng.uniform(0.9, 1.5), 0.9 * (rim - shoulder))
    curve = [
        (shoulder + s * height, neck + 0.5 * (radius - neck) * (1.0 + np.cos(np.pi * s)))
        for s in np.linspace(0.0, 1.0, CURVE_POINTS)
    ]
    return _rounded(VesselFamily.flask, [(0.0, radius), *curve, (rim, neck)])


def _jar(radius: float, fill: float, rim: float, rng: np.random.Generator) -> VesselShape:
    """Prism between an oval and a box with rounded corners."""
    aspect, exponent = rng.uniform(0.65, 1.0), rng.uniform(2.5, 6.0)
    height, half = round(float(rim), 6), round(float(radius), 6)
    return VesselShape(
        VesselFamily.jar, [0.0, height], [half, half], round(float(aspect), 4), round(float(exponent), 3)
    )


_DRAW: dict[VesselFamily, Callable[[float, float, float, np.random.Generator], VesselShape]] = {
    VesselFamily.cylinder: _cylinder,
    VesselFamily.tumbler: _tumbler,
    VesselFamily.bowl: _bowl,
    VesselFamily.flask: _flask,
    VesselFamily.jar: _jar,
}
