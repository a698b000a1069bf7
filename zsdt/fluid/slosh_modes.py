"""Sloshing modes of a liquid in any vessel of `VesselShape`: potential flows that the wall lets through nowhere.

A mode is a harmonic function phi with no flux through floor and wall and `d phi / dz = lambda phi` on the level
surface; its free frequency is `sqrt(g lambda)` (Ibrahim, "Liquid Sloshing Dynamics", 2005, chapter 1). Displacements
along `grad phi` keep the volume of every part of the liquid. Rayleigh and Ritz: the modes make `int |grad phi|^2 dV`
over `int phi^2 dS` stationary among harmonic polynomials that are even in y (the vessel is moved along x) and even in
z, which makes the floor exact; the wall is their natural boundary condition. As the functions are harmonic, the first
integral runs over wall and surface only.

The polynomials are the regular solid harmonics `r^l P_lm e^(i m angle) / (l + m)!`, whose derivatives are such again.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any, no_type_check

import numba
import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError
from zsdt.scene import VesselShape

DEGREE = 18  # of the polynomials: the first six modes to 1e-3 in a cylinder three times as deep as its radius
AROUND, UPWARDS, INWARDS = 96, 10, 24  # points of integration: around, up each piece of the profile, from axis to wall
SPARE = 8  # functions more than the modes asked for, that are combined to them
CREST = 0.8  # half-widths over the level up to which the flows must be good: as high as waves go
NECK = 0.8  # of the half-width at the level, below which a vessel is too narrow for that
DEPENDENT = 1e-12  # share of the largest, below which a combination of polynomials is rounding
_jit: Any = numba.njit(error_model="numpy", cache=True, nogil=True, fastmath=True)


def _index(power: int, m: int) -> int:
    """Place of a harmonic of degree `power` and order m among all."""
    return power * (power + 1) // 2 + m


@_jit
@no_type_check
def _harmonics(points, scale, degree, real, imaginary):
    """All regular solid harmonics up to `degree` at points: real and imaginary parts [terms, points].

    The recurrences run over all points side by side, so the loops go through vector registers.
    """
    count = len(points)
    x, y, z, square = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    for i in range(count):
        x[i], y[i], z[i] = points[i, 0] / scale, points[i, 1] / scale, points[i, 2] / scale
        square[i] = x[i] * x[i] + y[i] * y[i] + z[i] * z[i]
    real[0], imaginary[0] = 1.0, 0.0
    for m in range(degree + 1):
        k = m * (m + 1) // 2 + m
        if m > 0:
            last, share = k - m - 1, 0.5 / m
            for i in range(count):
                a, b = real[last, i], imaginary[last, i]
                real[k, i], imaginary[k, i] = share * (x[i] * a - y[i] * b), share * (x[i] * b + y[i] * a)
        one, two = k, k  # places of the two before; the second does not count at first
        for n in range(m + 1, degree + 1):
            share = 1.0 / ((n - m) * (n + m))
            up, down = (2.0 * n - 1.0) * share, share if n > m + 1 else 0.0
            k += n
            for i in range(count):
                rise, fall = up * z[i], down * square[i]
                real[k, i] = rise * real[one, i] - fall * real[two, i]
                imaginary[k, i] = rise * imaginary[one, i] - fall * imaginary[two, i]
            one, two = k, one


def _derivatives(
    value: Float[np.ndarray, "modes terms"], degree: int
) -> tuple[Float[np.ndarray, "modes terms"], Float[np.ndarray, "modes terms"], Float[np.ndarray, "modes terms"]]:
    """Coefficients of d/dx (real parts), d/dy (imaginary parts) and d/dz (real parts)."""
    along, aside, upwards = np.zeros_like(value), np.zeros_like(value), np.zeros_like(value)
    for n in range(1, degree + 1):
        for m in range(n + 1):
            c = value[:, _index(n, m)]
            if m <= n - 1:
                upwards[:, _index(n - 1, m)] += c
            higher, lower = (_index(n - 1, o) if 0 <= o <= n - 1 else -1 for o in (m + 1, m - 1))
            if m == 0:
                if higher >= 0:
                    along[:, higher] -= c
                    aside[:, higher] -= c
                continue
            along[:, lower] += 0.5 * c
            aside[:, lower] -= 0.5 * c
            if higher >= 0:
                along[:, higher] -= 0.5 * c
                aside[:, higher] -= 0.5 * c
    return along, aside, upwards


@dataclass(frozen=True)
class SloshModes:
    """Sloshing modes of a vessel filled up to `level` [m], slowest first.

    crest [m]: above it the flows go on as they are there. stiffness [modes] 1/m: lambda. norm [modes] m2: integral of
    the squared shape over the level surface; the largest value of a shape there is 1, at the side of positive x where
    it is odd. value [modes, terms]: coefficients of the harmonics over `scale` [m]; along, aside, upwards: those of
    their derivatives.
    """

    level: float
    crest: float
    scale: float
    degree: int
    stiffness: Float[np.ndarray, " modes"]
    norm: Float[np.ndarray, " modes"]
    value: Float[np.ndarray, "modes terms"]
    along: Float[np.ndarray, "modes terms"]
    aside: Float[np.ndarray, "modes terms"]
    upwards: Float[np.ndarray, "modes terms"]

    @property
    def count(self) -> int:
        """Number of modes."""
        return len(self.stiffness)

    def frequency(self, gravity: float = 9.81) -> Float[np.ndarray, " modes"]:
        """Frequencies [Hz] of the ideal liquid under `gravity` [m/s2]."""
        return np.sqrt(gravity * self.stiffness) / (2.0 * np.pi)

    def at(
        self, points: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, "points modes"], Float[np.ndarray, "points 3 modes"]]:
        """phi [-] and its gradient [1/m] at points [m]."""
        points = np.array(points, np.float64, order="C")
        np.minimum(points[:, 2], self.crest, out=points[:, 2])
        real, imaginary = (np.empty((self.value.shape[1], len(points))) for _ in range(2))
        _harmonics(points, self.scale, self.degree, real, imaginary)
        count, slopes = self.count, np.empty((len(points), 3, self.count))
        straight = np.concatenate([self.value, self.along, self.upwards]) @ real
        slopes[:, 0], slopes[:, 2] = straight[count : 2 * count].T, straight[2 * count :].T
        slopes[:, 1] = (self.aside @ imaginary).T
        slopes /= self.scale
        return np.ascontiguousarray(straight[:count].T), slopes


def slosh_modes(shape: VesselShape, level: float, count: int, degree: int = DEGREE) -> SloshModes:
    """The `count` slowest modes, even in y, of a liquid at `level` [m].

    Raises: OptionError where the level is not positive or so many modes are not to be had.
    """
    if not level > 0 or count < 1:
        raise OptionError("Sloshing modes need a positive level and at least one mode.")
    crest = _crest(shape, level)
    scale = max(crest, float(np.max(shape.radii)))
    terms = [(n, m) for n in range(degree + 1) for m in range(n % 2, n + 1, 2)]
    value = np.zeros((len(terms), _index(degree, degree) + 1))
    for k, (n, m) in enumerate(terms):
        value[k, _index(n, m)] = math.factorial(n)  # of the size of one at r = scale
    # Polynomials that are free above the level would do anything there. So those are taken that make modes of a vessel
    # filled up to the crest of a high wave, and of these the modes of the level.
    space = _combined(value, scale, degree, crest)
    spare, _ = _stationary(*_integrals(space, shape, crest), scale, count + SPARE, first=0)
    space = _combined(spare.T @ value, scale, degree, crest)
    combination, stiffness = _stationary(*_integrals(space, shape, level), scale, count, first=1)
    modes = replace(_combined(combination.T @ space.value, scale, degree, crest), level=level, stiffness=stiffness)
    return _normalised(modes, shape, level)


def _crest(shape: VesselShape, level: float) -> float:
    """Height [m] up to which waves on a level are thought of."""
    half = float(np.interp(level, shape.heights, shape.radii))
    heights = np.linspace(level, level + CREST * half, 41)
    wide = np.interp(heights, shape.heights, shape.radii) >= NECK * half
    return float(heights[wide.argmin() - 1] if not wide.all() else heights[-1])


def _combined(value: Float[np.ndarray, "modes terms"], scale: float, degree: int, crest: float) -> SloshModes:
    """Functions with given coefficients, of which nothing else is known yet."""
    nothing = np.zeros(len(value))
    return SloshModes(crest, crest, scale, degree, nothing, nothing, value, *_derivatives(value, degree))


def _outline(shape: VesselShape) -> tuple[Float[np.ndarray, "around 2"], Float[np.ndarray, "around 2"]]:
    """Middle points of the pieces of a cross-section of half-width one along x, and their vectors."""
    if shape.is_round:
        angle = (np.arange(AROUND) + 0.5) * 2 * np.pi / AROUND
        middle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return middle, 2 * np.pi / AROUND * np.stack([-middle[:, 1], middle[:, 0]], axis=1)
    angle = np.arange(4 * AROUND + 1) * 2 * np.pi / (4 * AROUND)
    cos, sin = np.cos(angle), np.sin(angle)
    reach = (np.abs(cos) ** shape.exponent + np.abs(sin) ** shape.exponent) ** (-1.0 / shape.exponent)
    corner = reach[:, None] * np.stack([cos, shape.aspect * sin], axis=1)
    return 0.5 * (corner[1:] + corner[:-1]), np.diff(corner, axis=0)


def _surface_points(
    shape: VesselShape, level: float
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, " points"]]:
    """Points of the level surface [m] and their areas [m2]."""
    middle, vector = _outline(shape)
    half = float(np.interp(level, shape.heights, shape.radii))
    node, weight = np.polynomial.legendre.leggauss(INWARDS)
    share, weight = 0.5 * (node + 1.0), 0.5 * weight
    flat = half * share[:, None, None] * middle
    points = np.concatenate([flat, np.full((*flat.shape[:2], 1), level)], axis=2).reshape(-1, 3)
    turn = middle[:, 0] * vector[:, 1] - middle[:, 1] * vector[:, 0]
    return points, (half**2 * (share * weight)[:, None] * turn).ravel()


def _wall_points(
    shape: VesselShape, level: float
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points 3"]]:
    """Points of the wetted wall [m] and their outward areas [m2]."""
    middle, vector = _outline(shape)
    node, weight = np.polynomial.legendre.leggauss(UPWARDS)
    heights = np.array(shape.heights)
    bounds = np.append(heights[heights < level], level)
    points, areas = [], []
    for low, high in itertools.pairwise(bounds):
        ends = np.interp([low, high], shape.heights, shape.radii)
        lean = (ends[1] - ends[0]) / (high - low)
        for s, w in zip(0.5 * (node + 1.0), 0.5 * weight * (high - low), strict=True):
            half = ends[0] + s * (ends[1] - ends[0])
            points.append(np.column_stack([half * middle, np.full(len(middle), low + s * (high - low))]))
            turn = middle[:, 0] * vector[:, 1] - middle[:, 1] * vector[:, 0]
            areas.append(w * half * np.column_stack([vector[:, 1], -vector[:, 0], -lean * turn]))
    return np.concatenate(points), np.concatenate(areas)


def _integrals(
    basis: SloshModes, shape: VesselShape, level: float
) -> tuple[Float[np.ndarray, "terms terms"], Float[np.ndarray, "terms terms"]]:
    """`int grad phi_i . grad phi_j dV` [m] and `int phi_i phi_j dS` [m2]."""
    points, area = _surface_points(shape, level)
    phi, slope = basis.at(points)
    surface = phi.T @ (area[:, None] * phi)
    energy = phi.T @ (area[:, None] * slope[:, 2])
    points, areas = _wall_points(shape, level)
    phi, slope = basis.at(points)
    energy += phi.T @ np.einsum("ni,nik->nk", areas, slope)
    return 0.5 * (energy + energy.T), surface


def _stationary(
    energy: Float[np.ndarray, "terms terms"],
    surface: Float[np.ndarray, "terms terms"],
    scale: float,
    count: int,
    first: int,
) -> tuple[Float[np.ndarray, "terms modes"], Float[np.ndarray, " modes"]]:
    """Combinations with the `count` smallest ratios of the two integrals but the `first` ones (number 0 is the
    constant), and these ratios [1/m]."""
    both = energy + surface / scale
    size = 1.0 / np.sqrt(np.diag(both))
    value, vector = np.linalg.eigh(size[:, None] * both * size)
    kept = value > DEPENDENT * value[-1]
    space = size[:, None] * vector[:, kept] / np.sqrt(value[kept])
    share, turn = np.linalg.eigh(space.T @ (surface / scale) @ space)
    share, turn = share[::-1], turn[:, ::-1]
    if len(share) < count + first:
        raise OptionError(f"{count} sloshing modes need polynomials of a higher degree.")
    found = slice(first, count + first)
    return space @ turn[:, found], (1.0 / share[found] - 1.0) / scale


def _normalised(modes: SloshModes, shape: VesselShape, level: float) -> SloshModes:
    """The same modes with shapes of size one."""
    points, area = _surface_points(shape, level)
    middle, _ = _outline(shape)
    half = float(np.interp(level, shape.heights, shape.radii))
    edge = np.column_stack([half * middle, np.full(len(middle), level)])
    rim = modes.at(edge)[0]
    phi = modes.at(points)[0]
    size = np.maximum(np.abs(rim).max(axis=0), np.abs(phi).max(axis=0))
    right = rim[np.argmax(middle[:, 0])]
    unit = np.where(right < 0, -1.0, 1.0) / size
    norm = area @ (phi * unit) ** 2
    parts = {name: getattr(modes, name) * unit[:, None] for name in ("value", "along", "aside", "upwards")}
    return replace(modes, norm=norm, **parts)
