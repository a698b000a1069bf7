"""Where the wall of a vessel is, along a horizontal direction: for drawing it, and for columns that climb it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from zsdt.fluid.vessel import Vessel

UP = np.array([0.0, 0.0, 1.0])


def reach(
    vessel: Vessel,
    heights: Float[np.ndarray, " heights"],
    direction: Float[np.ndarray, "3"],
    inset: float = 0.0,
) -> Float[np.ndarray, " heights"]:
    """Distance from the axis [m] at each height [m] at which the wall is `inset` [m] away, along a unit `direction`.

    Zero where no point at this height is so far from the wall.
    """
    low, high = np.zeros(len(heights)), np.full(len(heights), 1.5 * float(np.linalg.norm(vessel.bounds()[1][:2])))
    for _ in range(40):
        half = 0.5 * (low + high)
        inside = vessel.distance(half[:, None] * direction + heights[:, None] * UP) > inset
        low, high = np.where(inside, half, low), np.where(inside, high, half)
    return low


def outline(
    vessel: Vessel, direction: Float[np.ndarray, "3"], count: int = 120
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """The wall in the upright plane through the axis along `direction`: place along it and height [m], from one rim
    over the floor to the other.
    """
    heights = np.linspace(1e-6, vessel.rim, count)
    half, behind = reach(vessel, heights, direction), reach(vessel, heights, -direction)
    return np.concatenate([-behind[::-1], half]), np.concatenate([heights[::-1], heights])


def shell(vessel: Vessel, rings: int, angles: int) -> Float[np.ndarray, "rings angles 3"]:
    """Points [m] of the wall: rings at even heights from the floor to the rim, each at even angles from x."""
    heights = np.linspace(1e-6, vessel.rim, rings)
    points = np.empty((rings, angles, 3))
    for k, angle in enumerate(np.linspace(0.0, 2.0 * np.pi, angles, endpoint=False)):
        ray = np.array([np.cos(angle), np.sin(angle), 0.0])
        points[:, k] = reach(vessel, heights, ray)[:, None] * ray + heights[:, None] * UP
    return points
