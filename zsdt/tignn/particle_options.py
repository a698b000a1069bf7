"""Choices of the sub-step form for liquids (form=particle)."""

from __future__ import annotations

from dataclasses import dataclass

from zsdt.errors import OptionError


@dataclass
class ParticleOptions:
    """Lengths are in particle spacings, so that they hold for any resolution.

    cutoff: how far particles act on each other. skin: how much farther the neighbour list reaches. sound_speed [m/s]:
    stiffness of the liquid, never more than the liquid's own; slower is cheaper and softer. substeps per frame
    (0: from `courant` = sub-step * sound speed / spacing, and from the viscosity). guard: a particle nearer to a wall
    is put back; barrier, climb [m/s]: a soft potential before it that a particle of that speed just overcomes.
    degree: of the polynomials that are learned.

    fit_*: trajectories used; Gauss-Newton iterations on `fit_windows` windows of `fit_frames` frames (0: none), then
    `fit_rollouts` iterations on whole trajectories, of which every `fit_every`-th frame counts; `fit_energy`: weight
    of the internal energy beside displacement and velocity; `fit_ridge`: pull towards the textbook profiles (or those
    of the warm start).
    """

    cutoff: float = 3.0
    skin: float = 0.25
    sound_speed: float = 6.0
    substeps: int = 0
    courant: float = 0.8
    guard: float = 0.1
    barrier: float = 0.2
    climb: float = 0.5
    degree: int = 2
    fit_trajectories: int = 4
    fit_windows: int = 1
    fit_frames: int = 30
    fit_iterations: int = 0
    fit_rollouts: int = 3
    fit_every: int = 10
    fit_energy: float = 0.5
    fit_ridge: float = 1e-3

    def __post_init__(self) -> None:
        if not 1.2 < self.cutoff <= 4.0 or not 0 < self.skin <= 1.0:
            raise OptionError("particle.cutoff must lie in (1.2, 4] spacings and skin in (0, 1].")
        if self.sound_speed <= 0 or not 0 < self.courant <= 1.0 or self.substeps < 0:
            raise OptionError("particle.sound_speed must be positive, courant in (0, 1], substeps not negative.")
        if not 0 < self.guard < 0.5 or self.barrier <= 0 or self.climb < 0:
            raise OptionError("particle.guard must lie in (0, 0.5), barrier be positive, climb at least 0.")
        if not 0 <= self.degree <= 3 or min(self.fit_trajectories, self.fit_frames, self.fit_every) < 1:
            raise OptionError("particle.degree must lie in [0, 3], fit_trajectories, fit_frames, fit_every at least 1.")
        if min(self.fit_windows, self.fit_iterations, self.fit_rollouts) < 0 or self.fit_ridge <= 0:
            raise OptionError("particle.fit_windows, _iterations, _rollouts must be at least 0, fit_ridge positive.")
