"""Learning the few constants of the cell energy: Levenberg-Marquardt on whole rollouts.

A rollout of the coarse graph costs 10-100 ms per simulated second, so the error that is reported (displacement over
a rollout, sag at rest) can be minimised itself, with finite differences by each logarithmic constant.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from zsdt.errors import RunRejected
from zsdt.tignn.cell_energy import FLAGS, GROUPS, CellConstants, CellOptions, EnergyCorrection, card_of, moduli_of
from zsdt.tignn.cell_engine import CellEngine
from zsdt.tignn.cell_stepping import advance
from zsdt.trajectory import Trajectory


@dataclass
class Case:
    """One trajectory to learn from: the engine prepared for its body, and the truth at every n-th frame.

    sag: displacement of the first frame from the stress-free shape; motion: displacement from the first frame.
    """

    trajectory: Trajectory
    engine: CellEngine
    frames: int
    every: int
    sag: Float[np.ndarray, "nodes 3"]
    motion: Float[np.ndarray, "kept nodes 3"]
    guess: Float[np.ndarray, "nodes 3"]

    def use(self, constants: CellConstants) -> None:
        """Sets other constants without choosing another sub-step."""
        engine = self.engine
        engine.constants = constants
        moduli = moduli_of(constants, engine.flags, card_of(engine.body), engine.options.memory)
        extra = engine.tables.relaxed.shape[1] - moduli.relaxed.shape[1]
        pad = ((0, 0), (0, extra))
        engine.tables = engine.tables._replace(
            relaxed=np.pad(moduli.relaxed, pad, mode="edge"),
            viscous=np.pad(moduli.viscous, pad, mode="edge"),
            tau=moduli.tau,
        )
        engine.refresh_memory_factors()
        engine.refresh_inertia()

    def roll(self) -> tuple[Float[np.ndarray, "nodes 3"], Float[np.ndarray, "kept nodes 3"]]:
        """The model's own sag, and its displacement from the first frame at the kept frames."""
        engine, load = self.engine, self.trajectory.load
        first = {"position": engine.body.points + self.guess, "velocity": self.trajectory.fields["velocity"][0]}
        state = engine.start(first, load[0])
        rest = state.u[:-1].copy()
        kept = np.full((len(self.motion), *rest.shape), np.nan)
        for frame in range(1, self.frames):
            advance(
                engine.tables, state.memory, state.u, state.velocity, state.force, engine.inverse_mass, state.steady,
                load[frame - 1], load[frame], engine.steps, engine.dt, engine.corner,
            )  # fmt: skip
            if frame % self.every == 0:
                kept[frame // self.every - 1] = state.u[:-1] - rest
        return rest, kept

    def residual(self, motion: bool) -> Float[np.ndarray, " values"]:
        """Sag error over the sag and, with `motion`, rollout error over the motion; each of Euclidean size RRMSE."""
        free = ~self.engine.body.clamped
        if motion:
            rest, kept = self.roll()
        else:
            first = {"position": self.engine.body.points + self.guess, "velocity": np.zeros_like(self.guess)}
            rest = self.engine.start(first, self.trajectory.load[0]).u[:-1]
        sag = (rest - self.sag)[free].ravel() / np.linalg.norm(self.sag[free])
        if not motion:
            return sag
        size = np.linalg.norm(self.motion[:, free])
        return np.concatenate([sag, (kept - self.motion)[:, free].ravel() / max(size, 1e-12)])


def make_case(
    trajectory: Trajectory,
    constants: CellConstants,
    options: CellOptions,
    correction: EnergyCorrection | None = None,
) -> Case:
    """A case of `trajectory`, its first `fit_frames` frames."""
    engine = CellEngine(constants, options, correction)
    engine.prepare(trajectory.body)
    frames = min(trajectory.frames, options.fit_frames + 1)
    position = trajectory.fields["position"]
    kept = position[options.fit_every : frames : options.fit_every] - position[0]
    sag = position[0] - trajectory.body.points
    return Case(trajectory, engine, frames, options.fit_every, sag, kept, sag.copy())


def pack(constants: CellConstants, boundary: bool) -> Float[np.ndarray, " parameters"]:
    """Constants as one vector of logarithms."""
    return np.concatenate([constants.theta, constants.boundary.ravel()]) if boundary else constants.theta.copy()


def unpack(vector: Float[np.ndarray, " parameters"], like: CellConstants) -> CellConstants:
    """The inverse of `pack`."""
    count = len(like.theta)
    boundary = vector[count:].reshape(len(GROUPS), len(FLAGS)) if len(vector) > count else like.boundary
    return CellConstants(theta=vector[:count].copy(), boundary=boundary.copy(), card=like.card)


def residuals(cases: Iterable[Case], motion: bool) -> Float[np.ndarray, " values"]:
    """Residuals of all cases one after the other; one infinite number where a model collapsed or found no rest."""
    parts = []
    for case in cases:
        try:
            parts.append(case.residual(motion))
        except RunRejected:
            return np.full(1, np.inf)
    values = np.concatenate(parts)
    return values if np.isfinite(values).all() else np.full(1, np.inf)


Residual = Callable[[Float[np.ndarray, " parameters"]], Float[np.ndarray, " values"]]


def levenberg_marquardt(
    function: Residual,
    vector: Float[np.ndarray, " parameters"],
    iterations: int,
    prior: float,
    log: Callable[[int, float, Float[np.ndarray, " parameters"]], None],
    step: float = 0.01,
) -> Float[np.ndarray, " parameters"]:
    """Minimises `|function(vector)|^2 + prior^2 |vector - start|^2` with finite differences of `step`.

    `log(iteration, sum of squares, vector)` is called after every iteration that gained.
    Raises: RunRejected where the model collapses next to the vector at hand.
    """
    anchor, damping = vector.copy(), 1e-2
    value = function(vector)
    for iteration in range(iterations):
        jacobian = np.empty((len(value), len(vector)))
        for k in range(len(vector)):
            moved = vector.copy()
            moved[k] += step
            shifted = function(moved)
            if len(shifted) != len(value) or not np.isfinite(value).all():
                raise RunRejected("fit", "The cell model collapses while it is fitted; start from stiffer constants.")
            jacobian[:, k] = (shifted - value) / step
        normal, slope = jacobian.T @ jacobian, jacobian.T @ value
        diagonal = normal.diagonal()
        before = value @ value + prior**2 * ((vector - anchor) ** 2).sum()
        after = before
        for _ in range(6):
            system = normal + np.diag(prior**2 + damping * (diagonal + 1e-3 * diagonal.max()))
            move = -np.linalg.solve(system, slope + prior**2 * (vector - anchor))
            candidate = vector + np.clip(move, -0.7, 0.7)
            tried = function(candidate)
            after = tried @ tried + prior**2 * ((candidate - anchor) ** 2).sum()
            if len(tried) == len(value) and after < before:
                vector, value, damping = candidate, tried, max(damping / 10, 1e-7)
                log(iteration, float(value @ value), vector)
                break
            damping *= 10
        if before - after < 1e-3 * before:
            break
    return vector


def fit_constants(
    cases: list[Case],
    constants: CellConstants,
    iterations: int,
    motion: bool,
    boundary: bool,
    log: Callable[[int, float, CellConstants], None],
    prior: float = 3e-3,
) -> CellConstants:
    """Constants that minimise the errors of `cases`; without `motion` only of their sag.

    `prior`: weight per case of a pull towards the values at the start, so that what no case shows stays where it is.
    `log(iteration, root mean square of the cases' errors, constants)` is called after every iteration.
    """

    def function(vector: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " values"]:
        for case in cases:
            case.use(unpack(vector, constants))
        return residuals(cases, motion)

    def tell(iteration: int, squares: float, vector: Float[np.ndarray, " parameters"]) -> None:
        log(iteration, float(np.sqrt(squares / len(cases))), unpack(vector, constants))

    start = pack(constants, boundary)
    pull = prior * np.sqrt(len(cases))
    return unpack(levenberg_marquardt(function, start, iterations, pull, tell), constants)


def fit_correction(
    cases: list[Case],
    correction: EnergyCorrection,
    iterations: int,
    log: Callable[[int, float], None],
    prior: float = 3e-3,
) -> None:
    """Output weights of the correction network by the same rollouts; its hidden layer keeps its random features."""
    shape = correction.outer.shape

    def put(vector: Float[np.ndarray, " parameters"]) -> None:
        with torch.no_grad():
            correction.outer.copy_(torch.as_tensor(vector[: shape.numel()]).reshape(shape))
            correction.outer_bias.copy_(torch.as_tensor(vector[shape.numel() :]))

    def function(vector: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " values"]:
        put(vector)
        for case in cases:
            case.engine.refresh_correction()
        return residuals(cases, True)

    start = np.concatenate([correction.outer.detach().numpy().ravel(), correction.outer_bias.detach().numpy()])
    found = levenberg_marquardt(
        function, start, iterations, prior * np.sqrt(len(cases)),
        lambda iteration, squares, _: log(iteration, float(np.sqrt(squares / len(cases)))), step=0.02,
    )  # fmt: skip
    put(found)
