"""Learning the profiles of the particle engine: Levenberg-Marquardt on rollouts, with finite differences.

A rollout costs a few milliseconds a frame, so the errors that are reported (displacement, velocity, internal energy
over a rollout) can be minimised themselves, by some twenty coefficients, in a few minutes on one core.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from zsdt.errors import RunRejected
from zsdt.tignn.engine import NodeField
from zsdt.tignn.particle_engine import ParticleEngine
from zsdt.tignn.particle_profiles import ParticleProfiles
from zsdt.trajectory import Trajectory

DIFFERENCE = 0.1  # of a logarithmic coefficient
LARGEST_STEP = 1.0
TRIALS = 5
RETREAT = 6.0  # by which the damping grows after a step that did not help


@dataclass
class Case:
    """A stretch of a trajectory to learn from: from frame `first` over `frames` frames, of which every n-th counts.

    engine: prepared for the body; cases of one trajectory share it. energy_weight: of the internal energy beside
    displacement and velocity, each of which is measured by its own size over the stretch.
    """

    trajectory: Trajectory
    engine: ParticleEngine
    first: int
    frames: int
    every: int
    energy_weight: float

    def residual(self, profiles: ParticleProfiles) -> Float[np.ndarray, " values"]:
        """Errors of displacement, velocity and internal energy; the Euclidean size of each part is its RRMSE.

        Raises: RunRejected where the liquid flies apart.
        """
        engine, load = self.engine, self.trajectory.load
        engine.use(profiles)
        state = engine.start(self.trajectory.at(self.first), load[self.first])
        begin = engine.read(state)
        parts: dict[str, list[tuple[NodeField, NodeField]]] = {"position": [], "velocity": [], "internal_energy": []}
        for step in range(1, self.frames + 1):
            frame = self.first + step
            engine.run(state, load[frame - 1], load[frame])
            if step % self.every and step != self.frames:
                continue
            ours = engine.read(state)
            for name, kept in parts.items():
                truth = self.trajectory.fields[name]
                moved = truth[frame] - (0.0 if name == "velocity" else truth[self.first])
                kept.append((ours[name] - (0.0 if name == "velocity" else begin[name]) - moved, moved))
        weights = {"position": 1.0, "velocity": 1.0, "internal_energy": self.energy_weight}
        return np.concatenate([_relative(kept) * weights[name] for name, kept in parts.items()]).astype(np.float32)


def _relative(kept: list[tuple[NodeField, NodeField]]) -> Float[np.ndarray, " values"]:
    error = np.concatenate([e.ravel() for e, _ in kept])
    return error / max(float(np.sqrt(sum((m**2).sum() for _, m in kept))), 1e-12)


def residuals(cases: list[Case], profiles: ParticleProfiles) -> Float[np.ndarray, " values"]:
    """Residuals of all cases one after the other; one infinite number where a liquid flew apart."""
    parts = []
    for case in cases:
        try:
            parts.append(case.residual(profiles))
        except RunRejected:
            return np.full(1, np.inf)
    return np.concatenate(parts) / np.float32(np.sqrt(len(cases)))


@dataclass
class Fit:
    """Where a fit stands: profiles, damping, and the mean squared error (with the pull of the anchor)."""

    profiles: ParticleProfiles
    damping: float = 1e-2
    cost: float = np.inf
    stuck: bool = False


def improve(
    fit: Fit, cases: list[Case], anchor: ParticleProfiles, ridge: float, tell: Callable[[str], None] | None = None
) -> Fit:
    """One Levenberg-Marquardt iteration on `cases`; `ridge` pulls the coefficients towards those of `anchor`.

    `stuck` is set where no step lowers the error.
    """
    theta, rest = fit.profiles.pack(), anchor.pack()
    here = residuals(cases, fit.profiles)
    if not np.isfinite(here).all():
        raise RunRejected("fit", "The particle engine flies apart with the profiles that the fit begins with.")
    cost = _cost(here, theta - rest, ridge)
    slopes = np.zeros((len(here), len(theta)), np.float32)
    for k in range(len(theta)):
        moved = theta.copy()
        moved[k] += DIFFERENCE
        there = residuals(cases, fit.profiles.like(moved))
        if len(there) == len(here):  # else it flew apart: this coefficient stays
            slopes[:, k] = (there - here) / DIFFERENCE
    normal = (slopes.T @ slopes).astype(float)
    gradient = (slopes.T @ here).astype(float) + ridge * (theta - rest)
    damping = fit.damping
    for _ in range(TRIALS):
        matrix = normal + np.diag(damping * np.diag(normal) + ridge)
        step = np.clip(-np.linalg.solve(matrix, gradient), -LARGEST_STEP, LARGEST_STEP)
        candidate = fit.profiles.like(theta + step)
        there = residuals(cases, candidate)
        new = _cost(there, theta + step - rest, ridge)
        if new < cost:
            if tell:
                tell(f"mean squared error {cost:.5f} -> {new:.5f}")
            return Fit(candidate, max(damping / 5.0, 1e-6), new)
        damping *= RETREAT
    return Fit(fit.profiles, damping, cost, stuck=True)


def _cost(values: np.ndarray, away: np.ndarray, ridge: float) -> float:
    return float((values.astype(float) ** 2).sum() + ridge * (away**2).sum())
