"""What a network and its fits take in, as a few numbers a frame: are they as in the training?

A network is only known where it was trained. Strains, strain rates, speeds, distances of pairs and loads of every frame
are measured here in the units in which the engines scale them (DESIGN 4.2: velocity by sqrt(E / rho), stress by E,
length by the pitch, time by the relaxation time), so one range serves bodies of all sizes and materials. What does not
change (sizes, material, pitch, gravity: the card) is measured once. One compiled pass a frame; nothing is decoded.
"""

from __future__ import annotations

import math
from typing import Protocol, no_type_check, runtime_checkable

import numba as nb
import numpy as np
from jaxtyping import Float

from zsdt.trajectory import Body

NEAREST_BUDGET = 10_000  # distances that are looked at in a frame: some ten microseconds
_UNKNOWN = np.zeros((0, 1))
DIAGONALS = ((0, 7), (1, 6), (2, 5), (3, 4))  # corners of a cell: they feel shear, which edges do not
_fast = nb.njit(cache=True, fastmath={"contract", "nsz", "arcp"}, error_model="numpy", boundscheck=False)
_vector = nb.njit(cache=True, fastmath=True, error_model="numpy", boundscheck=False)

Values = dict[str, float]


@runtime_checkable
class Gauge(Protocol):
    """Numbers of one body: `card` once, `frame` of every frame; `finite` after `frame`: no NaN was met."""

    card: Values
    finite: bool

    def frame(
        self,
        position: Float[np.ndarray, "nodes 3"],
        velocity: Float[np.ndarray, "nodes 3"],
        load: Float[np.ndarray, "nodes 3"] | None = None,
        second: Float[np.ndarray, "nodes _"] | None = None,
    ) -> Values:
        """position [m], velocity [m/s], load [N] where it was given; second: stress [Pa] or pressure [Pa]."""


def gauge_of(body: Body) -> Gauge:
    """The gauge of a liquid in a vessel or of a solid."""
    return LiquidGauge(body) if body.liquid is not None and body.vessel is not None else SolidGauge(body)


@_fast
@no_type_check
def _solid(first, second, rest, x, v, out):
    """Squares of the least and greatest stretch, greatest |d ln stretch / dt| [1/s], square of the greatest speed."""
    low, high, rate, fast, total = 1e300, 0.0, 0.0, 0.0, 0.0
    for k in range(first.size):
        i, j = first[k], second[k]
        a, b, c = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        square = a * a + b * b + c * c
        turn = a * (v[j, 0] - v[i, 0]) + b * (v[j, 1] - v[i, 1]) + c * (v[j, 2] - v[i, 2])
        stretch = square / (rest[k] * rest[k])
        low, high = min(low, stretch), max(high, stretch)
        rate = max(rate, abs(turn) / max(square, 1e-30))
        total += square
    for n in range(x.shape[0]):
        square = v[n, 0] * v[n, 0] + v[n, 1] * v[n, 1] + v[n, 2] * v[n, 2]
        fast = max(fast, square)
        total += square + abs(x[n, 0]) + abs(x[n, 1]) + abs(x[n, 2])
    out[0], out[1], out[2], out[3], out[4] = low, high, rate, fast, total


@_fast
@no_type_check
def _peak(values):
    """Greatest absolute entry of a two-dimensional array; NaN if there is one that is not finite."""
    most, total = 0.0, 0.0
    for n in range(values.shape[0]):
        for k in range(values.shape[1]):
            most = max(most, abs(values[n, k]))
            total += values[n, k]
    return most if math.isfinite(total) else math.nan


@_fast
@no_type_check
def _force(load, before, out):
    """Sums over the nodes of |load| and of |load - before|, the greatest |load| of a node [N]; then before = load."""
    whole, step, peak = 0.0, 0.0, 0.0
    for n in range(load.shape[0]):
        size, change = 0.0, 0.0
        for k in range(3):
            size += load[n, k] * load[n, k]
            change += (load[n, k] - before[n, k]) ** 2
            before[n, k] = load[n, k]
        whole += math.sqrt(size)
        step += math.sqrt(change)
        peak = max(peak, size)
    out[0], out[1], out[2] = whole, step, math.sqrt(peak)


class SolidGauge:
    """Of a beam: see `Gauge`. Values, all without a unit:

    stretch_low, stretch_high: of edges and cell diagonals against the stress-free body; rate: greatest rate of a
    logarithmic stretch times the relaxation time; speed: over sqrt(E / rho); stress: greatest component over E;
    load: sum of the nodal loads over the weight, load_step: its change since the last frame, load_peak: greatest nodal
    load over E pitch^2. card: sizes [m], slenderness, pitch [m], frame_dt [s], gravity [m/s2], material [SI], and
    demand: bending strain under the own weight, 3 rho g L^2 / (E D).
    """

    def __init__(self, body: Body):
        material = body.material
        corners = [body.cells[:, list(pair)] for pair in DIAGONALS] if len(body.cells) else []
        arms = np.concatenate([body.pairs, *corners]).astype(np.int64)
        self._first, self._second = np.ascontiguousarray(arms[:, 0]), np.ascontiguousarray(arms[:, 1])
        self._rest = np.linalg.norm(body.points[self._second] - body.points[self._first], axis=1)
        self._out, self._loads = np.zeros(5), np.zeros(3)
        self._before, self._began = np.zeros((body.nodes, 3)), False
        self._young = float("nan") if material is None else material.young
        self._tau = body.frame_dt if material is None else material.tau
        self._sound = float("nan") if material is None else math.sqrt(material.young / material.density)
        gravity = float(np.linalg.norm(body.gravity))
        self._weight = float(body.mass.sum()) * 9.81 or float("nan")  # of the earth: loads count without gravity, too
        self._patch = self._young * body.pitch**2
        self.card, self.finite = _solid_card(body, gravity), True

    def frame(
        self,
        position: Float[np.ndarray, "nodes 3"],
        velocity: Float[np.ndarray, "nodes 3"],
        load: Float[np.ndarray, "nodes 3"] | None = None,
        second: Float[np.ndarray, "nodes 6"] | None = None,
    ) -> Values:
        """See `Gauge`; second: stress [Pa]."""
        out = self._out
        _solid(self._first, self._second, self._rest, position, velocity, out)
        self.finite = math.isfinite(out[4])
        found = {
            "stretch_low": math.sqrt(out[0]),
            "stretch_high": math.sqrt(out[1]),
            "rate": float(out[2]) * self._tau,
            "speed": math.sqrt(out[3]) / self._sound,
        }
        if second is not None:
            found["stress"] = _peak(second) / self._young
        if load is not None:
            _force(load, self._before, self._loads)
            whole, step, peak = self._loads
            found["load"], found["load_peak"] = float(whole) / self._weight, float(peak) / self._patch
            if self._began:
                found["load_step"] = float(step) / self._weight
            self._began = True
        return found


def _solid_card(body: Body, gravity: float) -> Values:
    length, width, depth = (float(s) for s in np.ptp(body.points, axis=0))
    found = {
        "length": length,
        "width": width,
        "depth": depth,
        "slenderness": length / max(min(width, depth), 1e-9),
        "pitch": body.pitch,
        "frame_dt": body.frame_dt,
        "gravity": gravity,
    }
    m = body.material
    if m is not None:
        found |= {"young": m.young, "density": m.density, "poisson": m.poisson, "g1": m.g1, "tau": m.tau}
        found["demand"] = 3.0 * m.density * gravity * length**2 / (m.young * depth)
    return found


@_vector
@no_type_check
def _least_distance(x, y, z, start, stop):
    """Square of the least distance [m2] between particles start..stop and all others."""
    least = 1e300
    for i in range(start, stop):
        a, b, c, own = x[i], y[i], z[i], 1e300
        for j in range(i):
            own = min(own, (x[j] - a) ** 2 + (y[j] - b) ** 2 + (z[j] - c) ** 2)
        for j in range(i + 1, x.size):
            own = min(own, (x[j] - a) ** 2 + (y[j] - b) ** 2 + (z[j] - c) ** 2)
        least = min(least, own)
    return least


@_fast
@no_type_check
def _liquid(position, velocity, pressure, axes, out):
    """Coordinates apart; square of the greatest speed, greatest height, sum of the squares of speeds, a sum that shows
    NaN, least and greatest pressure (which may have no rows)."""
    x, y, z = axes[0], axes[1], axes[2]
    fast, top, motion, total, low, high = 0.0, -1e300, 0.0, 0.0, 1e300, -1e300
    for n in range(pressure.shape[0]):
        low, high = min(low, pressure[n, 0]), max(high, pressure[n, 0])
        total += pressure[n, 0]
    for n in range(position.shape[0]):
        x[n], y[n], z[n] = position[n, 0], position[n, 1], position[n, 2]
        square = velocity[n, 0] ** 2 + velocity[n, 1] ** 2 + velocity[n, 2] ** 2
        fast, top = max(fast, square), max(top, z[n])
        motion += square
        total += square + abs(x[n]) + abs(y[n]) + abs(z[n])
    out[0], out[1], out[2], out[3], out[4], out[5] = fast, top, motion, total, low, high


class LiquidGauge:
    """Of a liquid in a vessel: see `Gauge`. Values, all without a unit:

    froude: greatest speed over sqrt(g times fill height), froude_mean: of the root mean square; nearest: least distance
    of two particles over the spacing (of a share of the particles a frame, of all within `round` frames); top: greatest
    height over the rim; pressure_low, pressure_high: over rho g times fill height; push: acceleration of the vessel
    over 9.81 m/s2. card: particles, spacing [m], fill height, widest and narrowest radius [m], tilt of gravity [rad],
    aspect and exponent of the cross-section, viscosity [Pa s], density [kg/m3], frame_dt [s], gravity [m/s2].
    """

    def __init__(self, body: Body):
        liquid, shape = body.liquid, body.vessel
        assert liquid is not None and shape is not None
        from zsdt.fluid.vessel import Vessel  # no beam needs it

        vessel = Vessel(shape)
        fill = float(vessel.level(float(body.mass.sum()) / liquid.density))
        gravity = float(np.linalg.norm(body.gravity))
        self.round = max(1, math.ceil(body.nodes / max(1, NEAREST_BUDGET // body.nodes)))
        self._block, self._next = math.ceil(body.nodes / self.round), 0
        self._axes = np.zeros((3, body.nodes))
        self._out, self._least = np.zeros(6), np.full(self.round, np.inf)
        self._speed = math.sqrt(max(gravity, 1e-3) * fill)
        self._pressure = liquid.density * max(gravity, 1e-3) * fill
        self._pitch, self._rim, self._nodes = body.pitch, vessel.rim, body.nodes
        self._weight = float(body.mass.sum()) * 9.81
        self.finite = True
        heights = np.linspace(1e-3, max(fill, 2e-3), 20)
        radii = np.asarray(vessel.radius(heights))
        self.card: Values = {
            "particles": float(body.nodes),
            "pitch": body.pitch,
            "fill": fill,
            "radius_widest": float(radii.max()),
            "radius_narrowest": float(radii[5:].min()),
            "tilt": math.atan2(math.hypot(*map(float, body.gravity[:2])), -float(body.gravity[2])),
            "aspect": shape.aspect,
            "corners": shape.exponent,
            "viscosity": liquid.viscosity,
            "density": liquid.density,
            "frame_dt": body.frame_dt,
            "gravity": gravity,
        }

    def frame(
        self,
        position: Float[np.ndarray, "nodes 3"],
        velocity: Float[np.ndarray, "nodes 3"],
        load: Float[np.ndarray, "nodes 3"] | None = None,
        second: Float[np.ndarray, "nodes 1"] | None = None,
    ) -> Values:
        """See `Gauge`; second: pressure [Pa]."""
        out, (x, y, z) = self._out, self._axes
        _liquid(position, velocity, _UNKNOWN if second is None else second, self._axes, out)
        self.finite = math.isfinite(out[3])
        if self.finite:
            start = self._next * self._block
            self._least[self._next] = _least_distance(x, y, z, start, min(start + self._block, self._nodes))
            self._next = (self._next + 1) % self.round
        found = {
            "froude": math.sqrt(out[0]) / self._speed,
            "froude_mean": math.sqrt(out[2] / self._nodes) / self._speed,
            "nearest": math.sqrt(float(self._least.min())) / self._pitch if self.finite else float("nan"),
            "top": float(out[1]) / self._rim,
        }
        if second is not None:
            found["pressure_low"] = float(out[4]) / self._pressure
            found["pressure_high"] = float(out[5]) / self._pressure
        if load is not None:
            found["push"] = float(np.linalg.norm(load.sum(axis=0))) / self._weight
        return found
