"""How the vessel moves, from its silhouette in every frame, and when it has come to rest.

x of the axis comes from both edges of every row of the mask, against the width that the row had before, so that a hand
over one side costs rows, not the position. The rest is found causally: a few frames must lie still before the twin
begins, and then the instant at which the excitation ceased is told exactly, from how the last frames before ran out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError
from zsdt.perception.camera import Camera
from zsdt.perception.glass_sight import rays
from zsdt.perception.mask_edges import MaskEdges
from zsdt.trajectory import VesselMotion

LEARNED = 15  # pictures from which the width of each row is taken
HELD = 0.004  # m: rows that say another x than most by more are covered
LEAST_ROWS = 12
HISTORY_STEP = 1e-3  # s between samples of the told motion
LONGEST_RAMP, SHORTEST_RAMP = 0.12, 0.008  # s of a stop
FLOOR = 5e-5  # m: no place is known better, so that few frames fit no better than many
EDGE = 0.25  # of a stop in which the deceleration rises, and again in which it falls


class VesselTracker:
    """x of a vessel's axis in the room [m], frame by frame."""

    def __init__(self, camera: Camera):
        self.camera = camera
        self._eye = camera.center
        self._widths: list[Float[np.ndarray, " height"]] = []
        self._width = np.full(camera.height, np.nan)

    def update(self, edges: MaskEdges) -> float:
        """x [m] in one picture; NaN where too little of the vessel is seen."""
        left, right = self._bearings(edges.left, edges.rows), self._bearings(edges.right, edges.rows)
        rows = np.clip(edges.rows.astype(int), 0, len(self._width) - 1)
        radius = self._width[rows]
        known = np.isfinite(radius)
        both = np.isfinite(left) & np.isfinite(right)
        middle = 0.5 * (left + right)[both]
        if known.sum() < LEAST_ROWS or not len(middle):
            angles = middle
        else:  # a body of revolution that moves aside is farther off and so looks smaller
            half = np.arcsin(np.minimum(radius * np.cos(np.median(middle)) / -self._eye[1], 1.0))
            angles = np.concatenate([(left + half)[known], (right - half)[known]])
        angles = angles[np.isfinite(angles)]
        if len(angles) < LEAST_ROWS:
            return float("nan")
        places = self._eye[0] - self._eye[1] * np.tan(angles)
        held = np.abs(places - np.median(places)) < HELD
        if held.sum() < max(LEAST_ROWS, 0.25 * len(places)):
            return float("nan")
        if len(self._widths) < LEARNED and both.any():
            seen = np.full(len(self._width), np.nan)
            seen[rows[both]] = np.sin(0.5 * (right - left)[both]) * -self._eye[1] / np.cos(np.median(middle))
            self._widths.append(seen)
            stacked = np.stack(self._widths)
            count = np.isfinite(stacked).sum(0)
            with np.errstate(invalid="ignore"):
                ordered = np.sort(stacked, axis=0)  # NaN last
            usual = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
            self._width = np.where(2 * count > len(self._widths), usual, np.nan)
        return float(places[held].mean())

    def _bearings(
        self, columns: Float[np.ndarray, " rows"], rows: Float[np.ndarray, " rows"]
    ) -> Float[np.ndarray, " rows"]:
        """Angle of lines of sight from the plane x = 0 [rad], NaN where there is no edge or the border cuts it."""
        fair = np.isfinite(columns) & (columns > 0.5) & (columns < self.camera.width - 1.5)
        found = np.full(len(columns), np.nan)
        way = rays(self.camera, np.column_stack([columns[fair], rows[fair]]))
        found[fair] = np.arctan2(way[:, 0], way[:, 1])
        return found


class Motion(StrEnum):
    """What is known of a vessel: too little yet, that it moves, or that it stands."""

    unknown = "unknown"
    moving = "moving"
    rest = "rest"


@dataclass
class RestOptions:
    """hold: frames that must lie within `still` [m] of each other before a vessel is at rest. moving [m/s]: faster
    over two frames is motion; the gap between the two is the hysteresis."""

    hold: int = 5
    still: float = 6e-4
    moving: float = 0.05

    def __post_init__(self) -> None:
        if self.hold < 3 or min(self.still, self.moving) <= 0:
            raise OptionError("Rest needs at least 3 frames to hold, and positive limits still [m] and moving [m/s].")


@dataclass(frozen=True)
class Stop:
    """How a vessel came to rest: when its excitation ceased [s], where it stands [m], its speed before [m/s] and how
    long it took to stop [s]."""

    time: float
    place: float
    speed: float
    ramp: float

    def velocity(self, times: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
        """Velocity [m/s] at times [s]: slowed down evenly, with soft edges; constant before."""
        return self.speed * _slowed(np.clip((self.time - times) / self.ramp, 0.0, 1.0))


class RestDetector:
    """Says from x of the frames so far whether a vessel moves, and when it stopped.

    A vessel that never moved is at rest from its first frame on (`stop` is None then).
    """

    def __init__(self, options: RestOptions | None = None):
        self.options = options or RestOptions()
        self.times: list[float] = []
        self.places: list[float] = []
        self.state = Motion.unknown
        self.stop: Stop | None = None
        self.t0: float | None = None
        self.t0_index: int | None = None
        self._moved = False

    def update(self, time: float, x: float) -> Motion:
        """Takes x [m] (NaN: not seen) of the frame at `time` [s]."""
        if not math.isfinite(x):
            return self.state
        self.times.append(time)
        self.places.append(x)
        o, n = self.options, len(self.times)
        if n >= 3 and self._speed() > o.moving:
            self.state, self._moved = Motion.moving, True
            self.t0 = self.t0_index = self.stop = None
            return self.state
        last = np.array(self.places[-o.hold :])
        if self.state is not Motion.rest and n >= o.hold and np.ptp(last) < 2.0 * o.still:
            middle = float(np.median(last))
            if np.abs(last - middle).max() < o.still:
                self._rest(middle)
        return self.state

    def _speed(self) -> float:
        """Over the last two frames [m/s], the slower of two differences, so that one stray frame is no motion."""
        t, x = self.times[-3:], self.places[-3:]
        first, second = (x[1] - x[0]) / (t[1] - t[0]), (x[2] - x[1]) / (t[2] - t[1])
        return min(abs(first), abs(second)) if first * second > 0 else 0.0

    def _rest(self, middle: float) -> None:
        """Walks back to where the frames begin to lie still, and fits how the vessel ran out."""
        first = len(self.places) - self.options.hold
        while first > 0 and abs(self.places[first - 1] - middle) < self.options.still:
            first -= 1
        self.state = Motion.rest
        if not self._moved:
            self.t0, self.t0_index = self.times[0], 0
            return
        self.stop = fit_stop(np.array(self.times), np.array(self.places), first, self.options.hold)
        # The first frame at or after the instant; frames are a little early or late, so a tenth is forgiven.
        step = float(np.median(np.diff(self.times[-self.options.hold :])))
        late = [k for k, t in enumerate(self.times) if t >= self.stop.time - 0.1 * step]
        self.t0_index = min(max(late[0] if late else first, first - 1), first + 1)
        self.t0 = self.times[self.t0_index]

    @property
    def moved_before(self) -> bool:
        """Whether the vessel was ever seen moving."""
        return self._moved


def fit_stop(
    times: Float[np.ndarray, " frames"], places: Float[np.ndarray, " frames"], first: int, hold: int, before: int = 6
) -> Stop:
    """The stop that explains the frames around `first`, the first that lies still.

    Speed falls from a constant to zero (see `Stop`); instant and length of the ramp are searched on a grid, speed and
    place follow by least squares. Only frames up to the ramp's begin count, as those before may be another push.
    """
    step = float(np.median(np.diff(times)))
    low, high = max(first - before, 0), min(first + hold, len(times))
    t, x = times[low:high], places[low:high]
    best, found = np.inf, Stop(float(times[first]), float(x[-1]), 0.0, step)
    for ramp in np.geomspace(SHORTEST_RAMP, LONGEST_RAMP, 24):
        # No more than needed, because what was before may be another push; but enough to tell ramp from speed.
        fair = t > times[first] - max(ramp + 2.5 * step, 4.2 * step)
        if fair.sum() < hold + 2:
            continue
        for instant in times[first] + step * np.arange(-1.6, 1.31, 0.05):
            way = -ramp * _way(np.maximum(instant - t[fair], 0.0) / ramp)
            middle_way, middle = way.mean(), x[fair].mean()
            speed = ((way - middle_way) @ (x[fair] - middle)) / max(((way - middle_way) ** 2).sum(), 1e-12)
            off = x[fair] - middle - speed * (way - middle_way)
            error = (float(off @ off) + FLOOR**2) / max(int(fair.sum()) - 4, 1)
            if error < best:
                best = error
                found = Stop(float(instant), float(middle - speed * middle_way), float(speed), float(ramp))
    return found


def _slowed(s: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """Share of the speed that is left at the share s of a stop's length before its end: the integral of a deceleration
    that is even but for half-cosine edges of a quarter each."""
    low, high = np.minimum(s, EDGE), np.maximum(s - 1.0 + EDGE, 0.0)
    rise = 0.5 * (low - EDGE / np.pi * np.sin(np.pi * low / EDGE))
    fall = 0.5 * (high + EDGE / np.pi * np.sin(np.pi * high / EDGE))
    return (rise + np.clip(s - EDGE, 0.0, 1.0 - 2.0 * EDGE) + fall) / (1.0 - EDGE)


_SHARES = np.linspace(0.0, 1.0, 401)
_WAYS = np.concatenate([[0.0], np.cumsum(0.5 * (_slowed(_SHARES)[1:] + _slowed(_SHARES)[:-1]))]) / 400.0


def _way(s: Float[np.ndarray, " frames"]) -> Float[np.ndarray, " frames"]:
    """Way left at the share s of a stop's length before its end, for a speed and length of one."""
    return np.interp(s, _SHARES, _WAYS) + np.maximum(s - 1.0, 0.0)


def told_motion(
    times: Sequence[float], places: Sequence[float], stop: Stop | None, t0: float, gravity: float
) -> VesselMotion:
    """The motion until t0 as `Psi_ini` wants it, sampled every ms.

    Velocity of the last stop from its fit, before that from parabolas through five frames; constant before the first
    frame. The vessel stands from the instant of the fit on, up to a frame before t0: moving that instant to t0 would
    push the liquid too late, which in a bowl doubles its error. gravity [m/s2] downwards.
    """
    t, x = np.asarray(times, np.float64), np.asarray(places, np.float64)
    before = t < t0 + 1e-9
    start = min(float(t[0]), t0 - 0.05)
    samples = t0 - HISTORY_STEP * np.arange(math.ceil((t0 - start) / HISTORY_STEP), -1, -1)
    velocity = np.zeros(len(samples))
    if stop is not None and before.sum() >= 5:
        slopes = _slopes(t, x)
        velocity = np.interp(samples, t[before], slopes[before])
        # Where the fitted stop begins, the fit takes over; it blends in over one frame before.
        step = float(np.median(np.diff(t)))
        share = np.clip((samples - (stop.time - stop.ramp - step)) / step, 0.0, 1.0)
        velocity = (1.0 - share) * velocity + share * stop.velocity(samples)
    velocity[-1] = 0.0
    return VesselMotion(
        times=samples - t0,
        velocity=np.stack([velocity, np.zeros_like(velocity), np.zeros_like(velocity)], axis=1),
        gravity=np.tile([0.0, 0.0, -gravity], (len(samples), 1)),
    )


def _slopes(t: Float[np.ndarray, " frames"], x: Float[np.ndarray, " frames"]) -> Float[np.ndarray, " frames"]:
    """Slope at each frame of the parabola through it and its two neighbours on each side."""
    found = np.empty(len(t))
    for k in range(len(t)):
        low = min(max(k - 2, 0), max(len(t) - 5, 0))
        part = slice(low, low + 5)
        found[k] = np.polyfit(t[part] - t[k], x[part], min(2, len(t[part]) - 1))[-2]
    return found
