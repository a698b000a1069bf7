"""Runs a hard case of a beam: by the solver, by a network alone, and by the twin before a camera without pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from zsdt.errors import DataError, RunRejected
from zsdt.evaluation.stability import left_range
from zsdt.evaluation.stability_beam_cases import FPS, BeamCase, Spoilt
from zsdt.evaluation.stability_faults import spoiling
from zsdt.evaluation.stability_pixels import SIDE, DrawnGrid, GreySource, NodeTracker, SeenNodes
from zsdt.evaluation.stability_row import Outcome, Party, Row, books
from zsdt.evaluation.stability_trust import gauges_of, watched
from zsdt.perception.grid_graph import ClampChoice, GridOptions
from zsdt.shipped import TwinWeights
from zsdt.solid.mesh import CoarseView, mesh_of
from zsdt.solid.solver import BrickSolver, Load
from zsdt.tignn.engine import Engine, NodeField, Rollout, load_engine, roll_out
from zsdt.tignn.psi_ini import load as load_psi_ini
from zsdt.trajectory import Body, Trajectory
from zsdt.twin.loop import TwinOptions, run_twin
from zsdt.twin.twin_log import FrameStatus, TwinLog
from zsdt.twin.twin_scene import BeamTwinScene

STRESS = 2e3  # Pa: standard deviation of the stress of a first frame that is random
STRAIN = (
    0.02  # of the pitch: of a random first displacement of the solver, which knows no stress but that of its strain
)
OUTPUT = ("position", "velocity", "stress", "elastic_energy", "dissipated_energy")
BOOKS = ("kinetic", "elastic", "dissipated", "work_load", "work_gravity")


@dataclass
class BeamTruth:
    """What the solver says of a case: a trajectory of all wanted frames, of which the first `known` are true (NaN in
    fields and ledger from there on), and why it gave up where it did."""

    trajectory: Trajectory
    known: int
    reason: str = ""


def body_of(case: BeamCase, told: bool) -> Body:
    """The beam as its graph sees it, of the true material or of the told one."""
    mesh, material = mesh_of(case.shape, case.pitch_cm / 100.0), case.told if told else case.material
    grid = mesh.grid
    return Body(
        points=grid.points,
        pairs=grid.pairs,
        clamped=grid.points[:, 0] < 1e-9,
        mass=material.density * mesh.volume,
        frame_dt=1.0 / FPS,
        pitch=mesh.edge,
        gravity=np.array([0.0, 0.0, -9.81 * case.gravity]),
        cells=grid.cells,
        material=material,
    )


def thrown(case: BeamCase) -> Float[np.ndarray, "3"]:
    """What is added to the place of a node whose state is spoilt [m]."""
    if case.spoilt is Spoilt.nan:
        return np.array([np.nan, 0.0, 0.0])
    return np.array([0.0, 0.0, 0.5 * case.shape.length])


def beam_truth(case: BeamCase, spoilt: bool = False) -> BeamTruth:
    """Runs the solver. spoilt: with the wrong state of the case, as the solver's own row wants it; else without.

    Raises: RunRejected where the beam finds no rest under its first load.
    """
    fine = mesh_of(case.shape, case.mesh_cm / 100.0)
    body = body_of(case, told=False)
    view = CoarseView(fine, mesh_of(case.shape, case.pitch_cm / 100.0))
    force, factors = case.force(fine.grid.points), case.factors()
    load = factors[:, None, None] * (view.spread @ force)
    solver = BrickSolver(fine, case.material, gravity=body.gravity)
    substeps = int(np.ceil(body.frame_dt / solver.dt - 1e-9))
    solver.dt = body.frame_dt / substeps
    first = Load(nodal=factors[0] * force)
    if load[0].any() or body.gravity.any():
        solver.relax(first)
    else:
        solver.set_state(np.zeros((fine.nodes, 3)), None, first)
    if spoilt and case.spoilt is Spoilt.random_stress:
        wander = STRAIN * body.pitch * np.random.default_rng(0).standard_normal((fine.nodes, 3))
        solver.set_state(solver.displacement + np.where(solver.free, wander, 0.0), None, first)
    fields = {
        name: np.full((case.frames, body.nodes, w), np.nan) for name, w in zip(OUTPUT, (3, 3, 6, 1, 1), strict=True)
    }
    ledger = {name: np.full(case.frames, np.nan) for name in BOOKS}
    known, reason = 0, ""
    try:
        for k in range(case.frames):
            if k:
                start = Load(nodal=factors[k - 1] * force)
                solver.step(start, np.zeros(substeps), nodal_next=factors[k] * force)
            frame = solver.frame()
            for name in ("position", "velocity", "stress"):
                fields[name][k] = getattr(frame, name)[view.picked]
            for name in ("elastic_energy", "dissipated_energy"):
                fields[name][k] = (view.spread @ (getattr(frame, name) * fine.volume[:, None])) / view.coarse.volume[
                    :, None
                ]
            for name in BOOKS:
                ledger[name][k] = getattr(frame, name)
            known = k + 1
            if spoilt and case.spoilt in (Spoilt.nan, Spoilt.outlier) and k == case.spoilt_frame:
                moved = solver.displacement
                moved[len(moved) // 2] += thrown(case)
                solver.displacement = moved
    except RunRejected as error:
        reason = f"{error.cause}: {error}"
    times = body.frame_dt * np.arange(case.frames)
    return BeamTruth(Trajectory(body, times, fields, load, ledger, {"name": case.name}), known, reason)


def run_beam(case: BeamCase, party: Party, truth: BeamTruth, weights: TwinWeights, soft: str | None = None) -> Row:
    """One party in a case of which the truth is known. weights: of the shipped network and twin; soft: folder of a
    network of the seed's form.

    Raises: RunRejected, DataError where it gives up before its first frame.
    """
    if party is Party.solver:
        if case.spoilt is not Spoilt.nothing:
            truth = beam_truth(case, spoilt=True)
        growth, least = books(truth.trajectory.ledger)
        outcome = Outcome.rejected if truth.reason else _in_range(truth.trajectory, truth.trajectory.fields["position"])
        return Row(case.name, case.kind, party, outcome, truth.reason, case.frames, [], growth, least)
    if party is Party.twin:
        return _twin_row(case, truth, run_beam_twin(case, truth, weights))
    folder = str(weights.tignn) if party is Party.network or soft is None else soft
    return network_row(case, party, truth, load_engine(folder))


def network_row(case: BeamCase, party: Party, truth: BeamTruth, engine: Engine) -> Row:
    """The network alone: from the true first frame, under the true loads, with the told material."""
    told = replace(truth.trajectory, body=body_of(case, told=True), fields=first_fields(case, truth))
    if case.spoilt in (Spoilt.nan, Spoilt.outlier):
        engine = spoiling(engine, case.spoilt_frame, thrown(case))
    rollout = roll_out(engine, told)
    growth, least = books(rollout.account)
    row = Row(case.name, case.kind, party, Outcome.rejected, rollout.reason, case.frames, [], growth, least)
    row.flags, row.gauges = gauges_of(watched(told, rollout), told.body)
    row.error = error_of(case, truth, rollout.fields["position"])
    row.hidden = hidden_of(case, truth, rollout.fields["stress"])
    if not rollout.reason:
        row.outcome, row.reason = _judged(told, rollout)
    return row


def first_fields(case: BeamCase, truth: BeamTruth) -> dict[str, Float[np.ndarray, "frames nodes _"]]:
    """Fields of which the first frame is where a network begins."""
    fields = dict(truth.trajectory.fields)
    if case.spoilt is Spoilt.random_stress:
        random = STRESS * np.random.default_rng(0).standard_normal(fields["stress"][0].shape)
        fields["stress"] = np.broadcast_to(random, fields["stress"].shape)
    return fields


def _judged(trajectory: Trajectory, rollout: Rollout) -> tuple[Outcome, str]:
    if rollout.diverged_at is not None:
        return Outcome.failed, f"not finite at frame {rollout.diverged_at}"
    found = _in_range(trajectory, rollout.fields["position"])
    return found, "" if found is Outcome.bounded else "left the range in which bodies can be"


def _in_range(trajectory: Trajectory, position: Float[np.ndarray, "frames nodes 3"]) -> Outcome:
    rollout = Rollout("", {"position": position}, np.zeros(0))
    return Outcome.bounded if left_range(trajectory, rollout) is None else Outcome.failed


def error_of(case: BeamCase, truth: BeamTruth, position: Float[np.ndarray, "frames nodes 3"]) -> list[float]:
    """Root mean square distance of the free nodes from the truth over the beam's length, frame by frame."""
    body = truth.trajectory.body
    count = min(len(position), truth.known)
    off = (position[:count] - truth.trajectory.fields["position"][:count])[:, ~body.clamped]
    return [float(x) for x in np.sqrt(np.square(off).sum(axis=2).mean(axis=1)) / case.shape.length]


def hidden_of(case: BeamCase, truth: BeamTruth, stress: Float[np.ndarray, "frames nodes 6"]) -> list[float]:
    """Root mean square error of the stress at all nodes over Young's modulus, frame by frame."""
    count = min(len(stress), truth.known)
    off = stress[:count] - truth.trajectory.fields["stress"][:count]
    return [float(x) for x in np.sqrt(np.square(off).mean(axis=(1, 2))) / case.material.young]


class RandomStress:
    """A Psi_ini that says anything."""

    def infer_fields(self, body: Body, positions: Any) -> dict[str, NodeField]:
        """Stress [nodes, 6] Pa at random."""
        return {"stress": STRESS * np.random.default_rng(0).standard_normal((body.nodes, 6))}


def run_beam_twin(case: BeamCase, truth: BeamTruth, weights: TwinWeights) -> TwinLog:
    """The closed loop on the frames that the truth knows; nobody tells it the load."""
    body, engine = truth.trajectory.body, load_engine(weights.tignn)
    if case.spoilt in (Spoilt.nan, Spoilt.outlier):
        engine = spoiling(engine, case.spoilt_frame, thrown(case))
    psi_ini: Any = None if weights.psi_ini is None else load_psi_ini(weights.psi_ini)
    if case.spoilt is Spoilt.random_stress:
        psi_ini = RandomStress()
    seen = SeenNodes.of(body, truth.trajectory.fields["position"][: truth.known])
    scene = BeamTwinScene(
        width=case.shape.width,
        pitch=body.pitch,
        material=case.told,
        gravity=9.81 * case.gravity,
        fps=FPS,
        depth=seen.depth,
        clamp_side=ClampChoice(SIDE.value),
        fields=["stress"],
    )
    return run_twin(
        GreySource(truth.known, FPS),
        DrawnGrid(seen),
        scene,
        TwinOptions(grid=GridOptions(clamp_side=ClampChoice(SIDE.value))),
        camera=seen.camera,
        engine=engine,
        psi_ini=psi_ini,
        tracker=NodeTracker(seen),
    )


def _twin_row(case: BeamCase, truth: BeamTruth, log: TwinLog) -> Row:
    body = truth.trajectory.body
    if log.body.nodes != body.nodes or not np.allclose(log.body.points, body.points, atol=0.1 * body.pitch):
        raise DataError(f"The twin's grid has {log.body.nodes} nodes, the beam {body.nodes}.")
    restarts = [k for k, status in enumerate(log.status) if status == FrameStatus.restarted.value]
    growth, least = books(log.account, restarts)
    row = Row(case.name, case.kind, Party.twin, _in_range(truth.trajectory, log.positions), "", case.frames)
    row.error, row.energy_growth, row.entropy_min = error_of(case, truth, log.positions), growth, least
    row.hidden = hidden_of(case, truth, log.fields["stress"])
    found = {"stiffness_found": log.stiffness, "density_found": log.density}
    row.flags, row.gauges = gauges_of(log.trust, log.body, found)
    row.reason = "" if row.outcome is Outcome.bounded else "left the range in which bodies can be"
    row.note = f"{len(restarts)} restarts" if restarts else ""
    return row
