"""The first frame of the twin: it hangs at rest, and the picture says how it hangs.

The engine's own equilibrium is laid on what is seen. Three things are estimated together, because each of them bends
the line of the picture in its own way: the stiffness (a softer beam sags more, in the shape of its weight), the
camera's placement (a turn and a shift), and a smooth rest: what the model gets wrong, or a load that is already
there, if that explains the picture better. What is left at single points is the detection's error and stays with the
tracked point, so it is kept as that point's bias. Stress comes from Psi_ini at the smooth positions: at raw ones, half
a millimetre would be a percent of strain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float

from zsdt.errors import RunRejected
from zsdt.tignn.cell_engine import CellEngine, CellState
from zsdt.trajectory import Body
from zsdt.twin.assimilation import AssimilationOptions, Fit, evidence, robust_fit
from zsdt.twin.beam_graph import moved, turn_about_y
from zsdt.twin.modes import Modes, vibration_modes
from zsdt.twin.observation import Measure, Observation, RayMeasure

ITERATIONS, HELD_ITERATIONS = 3, 8
MISFIT = 0.05  # of the weight: forces by which the model's rest may be wrong
SIDEWAYS = 0.1  # of them: those out of the plane of the picture
TINY = 1e-9  # of what is known
HELD_SHARE = 0.3  # of beams that are believed to hold a load in the first frame before it is looked at
CAMERA = 4  # unknowns before the modes: log stiffness, turn, two shifts


@dataclass(frozen=True)
class FirstFrame:
    """The started twin.

    body: with the calibrated material. measure: with the refined placement. bias [points, numbers] m: what the
    detection of the first frame got wrong at each point. force [modes]: modal load already there, 0 if none `held`.
    stiffness: factor on Young's modulus. fit: of the last iteration (log stiffness, turn, two shifts, modes).
    """

    body: Body
    measure: Measure
    modes: Modes
    state: CellState
    bias: Float[np.ndarray, "points numbers"]
    force: Float[np.ndarray, " modes"]
    held: bool
    stiffness: float
    fit: Fit


def first_frame(
    engine: CellEngine,
    psi_ini: Any | None,
    body: Body,
    observation: Observation,
    measure: Measure,
    operator: sp.csr_matrix,
    planar: bool,
    options: AssimilationOptions,
    roll_doubt: float,
    extra_mass: Float[np.ndarray, " nodes"] | None = None,
) -> FirstFrame:
    """Starts `engine` on what the first observation shows; `operator` [points, nodes] gives points from nodes.

    psi_ini: anything with ``infer_fields(body, positions)``; None: the stress of the model's own rest. roll_doubt
    [rad]: of the camera's placement.
    Raises: RunRejected where the model finds no rest (a beam too heavy for its material).
    """
    extra = extra_mass if extra_mass is not None else np.zeros(body.nodes)
    search = _Search(engine, body, extra, observation, measure, operator, planar, options, roll_doubt)
    guess, fit, held = search.run()
    body, modes = _stiffer(body, guess.log_stiffness), search.modes
    guess = search.at(guess.log_stiffness, guess.sag, guess.rest)  # leaves the engine prepared for this body
    if isinstance(measure, RayMeasure):
        measure = _placed_anew(measure, fit.amplitude[1:CAMERA])
        observation = replace(observation, positions=_turned_back(observation.positions, fit.amplitude[1:CAMERA]))
    misfit = np.zeros(len(guess.sag)) if held else fit.amplitude[CAMERA:]
    position = guess.rest + modes.shapes @ misfit
    fields = {"position": position, "velocity": np.zeros_like(position)}
    if psi_ini is not None:
        fields.update(psi_ini.infer_fields(body, position))
    force = guess.sag * modes.frequency**2
    state = engine.start(fields, nodal_force(engine, modes, force))
    bias = measure.values(observation.positions) - measure.values(operator @ position)
    bias = np.where(fit.taken[:, None] & np.isfinite(bias), bias, 0.0)
    return FirstFrame(body, measure, modes, state, bias, force, held, float(np.exp(guess.log_stiffness)), fit)


@dataclass(frozen=True)
class _Guess:
    """A stiffness, the modal amplitudes [m kg^1/2] that a load at rest would cause, and the rest [m] with both."""

    log_stiffness: float
    sag: Float[np.ndarray, " modes"]
    rest: Float[np.ndarray, "nodes 3"]


class _Search:
    """Gauss-Newton over stiffness, placement, and misfit or load; steps are halved until they can be taken."""

    def __init__(
        self,
        engine: CellEngine,
        body: Body,
        extra: Float[np.ndarray, " nodes"],
        observation: Observation,
        measure: Measure,
        operator: sp.csr_matrix,
        planar: bool,
        options: AssimilationOptions,
        roll_doubt: float,
    ):
        self.engine, self.body, self.extra, self.observation = engine, body, extra, observation
        self.measure, self.operator, self.options = measure, operator, options
        shift = 2 * options.first_noise
        self.camera = [roll_doubt, shift, shift] if isinstance(measure, RayMeasure) else [TINY] * 3
        self.scatter = measure.scatter(options.first_noise, options.depth_noise)
        rest = _rest(engine, body, body.points, extra)
        self.modes = vibration_modes(engine, rest, options.modes, 0 if planar else options.sideways_modes)
        self.begun = _Guess(0.0, np.zeros(len(self.modes.frequency)), rest)

    def run(self) -> tuple[_Guess, Fit, bool]:
        """The best guess, the last fit about it, and whether a load is held."""
        guess, seen, gate = self.begun, self.observation.seen, self.options.gate
        rows, gap = self._linear(guess)
        held = _holds_load(rows, gap, seen, self._prior, self.options)
        fit = robust_fit(rows, gap, seen, self._prior(held), gate)
        for _ in range(HELD_ITERATIONS if held else ITERATIONS):
            better = self._step(guess, fit, held)
            if better is None:
                break
            guess = better
            rows, gap = self._linear(guess)
            fit = robust_fit(rows, gap, seen, self._prior(held), gate)
        return guess, fit, held

    def at(self, log_stiffness: float, sag: Float[np.ndarray, " modes"], near: Float[np.ndarray, "nodes 3"]) -> _Guess:
        """The guess with its rest, sought from `near`. Raises: RunRejected where there is none."""
        body = _stiffer(self.body, log_stiffness)
        return _Guess(log_stiffness, sag, _rest(self.engine, body, near, self.extra, self.modes, sag))

    def _step(self, guess: _Guess, fit: Fit, held: bool) -> _Guess | None:
        """A guess on the way to what the fit wants; None where there is none.

        A load bends the body far, so its steps must help; stiffness alone only scales what is there.
        """
        wanted = float(np.clip(fit.amplitude[0], -1.0, 1.0))
        sag = fit.amplitude[CAMERA:] if held else guess.sag
        for share in (1.0, 0.5, 0.25, 0.125):
            stiffness = guess.log_stiffness + share * (wanted - guess.log_stiffness)
            try:
                candidate = self.at(stiffness, guess.sag + share * (sag - guess.sag), guess.rest)
            except RunRejected:
                continue
            if not held or self._misfit(candidate, fit) <= 1.02 * self._misfit(guess, fit):
                return candidate
        return None

    def _misfit(self, guess: _Guess, fit: Fit) -> float:
        """Root mean square of what is seen less what would be, without what the placement explains."""
        rows, gap = self._linear(guess, plain=True)
        left = gap - rows[:, :, 1:CAMERA] @ fit.amplitude[1:CAMERA]
        return float(np.sqrt((left[fit.taken] ** 2).mean())) if fit.taken.any() else np.inf

    def _linear(
        self, guess: _Guess, plain: bool = False
    ) -> tuple[Float[np.ndarray, "points numbers unknowns"], Float[np.ndarray, "points numbers"]]:
        """Columns and gap over the scatter; the gap is that to stiffness and load of zero, or `plain` to the guess."""
        points = self.operator @ guess.rest
        columns = _columns(self.measure, self.operator, points, guess.rest - self.body.points, self.modes)
        gap = self.measure.values(self.observation.positions) - self.measure.values(points)
        if not plain:
            gap = gap + columns[:, :, 0] * guess.log_stiffness + columns[:, :, CAMERA:] @ guess.sag
        return columns / self.scatter[:, None], gap / self.scatter

    def _prior(self, held: bool) -> Float[np.ndarray, " unknowns"]:
        """Variances of log stiffness, turn, two shifts, and modal amplitudes.

        What the model gets wrong about its rest acts where its weight does, in the plane of the picture. A load and
        a softer beam look alike, so under a load the told stiffness is believed.
        """
        options, modes = self.options, self.modes
        known = held or not options.calibrate or self.body.material is None
        doubt = TINY if known else options.stiffness_doubt + TINY
        mass = float(self.body.mass.sum())
        weight = mass * float(np.linalg.norm(self.body.gravity))
        force = MISFIT * weight * np.where(modes.planar, 1.0, SIDEWAYS)
        if held:
            force = np.maximum(options.first_load, force)
        return np.concatenate([np.square([doubt, *self.camera]), force**2 / mass / modes.frequency**4 + TINY**2])


def _holds_load(
    rows: Float[np.ndarray, "points numbers unknowns"],
    gap: Float[np.ndarray, "points numbers"],
    seen: Bool[np.ndarray, " points"],
    prior_of: Callable[[bool], Float[np.ndarray, " unknowns"]],
    options: AssimilationOptions,
) -> bool:
    """Whether a load in the first frame explains it better than none does: Bayes factor of the two priors."""
    if options.first_load == 0.0:
        return False
    wide = prior_of(True)
    fit = robust_fit(rows, gap, seen, wide, options.gate)
    odds = evidence(rows, gap, fit, wide) - evidence(rows, gap, fit, prior_of(False))
    return bool(odds + np.log(HELD_SHARE / (1.0 - HELD_SHARE)) > 0.0)


def nodal_force(engine: CellEngine, modes: Modes, force: Float[np.ndarray, " modes"]) -> Float[np.ndarray, "nodes 3"]:
    """Forces on the nodes [N] of modal forces [N kg^-1/2]: smooth, and without work on any other mode."""
    return engine.inertia[:, None] * (modes.shapes @ force)


def _stiffer(body: Body, log_stiffness: float) -> Body:
    if log_stiffness == 0.0 or body.material is None:
        return body
    return replace(body, material=replace(body.material, young=body.material.young * float(np.exp(log_stiffness))))


def _rest(
    engine: CellEngine,
    body: Body,
    near: Float[np.ndarray, "nodes 3"],
    extra: Float[np.ndarray, " nodes"],
    modes: Modes | None = None,
    sag: Float[np.ndarray, " modes"] | None = None,
) -> Float[np.ndarray, "nodes 3"]:
    """The model's own equilibrium [m] under weight, sought from `near`; with the load that alone would cause the
    modal amplitudes `sag`."""
    engine.prepare(body)
    if extra.any():
        engine.attach_mass(extra)
    load = np.zeros_like(near)
    if modes is not None and sag is not None and sag.any():
        load = nodal_force(engine, modes, sag * modes.frequency**2)
    state = engine.start({"position": near, "velocity": np.zeros_like(near)}, load)
    return body.points + state.u[:-1]


def _columns(
    measure: Measure,
    operator: sp.csr_matrix,
    points: Float[np.ndarray, "points 3"],
    sag: Float[np.ndarray, "nodes 3"],
    modes: Modes,
) -> Float[np.ndarray, "points numbers unknowns"]:
    """Change of the measured numbers by log stiffness, turn [rad], shifts x and z [m], and the modes."""
    slopes = measure.slopes(points)
    turn = np.stack([points[:, 2], np.zeros(len(points)), -points[:, 0]], axis=1)
    moves = [-(operator @ sag), turn, np.eye(3)[0] + 0 * points, np.eye(3)[2] + 0 * points]
    fields = np.stack(moves, axis=2)
    return np.einsum("pki,pim->pkm", slopes, np.concatenate([fields, seen_shapes(operator, modes)], axis=2))


def seen_shapes(operator: sp.csr_matrix, modes: Modes) -> Float[np.ndarray, "points 3 modes"]:
    """The modes at the observed points."""
    nodes = modes.shapes.shape[0]
    return np.ascontiguousarray((operator @ modes.shapes.reshape(nodes, -1)).reshape(operator.shape[0], 3, -1))


def _placed_anew(measure: RayMeasure, rigid: Float[np.ndarray, "3"]) -> RayMeasure:
    """What is seen was turned and shifted against the body by `rigid` (rad, m, m): the camera's axes go back."""
    turn = turn_about_y(float(rigid[0]))
    shift = np.array([rigid[1], 0.0, rigid[2]])
    return replace(measure, camera=moved(measure.camera, turn.T, -turn.T @ shift))


def _turned_back(positions: Float[np.ndarray, "points 3"], rigid: Float[np.ndarray, "3"]) -> np.ndarray:
    turn = turn_about_y(float(rigid[0]))
    return (positions - np.array([rigid[1], 0.0, rigid[2]])) @ turn
