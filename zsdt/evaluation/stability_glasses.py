"""Runs a hard case of a liquid: by the solver, by a network alone, and by the twin before a film without pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from zsdt.errors import DataError
from zsdt.evaluation.stability import left_range
from zsdt.evaluation.stability_film import Film, surface_of
from zsdt.evaluation.stability_glass_cases import Beginning, GlassCase
from zsdt.evaluation.stability_glass_truth import GlassTruth, glass_truth
from zsdt.evaluation.stability_row import Outcome, Party, Row, books
from zsdt.evaluation.stability_trust import gauges_of, watched
from zsdt.fluid.coarsening import coarsen, interpolate
from zsdt.fluid.vessel import Vessel
from zsdt.shipped import TwinWeights
from zsdt.tignn.engine import Engine, Rollout, load_engine, roll_out
from zsdt.tignn.particle_engine import ParticleEngine
from zsdt.tignn.psi_ini_liquid import load as load_psi_ini
from zsdt.trajectory import Trajectory
from zsdt.twin.glass_log import GlassStatus, GlassTwinLog
from zsdt.twin.glass_loop import GlassTwinOptions, run_glass_twin
from zsdt.twin.glass_scene import GlassTwinScene

PARTICLES = 400  # of the twin
STILL = 4  # frames after which the twin takes a glass that was never moved for one at rest
SMOOTHING = 1.5  # smoothing length over spacing, of a coarser liquid


def run_glass(case: GlassCase, party: Party, truth: GlassTruth, weights: TwinWeights, soft: str | None = None) -> Row:
    """One party in a case of which the truth is known; see `zsdt.evaluation.stability_beams.run_beam`.

    Raises: RunRejected, DataError where it gives up before its first frame.
    """
    if party is Party.solver:
        return _solver_row(case, glass_truth(case, case.coarse) if case.coarse else truth)
    if party is Party.twin:
        return _twin_row(case, truth, run_film(case, truth, weights))
    folder = str(weights.tignn) if party is Party.network or soft is None else soft
    return _network_row(case, party, truth, load_engine(folder))


def _solver_row(case: GlassCase, truth: GlassTruth) -> Row:
    growth, least = books(truth.trajectory.ledger)
    outcome = Outcome.rejected if truth.reason else Outcome.bounded
    note = f"{truth.spilled} of {truth.trajectory.body.nodes} particles spilled" if truth.spilled else ""
    row = Row(case.name, case.kind, Party.solver, outcome, truth.reason, case.frames, [], growth, least, note=note)
    row.note = " ".join(w for w in (note, _restless(case, truth.trajectory.fields)) if w)
    return row


def _restless(case: GlassCase, fields: dict[str, np.ndarray]) -> str:
    """How fast what should be at rest still moves at the end."""
    if case.beginning is not Beginning.still:
        return ""
    speed = np.sqrt(np.square(fields["velocity"]).sum(axis=2).mean(axis=1))
    known = speed[np.isfinite(speed)]
    return f"moves at {1e3 * known[-1]:.2g} mm/s in the last frame, {1e3 * known.max():.2g} at most"


def _network_row(case: GlassCase, party: Party, truth: GlassTruth, engine: Engine) -> Row:
    told = coarser(truth.trajectory, case.coarse) if case.coarse else truth.trajectory
    rollout = roll_out(engine, told)
    growth, least = books(rollout.account)
    row = Row(case.name, case.kind, party, Outcome.rejected, rollout.reason, case.frames, [], growth, least)
    row.flags, row.gauges = gauges_of(watched(told, rollout), told.body)
    row.error = error_of(case, truth, rollout.fields["position"])
    row.note = _restless(case, rollout.fields)
    if not rollout.reason:
        row.outcome, row.reason = _judged(told, rollout)
    return row


def coarser(trajectory: Trajectory, count: int) -> Trajectory:
    """The same liquid in fewer particles, of which the first frame alone is known."""
    body = trajectory.body
    assert body.vessel is not None
    spacing = (float(body.mass.sum()) / body.liquid.density / count) ** (1.0 / 3.0)  # type: ignore[union-attr]
    first = trajectory.at(0)
    centres = coarsen(first["position"], count, Vessel(body.vessel), spacing, SMOOTHING * spacing)
    values = np.concatenate([first["velocity"], first["internal_energy"]], axis=1)
    sampled, _ = interpolate(centres, first["position"], values, body.pitch)
    fields = {"position": centres, "velocity": sampled[:, :3], "internal_energy": sampled[:, 3:]}
    few = replace(
        body,
        points=centres,
        clamped=np.zeros(count, bool),
        mass=np.full(count, float(body.mass.sum()) / count),
        pitch=spacing,
    )
    frames = trajectory.frames
    return Trajectory(
        few,
        trajectory.times,
        {k: np.broadcast_to(v, (frames, *v.shape)) for k, v in fields.items()},
        np.zeros((frames, count, 3)),
    )


def _judged(trajectory: Trajectory, rollout: Rollout) -> tuple[Outcome, str]:
    if rollout.diverged_at is not None:
        return Outcome.failed, f"not finite at frame {rollout.diverged_at}"
    left = left_range(trajectory, rollout)
    return (Outcome.bounded, "") if left is None else (Outcome.failed, f"left its vessel at frame {left}")


def error_of(
    case: GlassCase, truth: GlassTruth, position: Float[np.ndarray, "frames nodes 3"], skip: int = 0
) -> list[float]:
    """Distance of the centroids of the liquid (what was spilled in truth left out where the particles are the same)
    over the depth at rest, frame by frame; `skip` frames of the truth come before the first."""
    count = min(len(position), truth.known - skip)
    true = truth.trajectory.fields["position"]
    same = position.shape[1] == true.shape[1]
    off = []
    for k in range(count):
        kept = truth.inside[k + skip]
        theirs = true[k + skip][kept].mean(axis=0)
        ours = (position[k][kept] if same else position[k]).mean(axis=0)
        off.append(float(np.linalg.norm(ours - theirs)) / case.fill)
    return [float("nan")] * skip + off


def run_film(case: GlassCase, truth: GlassTruth, weights: TwinWeights) -> GlassTwinLog:
    """The closed loop on the frames that the truth knows."""
    body, shape = truth.trajectory.body, case.shape
    positions = [f.position[f.inside] for f in truth.before]
    positions += [x[truth.inside[k]] for k, x in enumerate(truth.trajectory.fields["position"][: truth.known])]
    share = case.volume / body.nodes
    surfaces = _surfaces(case, body.pitch, share, positions)
    film = Film(shape, truth.way[: len(surfaces)], surfaces, case.fps)
    engine = load_engine(weights.tignn)
    if not isinstance(engine, ParticleEngine):
        raise DataError(f"The engine '{engine.name}' cannot be corrected by what a camera sees.")
    scene = GlassTwinScene(
        liquid=case.liquid,
        section=None if shape.is_round else [shape.aspect, shape.exponent],
        fps=case.fps,
        particles=PARTICLES,
        fields=["velocity"],
    )
    still = 0 if case.beginning is Beginning.moved else STILL
    return run_glass_twin(
        film,
        film,
        scene,
        GlassTwinOptions(keep_fields=False, still_start=still, beside=False),
        camera=film.camera,
        engine=engine,
        psi_ini=None if weights.psi_ini is None or still else load_psi_ini(weights.psi_ini),
    )


def _surfaces(
    case: GlassCase, spacing: float, share: float, positions: list[np.ndarray]
) -> Float[np.ndarray, "frames terms"]:
    """Surfaces of all frames; of states that are the same (a liquid before the stop) once."""
    found: list[np.ndarray] = []
    for k, x in enumerate(positions):
        if k and x.shape == positions[k - 1].shape and np.abs(x - positions[k - 1]).max() < 1e-5:
            positions[k] = positions[k - 1]
            found.append(found[-1])
        else:
            found.append(surface_of(case.shape, spacing, share * len(x), x))
    return np.stack(found)


def _twin_row(case: GlassCase, truth: GlassTruth, log: GlassTwinLog) -> Row:
    moving = log.status[log.start :]
    restarts = [k for k, status in enumerate(moving) if status == GlassStatus.restarted.value]
    growth, least = books(log.account, restarts)
    t0 = len(truth.way) - case.frames
    skip = log.start - t0
    position = log.positions[max(-skip, 0) :]
    row = Row(
        case.name, case.kind, Party.twin, Outcome.bounded, "", case.frames, energy_growth=growth, entropy_min=least
    )
    row.error = error_of(case, truth, position, max(skip, 0))
    flags, gauges = gauges_of(log.trust, log.body)
    row.flags = None if flags is None else [""] * max(skip, 0) + flags[max(-skip, 0) :]
    row.gauges = {k: v if len(v) == 1 else [np.nan] * max(skip, 0) + v[max(-skip, 0) :] for k, v in gauges.items()}
    rollout = Rollout("", {"position": log.positions.astype(float)}, np.zeros(0))
    body = Trajectory(log.body, log.times[log.start :], {}, np.zeros((0, 0, 3)))
    left = left_range(body, rollout)
    if left is not None:
        row.outcome, row.reason = Outcome.failed, f"left its vessel at frame {left}"
    said = [f"{len(restarts)} restarts"] if restarts else []
    said += [f"began {skip} frames after t0"] if skip else []
    row.note = ", ".join(said)
    return row
