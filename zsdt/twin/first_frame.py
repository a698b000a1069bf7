"""The first frame of the twin: it hangs at rest, and the picture says how it hangs.

The engine's own equilibrium is laid on what is seen. Three things are estimated together, because each of them bends
the line of the picture in its own way: the stiffness (a softer beam sags more, in the shape of its weight), the
camera's placement (a turn and a shift), and a smooth rest: what the model gets wrong, or a load that is already
there, if that explains the picture better. What is left at single points is the detection's error and stays with the
tracked point, so it is kept as that point's bias. Stress comes from Psi_ini at the smooth positions: at raw ones, half
a millimetre would be a percent of strain.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from zsdt.errors import RunRejected
from zsdt.tignn.cell_engine import CellEngine, CellState
from zsdt.trajectory import Body
from zsdt.twin.assimilation import AssimilationOptions, Fit, evidence, robust_fit
from zsdt.twin.beam_graph import moved, turn_about_y
from zsdt.twin.modes import Modes, vibration_modes
from zsdt.twin.observation import Measure, Observation, RayMeasure

log = logging.getLogger(__name__)

ITERATIONS, HELD_ITERATIONS = 3, 8
MISFIT = 0.05  # of the weight: forces by which the model's rest may be wrong
SIDEWAYS = 0.1  # of them: those out of the plane of the picture
TINY = 1e-9  # of what is known
HELD_ODDS = 5.0  # logarithm of the odds from which a load in the first frame is believed
MOST_DOUBT = 2.0  # standard deviations by which the stiffness may be changed
STIFFER = 0.1  # step in log stiffness over which the softening is taken
SCALE_DOUBT = 2e-3  # of the painted grid as a ruler
CAMERA = 5  # unknowns before the modes: log stiffness, turn, two shifts, scale


@dataclass(frozen=True)
class FirstFrame:
    """The started twin.

    body: with the calibrated material. measure: with the refined placement. bias [points, numbers] m: what the
    detection of the first frame got wrong at each point. force [modes]: modal load already there, 0 if none `held`.
    fit: of the last iteration (log stiffness over weight, turn, two shifts, scale, modes).
    """

    body: Body
    measure: Measure
    modes: Modes
    state: CellState
    bias: Float[np.ndarray, "points numbers"]
    force: Float[np.ndarray, " modes"]
    held: bool
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
    body, modes = calibrated(body, guess.log_stiffness, options), search.modes
    _prepare(engine, body, extra)
    if isinstance(measure, RayMeasure):
        told, measure = measure, _placed_anew(measure, fit.amplitude[1:CAMERA])
        observation = replace(observation, positions=_seen_anew(observation.positions, told, measure))
    misfit = np.zeros(len(guess.sag)) if held else fit.amplitude[CAMERA:]
    position = guess.rest + modes.shapes @ misfit
    fields = {"position": position, "velocity": np.zeros_like(position)}
    if psi_ini is not None:
        fields.update(psi_ini.infer_fields(body, position))
    force = guess.sag * modes.frequency**2
    state = engine.start(fields, nodal_force(engine, modes, force))
    bias = measure.values(observation.positions) - measure.values(operator @ position)
    bias = np.where(fit.taken[:, None] & np.isfinite(bias), bias, 0.0)
    return FirstFrame(body, measure, modes, state, bias, force, held, fit)


@dataclass(frozen=True)
class _Guess:
    """A stiffness (over weight), the modal amplitudes [m kg^1/2] that a load at rest would cause, the rest [m] with
    both, and its change by the logarithm of the stiffness [m]: a beam that hangs far down does not simply scale."""

    log_stiffness: float
    sag: Float[np.ndarray, " modes"]
    rest: Float[np.ndarray, "nodes 3"]
    softening: Float[np.ndarray, "nodes 3"]


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
        self.camera = [TINY] * (CAMERA - 1)
        if isinstance(measure, RayMeasure):
            self.camera = [roll_doubt, shift, shift, TINY if measure.has_depth else SCALE_DOUBT]
        self.scatter = measure.scatter(options.first_noise, options.depth_noise)
        _prepare(engine, body, extra)
        zero = np.zeros_like(body.points)
        self.state = engine.start({"position": body.points, "velocity": zero}, zero)
        rest = body.points + self.state.u[:-1]
        self.modes = vibration_modes(engine, rest, options.modes, 0 if planar else options.sideways_modes)
        self.begun = self.at(0.0, np.zeros(len(self.modes.frequency)), None)

    def run(self) -> tuple[_Guess, Fit, bool]:
        """The best guess, the last fit about it, and whether a load is held."""
        guess, fit = self._descend(False)
        if not self._holds_load(guess):
            return guess, fit, False
        return *self._descend(True), True

    def _descend(self, held: bool) -> tuple[_Guess, Fit]:
        guess, fit = self.begun, self._fit(self.begun, held)
        for _ in range(HELD_ITERATIONS if held else ITERATIONS):
            better = self._step(guess, fit, held)
            if better is None:
                break
            guess, fit = better, self._fit(better, held)
        return guess, fit

    def _fit(self, guess: _Guess, held: bool) -> Fit:
        rows, gap = self._linear(guess)
        return robust_fit(rows, gap, self.observation.seen, self._prior(held), self.options.gate)

    def _holds_load(self, guess: _Guess) -> bool:
        """Whether a load explains much better what the best guess without one leaves: Bayes factor of the priors."""
        if self.options.first_load == 0.0:
            return False
        without = self._prior(False)
        wide = np.maximum(without, np.concatenate([without[:CAMERA], self._prior(True)[CAMERA:]]))
        rows, gap = self._linear(guess)
        fit = robust_fit(rows, gap, self.observation.seen, wide, self.options.gate)
        odds = evidence(rows, gap, fit, wide) - evidence(rows, gap, fit, without)
        log.debug("A load in the first frame: log odds %.1f.", odds)
        return bool(odds > HELD_ODDS)

    def at(self, log_stiffness: float, sag: Float[np.ndarray, " modes"], near: _Guess | None) -> _Guess:
        """The guess with its rest, sought near another one. Raises: RunRejected where there is none.

        The softening is a difference over a step, at first over one of its own, later between the guesses.
        """

        load = nodal_force(self.engine, self.modes, sag * self.modes.frequency**2)

        def rest_of(stiffness: float, start: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "nodes 3"]:
            # All moduli scale together, so a stiffer body rests as this one under less.
            self.state.u[:-1] = start - self.body.points
            self.engine.equilibrate(self.state, (self.engine.weight + load) / np.exp(stiffness))
            return self.body.points + self.state.u[:-1]

        if near is None:
            ahead = rest_of(log_stiffness + STIFFER, self.body.points)
            rest = rest_of(log_stiffness, ahead)
            return _Guess(log_stiffness, sag, rest, (ahead - rest) / STIFFER)
        rest, step = rest_of(log_stiffness, near.rest), log_stiffness - near.log_stiffness
        same_load = np.array_equal(sag, near.sag)
        softening = (rest - near.rest) / step if same_load and abs(step) > 0.2 * STIFFER else near.softening
        return _Guess(log_stiffness, sag, rest, softening)

    def _step(self, guess: _Guess, fit: Fit, held: bool) -> _Guess | None:
        """A guess on the way to what the fit wants; None where there is none.

        A load bends the body far, so its steps must help; stiffness alone only scales what is there.
        """
        most = MOST_DOUBT * _doubt(self.options)
        wanted = float(np.clip(fit.amplitude[0], -most, most))
        sag = fit.amplitude[CAMERA:] if held else guess.sag
        for share in (1.0, 0.5, 0.25, 0.125):
            stiffness = guess.log_stiffness + share * (wanted - guess.log_stiffness)
            try:
                candidate = self.at(stiffness, guess.sag + share * (sag - guess.sag), guess)
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
        columns = _columns(self.measure, self.operator, points, guess.softening, self.modes)
        gap = self.measure.values(self.observation.positions) - self.measure.values(points)
        if not plain:
            gap = gap + columns[:, :, 0] * guess.log_stiffness + columns[:, :, CAMERA:] @ guess.sag
        return columns / self.scatter[:, None], gap / self.scatter

    def _prior(self, held: bool) -> Float[np.ndarray, " unknowns"]:
        """Variances of log stiffness, turn, two shifts, scale, and modal amplitudes.

        What the model gets wrong about its rest acts where its weight does, in the plane of the picture. A load and
        a softer beam look alike, so under a load the told stiffness is believed.
        """
        options, modes = self.options, self.modes
        known = held or not options.calibrate or self.body.material is None
        doubt = TINY if known else _doubt(options) + TINY
        mass = float(self.body.mass.sum())
        weight = mass * float(np.linalg.norm(self.body.gravity))
        force = MISFIT * weight * np.where(modes.planar, 1.0, SIDEWAYS)
        if held:
            force = np.maximum(options.first_load, force)
        return np.concatenate([np.square([doubt, *self.camera]), force**2 / mass / modes.frequency**4 + TINY**2])


def nodal_force(engine: CellEngine, modes: Modes, force: Float[np.ndarray, " modes"]) -> Float[np.ndarray, "nodes 3"]:
    """Forces on the nodes [N] of modal forces [N kg^-1/2]: smooth, and without work on any other mode."""
    return engine.inertia[:, None] * (modes.shapes @ force)


def _doubt(options: AssimilationOptions) -> float:
    """Standard deviation of the logarithm of stiffness over weight."""
    return float(np.hypot(options.stiffness_doubt, options.density_doubt))


def calibrated(body: Body, log_stiffness: float, options: AssimilationOptions) -> Body:
    """The body with the material that the first frame suggests.

    A sag says how stiff a beam is for its weight, and no more: what is missing is shared between Young's modulus and
    density by how much either card is doubted. The stress under the weight is proportional to the density, whatever
    the sag: where the told one is off, so is that stress, and no picture shows it.
    """
    if log_stiffness == 0.0 or body.material is None:
        return body
    heavier = options.density_doubt**2 / (options.stiffness_doubt**2 + options.density_doubt**2)
    stiffer, lighter = np.exp((1.0 - heavier) * log_stiffness), np.exp(-heavier * log_stiffness)
    foam = body.material
    material = replace(foam, young=foam.young * float(stiffer), density=foam.density * float(lighter))
    return replace(body, material=material, mass=body.mass * float(lighter))


def _prepare(engine: CellEngine, body: Body, extra: Float[np.ndarray, " nodes"]) -> None:
    engine.prepare(body)
    if extra.any():
        engine.attach_mass(extra)


def _columns(
    measure: Measure,
    operator: sp.csr_matrix,
    points: Float[np.ndarray, "points 3"],
    softening: Float[np.ndarray, "nodes 3"],
    modes: Modes,
) -> Float[np.ndarray, "points numbers unknowns"]:
    """Change of the measured numbers by log stiffness (`softening` [m]), turn [rad], shifts [m], scale, modes."""
    slopes = measure.slopes(points)
    turn = np.stack([points[:, 2], np.zeros(len(points)), -points[:, 0]], axis=1)
    moves = [operator @ softening, turn, np.eye(3)[0] + 0 * points, np.eye(3)[2] + 0 * points, 0 * points]
    fields = np.stack(moves, axis=2)
    columns = np.einsum("pki,pim->pkm", slopes, np.concatenate([fields, seen_shapes(operator, modes)], axis=2))
    columns[:, :, CAMERA - 1] = measure.values(points)
    return columns


def seen_shapes(operator: sp.csr_matrix, modes: Modes) -> Float[np.ndarray, "points 3 modes"]:
    """The modes at the observed points."""
    nodes = modes.shapes.shape[0]
    return np.ascontiguousarray((operator @ modes.shapes.reshape(nodes, -1)).reshape(operator.shape[0], 3, -1))


def _placed_anew(measure: RayMeasure, rigid: Float[np.ndarray, "4"]) -> RayMeasure:
    """The camera where it must be if what is seen was turned, shifted and enlarged by `rigid` (rad, m, m, 1)."""
    turn, shift = turn_about_y(float(rigid[0])), np.array([rigid[1], 0.0, rigid[2]])
    camera, depth = moved(measure.camera, turn.T, -turn.T @ shift), measure.depth / (1.0 + float(rigid[3]))
    nearer = camera.translation + np.array([0.0, 0.0, depth - measure.depth])
    return replace(measure, camera=replace(camera, translation=nearer), depth=depth)


def _seen_anew(positions: Float[np.ndarray, "points 3"], told: RayMeasure, now: RayMeasure) -> np.ndarray:
    """Positions [m] from the told camera as the newly placed one gives them from the same pixels."""
    seen = positions @ told.camera.rotation.T + told.camera.translation
    return (seen * (now.depth / told.depth) - now.camera.translation) @ now.camera.rotation
