"""Where a liquid and its glass are in the picture: the region that the liquid fills, its level line, the vessel.

The wall and the liquid behind it act as a cylindrical lens: seen through a glass of index n, the inside of radius r
looks as wide as `min(R, n r)`, R the outer radius. With any glass and liquid that is the outer wall, so the liquid
appears to fill the glass from edge to edge, and that is how its region is drawn here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from zsdt.fluid.vessel import Vessel
from zsdt.perception.camera import Camera

Pixels = Float[np.ndarray, "_ 2"]  # any number in each line
ANGLES, HEIGHTS = 72, 24


@dataclass(frozen=True)
class GlassLines:
    """Lines of one frame in the picture [px]: what the liquid appears to fill (polygons whose union it is), the visible
    edge of its surface from left to right, the outer wall with the rim and the cavity's floor."""

    region: list[Pixels]
    level: Pixels
    vessel: list[Pixels]


def glass_lines(
    camera: Camera,
    vessel: Vessel,
    wall: float,
    origin: Float[np.ndarray, "3"],
    places: Float[np.ndarray, "columns 2"],
    level: Float[np.ndarray, " columns"],
) -> GlassLines:
    """Lines of a vessel whose origin is at `origin` [m] in the room, filled up to `level` [m] at `places` [m].

    The profile is extended over the depth of the vessel by symmetry about the plane of motion. wall [m]: thickness.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, ANGLES, endpoint=False)
    order = np.argsort(places[:, 0])
    known = order[np.isfinite(level[order])]
    top = vessel.rim * np.ones(1) if len(known) == 0 else level[known]
    across = np.zeros(1) if len(known) == 0 else places[known, 0]

    def ring(heights: np.ndarray, at: np.ndarray) -> Float[np.ndarray, "angles 3"]:
        half = np.asarray(vessel.radius(np.clip(heights, 0.0, vessel.rim)))
        deep = vessel.shape.aspect * half
        return np.stack([(half + wall) * np.cos(at), (deep + wall) * np.sin(at), heights], axis=1)

    def shown(points: Float[np.ndarray, "points 3"]) -> Pixels:
        return camera.project(np.asarray(points, np.float64) + origin)

    def surface(at: np.ndarray) -> Float[np.ndarray, "angles 3"]:
        """The contact line at the outer wall, whose radius depends on the height that it has itself."""
        heights = np.full(len(at), float(top.mean()))
        for _ in range(3):
            heights = np.interp(ring(heights, at)[:, 0], across, top)
        return ring(heights, at)

    def side(sign: float, upto: float) -> Float[np.ndarray, "heights 3"]:
        heights = np.linspace(0.0, upto, HEIGHTS)
        half = np.asarray(vessel.radius(np.clip(heights, 0.0, vessel.rim)))
        return np.stack([sign * (half + wall), np.zeros(HEIGHTS), heights], axis=1)

    edge = surface(angles)
    right, left = surface(np.zeros(1))[0, 2], surface(np.full(1, np.pi))[0, 2]
    half = float(np.asarray(vessel.radius(float(top.mean())))) + wall
    middle = np.linspace(-half, half, HEIGHTS)
    flat = np.stack([middle, np.zeros(HEIGHTS), np.interp(middle, across, top)], axis=1)
    body = np.concatenate([side(-1.0, left), flat, side(1.0, right)[::-1]])
    region = [shown(body), shown(edge), shown(ring(np.zeros(ANGLES), angles))]
    above = float(camera.center[2]) > float(origin[2] + top.mean())
    half_turn = np.linspace(np.pi, 0.0, HEIGHTS) if above else np.linspace(-np.pi, 0.0, HEIGHTS)
    rim = ring(np.full(ANGLES, vessel.rim), angles)
    base = ring(np.zeros(ANGLES), angles)
    walls = [side(-1.0, vessel.rim), side(1.0, vessel.rim)]
    closed = [np.concatenate([line, line[:1]]) for line in (rim, base)]
    return GlassLines(region, shown(surface(half_turn)), [shown(line) for line in (*walls, *closed)])
