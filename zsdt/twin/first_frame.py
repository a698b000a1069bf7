"""The first frame of the twin: it hangs at rest, and the picture says how it hangs.

The engine's own equilibrium is laid on what is seen. Three things are estimated together, because each of them bends
the line of the picture in its own way: the stiffness (a softer beam sags more, in the shape of its weight), the
camera's placement (a turn and a shift), and a smooth rest: what the model gets wrong, or a load that is already
there, if that explains the picture better. What is left at single points is the detection's error and stays with the
tracked point, so it is kept as that point's bias. Stress comes from Psi_ini at the smooth positions: at raw ones, half
a millimetre would be a percent of strain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from zsdt.tignn.cell_engine import CellEngine, CellState
from zsdt.trajectory import Body
from zsdt.twin.assimilation import AssimilationOptions, Fit, evidence, robust_fit
from zsdt.twin.beam_graph import moved, turn_about_y
from zsdt.twin.modes import Modes, vibration_modes
from zsdt.twin.observation import Measure, Observation, RayMeasure

ITERATIONS = 3
TURN_DOUBT = 0.01  # rad: of a clamped column of a few nodes found to half a millimetre
MISFIT = 0.05  # of the weight: forces by which the model's rest may be wrong
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
    extra_mass: Float[np.ndarray, " nodes"] | None = None,
) -> FirstFrame:
    """Starts `engine` on what the first observation shows; `operator` [points, nodes] gives points from nodes.

    psi_ini: anything with ``infer_fields(body, positions)``; None: the stress of the model's own rest.
    Raises: RunRejected where the model finds no rest (a beam too heavy for its material).
    """
    given, extra = body, extra_mass if extra_mass is not None else np.zeros(body.nodes)
    scatter = measure.scatter(options.first_noise, options.depth_noise)
    rest = _rest(engine, body, body.points, extra)
    modes = vibration_modes(engine, rest, options.modes, 0 if planar else options.sideways_modes)
    log_stiffness, sag, held = 0.0, np.zeros(len(modes.frequency)), False
    for iteration in range(ITERATIONS):
        columns = _columns(measure, operator, operator @ rest, rest - body.points, modes)
        gap = measure.values(observation.positions) - measure.values(operator @ rest)
        gap = (gap + columns[:, :, 0] * log_stiffness + columns[:, :, CAMERA:] @ sag) / scatter
        rows = columns / scatter[:, None]
        if iteration == 0:
            held = _holds_load(rows, gap, observation.seen, engine, measure, modes, options)
        fit = robust_fit(rows, gap, observation.seen, _prior(engine, measure, modes, held, options), options.gate)
        log_stiffness = float(np.clip(fit.amplitude[0], -1.0, 1.0))
        sag = fit.amplitude[CAMERA:] if held else 0.0 * sag
        body = _stiffer(given, log_stiffness)
        rest = _rest(engine, body, rest, extra, modes, sag)
    if isinstance(measure, RayMeasure):
        measure = _placed_anew(measure, fit.amplitude[1:CAMERA])
        observation = replace(observation, positions=_turned_back(observation.positions, fit.amplitude[1:CAMERA]))
    position = rest + modes.shapes @ (fit.amplitude[CAMERA:] - sag)
    fields = {"position": position, "velocity": np.zeros_like(position)}
    if psi_ini is not None:
        fields.update(psi_ini.infer_fields(body, position))
    force = sag * modes.frequency**2
    state = engine.start(fields, nodal_force(engine, modes, force))
    bias = measure.values(observation.positions) - measure.values(operator @ position)
    bias = np.where(fit.taken[:, None] & np.isfinite(bias), bias, 0.0)
    return FirstFrame(body, measure, modes, state, bias, force, held, float(np.exp(log_stiffness)), fit)


def _holds_load(rows, gap, seen, engine, measure, modes, options: AssimilationOptions) -> bool:
    """Whether a load in the first frame explains it better than none does: Bayes factor of the two priors."""
    if options.first_load == 0.0:
        return False
    wide = _prior(engine, measure, modes, True, options)
    fit = robust_fit(rows, gap, seen, wide, options.gate)
    odds = evidence(rows, gap, fit, wide) - evidence(rows, gap, fit, _prior(engine, measure, modes, False, options))
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


def _prior(
    engine: CellEngine, measure: Measure, modes: Modes, held: bool, options: AssimilationOptions
) -> Float[np.ndarray, " unknowns"]:
    """Variances of log stiffness, turn, two shifts, and modal amplitudes."""
    tiny = 1e-18
    known = not options.calibrate or engine.body.material is None
    camera = [TURN_DOUBT**2, *[(2 * options.first_noise) ** 2] * 2] if isinstance(measure, RayMeasure) else [tiny] * 3
    mass = float(engine.body.mass.sum())
    misfit = MISFIT * mass * float(np.linalg.norm(engine.body.gravity))
    force = max(options.first_load, misfit) if held else misfit
    doubt = tiny if known else max(options.stiffness_doubt**2, tiny)
    return np.concatenate([[doubt], camera, (force**2 / mass + tiny) / modes.frequency**4])


def _placed_anew(measure: RayMeasure, rigid: Float[np.ndarray, "3"]) -> RayMeasure:
    """What is seen was turned and shifted against the body by `rigid` (rad, m, m): the camera's axes go back."""
    turn = turn_about_y(float(rigid[0]))
    shift = np.array([rigid[1], 0.0, rigid[2]])
    return replace(measure, camera=moved(measure.camera, turn.T, -turn.T @ shift))


def _turned_back(positions: Float[np.ndarray, "points 3"], rigid: Float[np.ndarray, "3"]) -> np.ndarray:
    turn = turn_about_y(float(rigid[0]))
    return (positions - np.array([rigid[1], 0.0, rigid[2]])) @ turn
