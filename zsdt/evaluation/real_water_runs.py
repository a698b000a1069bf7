"""Simulations of recorded motions of a glass of water, kept in files so that a stopped run goes on.

The solver is driven by the recorded motion in the axes that tilt with the glass (without its spin about its own
axis, see `zsdt.interop.sloshing`): the acceleration of the floor's middle, gravity, and the forces of rotation. The
water starts at rest shortly before the motion. What the cameras see is the highest point of the surface over rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from zsdt.files import atomic_path
from zsdt.fluid.free_surface import FreeSurface
from zsdt.fluid.sampling import fill
from zsdt.fluid.solver import SphOptions, SphSolver
from zsdt.fluid.vessel import Vessel
from zsdt.fluid.wall_tables import WallTables
from zsdt.fluid.watch import WatchOptions
from zsdt.interop.sloshing import CYLINDER_DEPTH, CYLINDER_RADIUS, Kinematics, read_cylinder
from zsdt.scene import VesselShape, water

RIM = 0.17  # m
LEAD, TAIL = 0.1, 2.6  # s simulated before and after the motion
FPS = 60.0


class RecordedMotion:
    """A recorded motion as the solver wants it: straight lines between samples, then the last pose."""

    def __init__(self, kinematics: Kinematics):
        self._step = float(kinematics.times[1])
        self._samples = np.stack(
            [
                kinematics.acceleration,
                kinematics.gravity,
                kinematics.angular_velocity,
                kinematics.angular_acceleration,
            ]
        )

    def _at(self, which: int, t: float) -> Float[np.ndarray, "3"]:
        place = min(max(t / self._step, 0.0), self._samples.shape[1] - 1.001)
        k = int(place)
        left, right = self._samples[which, k], self._samples[which, k + 1]
        return left + (place - k) * (right - left)

    def acceleration(self, t: float) -> Float[np.ndarray, "3"]:
        """Of the middle of the floor [m/s2]."""
        return self._at(0, t)

    def gravity(self, t: float) -> Float[np.ndarray, "3"]:
        """In the axes of the glass [m/s2]."""
        return self._at(1, t)

    def angular_velocity(self, t: float) -> Float[np.ndarray, "3"]:
        """Of the glass [rad/s]."""
        return self._at(2, t)

    def angular_acceleration(self, t: float) -> Float[np.ndarray, "3"]:
        """Of the glass [rad/s2]."""
        return self._at(3, t)


@dataclass
class WaterRun:
    """What a simulation shows at the frames of a camera: times [s], highest point over rest [m], centroid [m].

    guards: contacts with the wall's guard; spilled: particles over the rim; close: largest share of particles, at any
    frame, that are nearer than half a spacing to another.
    """

    times: Float[np.ndarray, " frames"]
    highest: Float[np.ndarray, " frames"]
    centroid: Float[np.ndarray, "frames 3"]
    particles: int
    spacing: float
    guards: int
    spilled: int
    close: float


def glass() -> Vessel:
    """The glass on the robot."""
    return Vessel(VesselShape(heights=[0.0, RIM], radii=[CYLINDER_RADIUS, CYLINDER_RADIUS]))


class Basin:
    """Water at rest in the glass, made once for all recordings and kept in a file below `folder`."""

    def __init__(self, folder: Path, particles: int, sound_speed: float, seed: int = 0):
        self.vessel, self.liquid = glass(), water(sound_speed)
        self.options = SphOptions(watch=WatchOptions(nearest=0.0))  # spray meets; how much of it is counted below
        path = folder / f"rest_{particles}_{sound_speed:g}.npz"
        if not path.is_file():
            self._make(path, particles, seed)
        with np.load(path) as stored:
            self.points, self.spacing = stored["points"], float(stored["spacing"])
        self.tables = WallTables(self.vessel, 1.5 * self.spacing)

    def _make(self, path: Path, particles: int, seed: int) -> None:
        filling = fill(self.vessel, CYLINDER_DEPTH, particles, np.random.default_rng(seed))
        solver = SphSolver(self.vessel, self.liquid, filling.points, filling.spacing)
        solver.settle(0.4)
        with atomic_path(path) as part, part.open("wb") as file:
            np.savez(file, points=solver.frame().position, spacing=filling.spacing)

    def simulate(self, kinematics: Kinematics) -> WaterRun:
        """Runs the motion. Raises: RunRejected where it leaves the range of the solver."""
        solver = SphSolver(
            self.vessel,
            self.liquid,
            self.points,
            self.spacing,
            self.options,
            RecordedMotion(kinematics),
            self.tables,
        )
        solver.settle(0.2)
        surface = FreeSurface(self.vessel, self.spacing, CYLINDER_DEPTH)
        count = math.floor(float(kinematics.times[-1]) * FPS)
        highest, centroid, close = np.zeros(count + 1), np.zeros((count + 1, 3)), 0.0
        for k in range(count + 1):
            frame = solver.frame()
            inside = frame.position[frame.inside]
            highest[k], centroid[k] = surface.highest(inside), inside.mean(axis=0)
            nearest = np.asarray(cKDTree(inside).query(inside, k=2)[0])[:, 1]
            close = max(close, float((nearest < 0.5 * self.spacing).mean()))
            if k < count:
                solver.advance(1.0 / FPS)
        rest = highest[: max(round(LEAD * FPS), 1)].mean()
        return WaterRun(
            times=np.arange(count + 1) / FPS,
            highest=highest - rest,
            centroid=centroid,
            particles=len(self.points),
            spacing=self.spacing,
            guards=solver.guards,
            spilled=solver.spilled,
            close=close,
        )


def run_recording(name: str, folder: Path, particles: int, sound_speed: float) -> WaterRun:
    """The simulation of one recording, from the file below `folder` if it was made before.

    Raises: DataError, RunRejected.
    """
    path = folder / f"{name}_{particles}_{sound_speed:g}.npz"
    if not path.is_file():
        recording = read_cylinder(name)
        begin, _ = recording.span()
        run = Basin(folder, particles, sound_speed).simulate(recording.kinematics(begin - LEAD, TAIL))
        with atomic_path(path) as part, part.open("wb") as file:
            np.savez(file, **vars(run))
    with np.load(path) as stored:
        values = dict(stored)
    return WaterRun(
        times=values["times"],
        highest=values["highest"],
        centroid=values["centroid"],
        particles=int(values["particles"]),
        spacing=float(values["spacing"]),
        guards=int(values["guards"]),
        spilled=int(values["spilled"]),
        close=float(values["close"]),
    )
