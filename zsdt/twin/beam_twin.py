"""The twin of a beam: started from one picture, run ahead by its engine, corrected by what is seen.

    twin = BeamTwin(engine, psi_ini, graph.body, graph.front_nodes, graph.camera, AssimilationOptions())
    twin.begin(observation)
    for observation in later_frames:
        twin.predict()
        twin.correct(observation)          # leave it out: open loop
        stress = twin.fields(["stress"])["stress"]

The load on the beam is unknown to the twin; gravity is known. With motion capture instead of a camera give
`camera=None` and an `operator` that makes the markers' positions from those of the nodes.
"""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

from zsdt.errors import OptionError, RunRejected
from zsdt.fields import von_mises
from zsdt.perception.camera import Camera
from zsdt.perception.depth import DepthOptions
from zsdt.tignn.cell_energy import CellStart, card_of
from zsdt.tignn.cell_engine import STRETCH, CellEngine
from zsdt.tignn.cell_port import displace
from zsdt.tignn.engine import Engine, NodeField
from zsdt.trajectory import Body
from zsdt.twin.assimilation import MOST_SURPRISE, SURPRISE, AssimilationOptions, Method, ModeObserver, robust_fit
from zsdt.twin.first_frame import first_frame, nodal_force, seen_shapes
from zsdt.twin.modes import ModeWarp, mirror_partner
from zsdt.twin.observation import Measure, Observation, PointMeasure, RayMeasure, observe
from zsdt.twin.relaxation import fill_unseen, layer_spread, pull

log = logging.getLogger(__name__)

MOST_MOVE = 0.5  # of the pitch: largest correction of a node in one frame
PATIENCE = 40  # frames in a row far off, before the twin starts again
MIRROR = np.array([1.0, -1.0, 1.0])  # in the plane through the middle of the width
BENT = 0.02  # of the length: displacement after which the modes are turned anew


@dataclass(frozen=True)
class Innovation:
    """What an observation said. distance [points] m: between seen and predicted, NaN where not seen; taken [points]:
    which of them were believed; scatter: of what the correction cannot explain, over the noise told; load [3] N: sum
    of the estimated unknown load after the correction; work [J]: of the correction on the body; whitened [modes]: the
    normalised innovation, before any widening (`Fit.whitened`)."""

    distance: Float[np.ndarray, " points"]
    taken: Bool[np.ndarray, " points"]
    scatter: float = float("nan")
    load: Float[np.ndarray, "3"] | None = None
    work: float = 0.0
    whitened: Float[np.ndarray, " modes"] = field(default_factory=lambda: np.zeros(0))


class BeamTwin:
    """See the module. `state` is the engine's, `body` that with the calibrated material, after `begin`."""

    def __init__(
        self,
        engine: Engine,
        psi_ini: Any | None,
        body: Body,
        front_nodes: Int[np.ndarray, "columns rows"] | None,
        camera: Camera | None,
        options: AssimilationOptions | None = None,
        *,
        planar: bool = False,
        operator: sp.csr_matrix | None = None,
        extra_mass: Float[np.ndarray, " nodes"] | None = None,
        roll_doubt: float = 2e-3,
    ):
        """psi_ini: anything with ``infer_fields(body, positions)``, or None. front_nodes [columns, rows]: visible
        nodes; or operator [points, nodes]: positions of the observed points from those of the nodes. extra_mass
        [nodes] kg: hung on the body (cell engine). roll_doubt [rad]: of the camera's placement.

        Raises: OptionError where neither or something that does not fit together is given.
        """
        self.options, self.psi_ini, self.planar = options or AssimilationOptions(), psi_ini, planar
        own: Any = copy.copy(engine)  # preparing it for this body must not disturb its owner
        self.engine = own
        self.body, self.camera, self.front_nodes, self.extra_mass = body, camera, front_nodes, extra_mass
        self.operator = _operator(body, front_nodes, operator)
        self.is_cell = isinstance(engine, CellEngine)
        if self.options.method is Method.observer and not self.is_cell:
            raise OptionError(
                f"method=observer needs the sub-step form of the network, not '{engine.name}'; use method=relaxation."
            )
        if isinstance(self.engine, CellEngine):
            self.engine.options = replace(self.engine.options, start=CellStart.shift)
            if self.engine.constants.card is None:  # learned on this material: so that it can be calibrated
                self.engine.constants = replace(self.engine.constants, card=card_of(body))
        self.roll_doubt, self.work = roll_doubt, 0.0
        self.partner: Int[np.ndarray, " nodes"] | None = None  # of a graph of one layer: each node's mirror image
        self.stiffness = self.density = 1.0  # Young's modulus and density over the told ones

    # ---- begin ------------------------------------------------------------------------------------------------

    def begin(self, observation: Observation) -> None:
        """Starts at rest from the first observation; what no camera sees comes from Psi_ini and the engine's rest.

        Raises: OptionError where nothing is seen; RunRejected where the engine finds no rest.
        """
        if not observation.seen.any():
            raise OptionError("Nothing of the beam was seen in the first frame; begin with another one.")
        measure = self._measure_of(observation)
        self.work = 0.0
        if self.is_cell:
            self._begin_cell(observation, measure)
        else:
            self._begin_other(observation, measure)
        self.nothing, self.first_state = np.zeros_like(self.body.points), self.state
        self.restarts = self.lost_frames = 0
        self.load = self.nothing if not self._observing else nodal_force(self.engine, self.modes, self.observer.force)
        if self.options.method is Method.relaxation:
            if self.front_nodes is None:
                raise OptionError("method=relaxation needs front_nodes; use method=observer with an operator.")
            self.spread = layer_spread(self.body, self.front_nodes, self.options.layer_weight)

    @property
    def _observing(self) -> bool:
        return self.options.method is Method.observer

    def _measure_of(self, observation: Observation) -> Measure:
        if self.camera is None:
            return PointMeasure()
        depth = float(self.camera.depths(observation.positions[observation.seen]).mean())
        return RayMeasure(self.camera, depth, observation.has_depth)

    def _begin_cell(self, observation: Observation, measure: Measure) -> None:
        started = first_frame(
            self.engine, self.psi_ini, self.body, observation, measure, self.operator, self.planar, self.options,
            self.roll_doubt, self.extra_mass,
        )  # fmt: skip
        told, now = self.body.material, started.body.material
        if told is not None and now is not None:
            self.stiffness, self.density = now.young / told.young, now.density / told.density
        self.body, self.measure, self.modes, self.state = started.body, started.measure, started.modes, started.state
        self.bias, self.first_fit = started.bias, started.fit
        if isinstance(self.measure, RayMeasure):
            self.camera = self.measure.camera
        layers = np.rint(np.ptp(self.body.points[:, 1]) / self.body.pitch)
        self.partner = mirror_partner(self.body.points) if self.planar and layers == 1 else None
        self.warp = ModeWarp(self.body, self.modes, self.body.points + self.state.u[:-1])
        self.warped_at = self.state.u[:-1].copy()
        self.shapes = seen_shapes(self.operator, self.modes)
        tables = self.engine.tables
        stiffening = float((self.engine.moduli.relaxed + self.engine.moduli.viscous)[1:3].sum())
        stiffening /= float(self.engine.moduli.relaxed[1:3].sum())
        mass = float(self.body.mass.sum())
        weight = mass * float(np.linalg.norm(self.body.gravity)) or np.inf
        self.observer = ModeObserver(
            self.modes.frequency, stiffening, tables.tau, self.body.frame_dt, mass, weight, self.options
        )
        self.observer.force = started.force

    def _begin_other(self, observation: Observation, measure: Measure) -> None:
        """An engine that takes any first frame: the hidden layers are displaced like the visible one."""
        if self.front_nodes is None:
            raise OptionError(
                f"The engine '{self.engine.name}' needs front_nodes; choose the sub-step form for markers."
            )
        front = self.front_nodes.ravel()
        move = observation.positions - self.body.points[front]
        move[:, 1] = 0.0
        move = fill_unseen(move, observation.seen, self.front_nodes)
        spread = layer_spread(self.body, self.front_nodes, 1.0)
        position = self.body.points + spread @ move
        self.engine.prepare(self.body)
        fields = {"position": position, "velocity": np.zeros_like(position), "stress": np.zeros((len(position), 6))}
        if self.psi_ini is not None:
            fields.update(self.psi_ini.infer_fields(self.body, position))
        fields.update({name: np.zeros((len(position), 1)) for name in ("elastic_energy", "dissipated_energy")})
        self.state = self.engine.start(fields, np.zeros_like(position))
        self.measure, self.bias = measure, np.zeros_like(measure.values(observation.positions))

    # ---- every frame ------------------------------------------------------------------------------------------

    def _keep_planar(self) -> None:
        """One layer stands for a width that holds it: it must not fall over sideways, as a strip would."""
        for part in (self.state.u[:-1], self.state.velocity):
            part[:] = 0.5 * (part + part[self.partner] * MIRROR)

    def predict(self) -> None:
        """One frame ahead under gravity and the load that is estimated at present."""
        try:
            self.state = self.engine.step(self.state, self.load, self.load)
        except RunRejected as reason:
            self._restart(str(reason))
        if self.partner is not None:
            self._keep_planar()
        if not self.is_cell:  # the sub-step form watches itself
            self._guard()
        if self._observing:
            self._bend_modes()
            self.observer.forecast()
            self.load = nodal_force(self.engine, self.modes, self.observer.force)

    def _guard(self) -> None:
        """Restarts where an engine that does not watch itself left the range of its material."""
        position = self.position
        edges = self.body.pairs
        stretch = np.linalg.norm(position[edges[:, 1]] - position[edges[:, 0]], axis=1) / self.body.pitch
        if np.isfinite(position).all() and STRETCH[0] < stretch.min() and stretch.max() < STRETCH[1]:
            return
        self._restart("The twin left the range of its material.")

    def _watch(self, distance: Float[np.ndarray, " points"]) -> None:
        """Goes back to the first frame where most points are seen, and stay far from where they are predicted."""
        seen = np.isfinite(distance)
        lost = seen.mean() > 0.5 and float(np.median(distance[seen])) > self.body.pitch
        self.lost_frames = self.lost_frames + 1 if lost else 0
        if self.lost_frames >= PATIENCE:
            self._restart("The twin has lost the beam.")

    def _restart(self, reason: str) -> None:
        """Goes back to the first frame: better far off than gone."""
        log.warning("The twin starts again from rest: %s", reason)
        self.restarts, self.lost_frames = self.restarts + 1, 0
        self.state = self.first_state
        if self._observing:
            self.work = 0.0
            self.observer.restart()
            self.load = nodal_force(self.engine, self.modes, self.observer.force)

    def _bend_modes(self) -> None:
        """Turns the modes along with the body when it has bent far since they were turned last."""
        u = self.state.u[:-1]
        if np.abs(u - self.warped_at).max() > BENT * np.ptp(self.body.points[:, 0]):
            self.modes = replace(self.modes, shapes=self.warp.shapes(u))
            self.shapes = seen_shapes(self.operator, self.modes)
            self.warped_at = u.copy()

    def observe(
        self,
        pixels: Float[np.ndarray, "points 2"],
        seen: Bool[np.ndarray, " points"],
        frame: int,
        time: float,
        depth_map: Float[np.ndarray, "height width"] | None = None,
        depth_options: DepthOptions | None = None,
    ) -> Observation:
        """The observation of tracked pixels by the twin's camera, whose placement `begin` has refined."""
        if self.camera is None or not isinstance(self.measure, RayMeasure):
            raise OptionError("A twin without a camera takes no pixels; give it observations of positions.")
        return observe(self.camera, self.measure.depth, pixels, seen, frame, time, depth_map, depth_options)

    def correct(self, observation: Observation) -> Innovation:
        """Takes what was seen at the time of the last prediction; with gain 0 it only says how far off it is.

        Positions are in the axes of the body as `camera` has them after `begin` (see `observe`).

        Points that are not seen, are no numbers, are further away than the beam is long, or do not fit to the motion
        of the others are not taken.
        """
        gap, points, distance, possible = self._compared(observation)
        if not possible.any():
            return Innovation(distance, possible, load=self.load.sum(axis=0))
        if self.options.gain > 0.0:
            self._watch(distance)
        if self._observing:
            return self._observe(gap, points, possible, distance, observation.blur)
        return self._relax(gap, points, possible, distance)

    def compare(self, observation: Observation) -> Innovation:
        """How far off the prediction is, without a correction."""
        _, _, distance, possible = self._compared(observation)
        return Innovation(distance, possible, load=self.load.sum(axis=0))

    def _compared(
        self, observation: Observation
    ) -> tuple[
        Float[np.ndarray, "points numbers"],
        Float[np.ndarray, "points 3"],
        Float[np.ndarray, " points"],
        Bool[np.ndarray, " points"],
    ]:
        """What is measured less what would be (without the biases of the points), predicted points, size of the gap,
        and which points can be at all."""
        points = self.operator @ self.position
        gap = self.measure.values(observation.positions) - self.bias - self.measure.values(points)
        distance = np.linalg.norm(gap, axis=1)
        with np.errstate(invalid="ignore"):
            possible = observation.seen & (distance < np.ptp(self.body.points, axis=0).max())
        return gap, points, np.where(observation.seen, distance, np.nan), possible

    def _observe(self, gap, points, possible, distance, blur: float) -> Innovation:
        """The correction of the observer: smooth in space, with velocity and load."""
        options = self.options
        scatter = blur * self.measure.scatter(options.noise, options.depth_noise)
        rows = np.einsum("pki,pim->pkm", self.measure.slopes(points), self.shapes)
        rows, gap = self._with_shake(rows) / scatter[:, None], gap / scatter
        fit = robust_fit(rows, gap, possible, self._prior(), options.gate)
        whitened = fit.whitened
        if fit.surprise > SURPRISE and options.gain > 0.0:
            self.observer.widen(min(fit.surprise, MOST_SURPRISE))
            fit = robust_fit(rows, gap, possible, self._prior(), options.gate)
        if options.gain == 0.0 or not fit.taken.any():
            return Innovation(distance, fit.taken, fit.scatter, self.load.sum(axis=0), whitened=whitened)
        # Far off after a gap: in steps that the material bears.
        furthest = float(np.abs(self.modes.shapes @ fit.amplitude[: len(self.observer.force)]).max())
        share = min(1.0, MOST_MOVE * self.body.pitch / max(furthest, 1e-12))
        move, push = self.observer.update(fit, share * options.gain)
        self.state, work = displace(self.engine, self.state, self.modes.shapes @ move, self.modes.shapes @ push)
        self.work += work
        self.load = nodal_force(self.engine, self.modes, self.observer.force)
        return Innovation(distance, fit.taken, fit.scatter, self.load.sum(axis=0), work, whitened)

    @property
    def _shaking(self) -> bool:
        return isinstance(self.measure, RayMeasure) and self.options.shake > 0.0

    def _with_shake(self, rows: Float[np.ndarray, "points numbers modes"]) -> Float[np.ndarray, "points numbers more"]:
        """Two more unknowns, which move no node: the whole picture wanders along its two axes."""
        if not self._shaking:
            return rows
        whole = np.zeros((rows.shape[0], rows.shape[1], 2))
        whole[:, 0, 0] = whole[:, 1, 1] = 1.0
        return np.concatenate([rows, whole], axis=2)

    def _prior(self) -> Float[np.ndarray, " more"]:
        """Variances of the amplitudes, and of the wandering."""
        return np.append(self.observer.prior, [self.options.shake**2] * 2) if self._shaking else self.observer.prior

    def _relax(self, gap, points, possible, distance) -> Innovation:
        """The correction of the seed: each seen node by itself."""
        options = self.options
        usual = max(3 * options.noise, 1.5 * float(np.median(distance[possible])))
        trusted = possible & (distance <= options.gate * usual)
        if options.gain == 0.0:
            return Innovation(distance, trusted)
        wanted = pull(self.measure.slopes(points), np.where(trusted[:, None], gap, 0.0))
        move = options.gain * (self.spread @ wanted)
        push = options.velocity_gain / self.body.frame_dt * move
        work = float("nan")
        if self.is_cell:
            self.state, work = displace(self.engine, self.state, move, push)
            self.work += work
        else:
            fields = dict(self.engine.read(self.state))
            fields["position"], fields["velocity"] = fields["position"] + move, fields["velocity"] + push
            self.state = self.engine.start(fields, self.nothing)
        return Innovation(distance, trusted, work=work)

    # ---- what it knows ----------------------------------------------------------------------------------------

    @property
    def position(self) -> Float[np.ndarray, "nodes 3"]:
        """Positions of all nodes [m]."""
        if self.is_cell:
            return self.body.points + self.state.u[:-1] + self.state.offset
        return self.engine.read(self.state)["position"]

    @property
    def velocity(self) -> Float[np.ndarray, "nodes 3"]:
        """Velocities of all nodes [m/s]."""
        return self.state.velocity if self.is_cell else self.engine.read(self.state)["velocity"]

    def doubt(self) -> float:
        """Standard deviation [m] of the body's place that the observer expects (root mean square over the mass); NaN
        without an observer."""
        if not self._observing:
            return float("nan")
        return math.sqrt(float(self.observer.prior.sum()) / float(self.body.mass.sum()))

    def predicted_pixels(self) -> Float[np.ndarray, "points 2"]:
        """Where the observed points should be in the picture, their first-frame biases included."""
        if self.camera is None or not isinstance(self.measure, RayMeasure):
            raise OptionError("A twin without a camera predicts no pixels.")
        points = self.operator @ self.position
        flat = self.measure.values(points) + self.bias
        depths = self.camera.depths(points)[:, None]
        rays = np.concatenate([flat[:, :2] / self.measure.depth, np.ones((len(points), 1))], axis=1) * depths
        return self.camera.project((rays - self.camera.translation) @ self.camera.rotation)

    def fields(self, names: Iterable[str]) -> dict[str, NodeField]:
        """The named fields at the nodes now, and only those are computed; von_mises [nodes, 1] Pa is known too.

        Raises: OptionError where the engine knows no such field.
        """
        wanted = list(names)
        base = {"stress" if name == "von_mises" else name for name in wanted}
        found = self.engine.read(self.state, base) if self.is_cell else self.engine.read(self.state)
        if "von_mises" in wanted:
            found["von_mises"] = von_mises(found["stress"])[:, None]
        missing = [name for name in wanted if name not in found]
        if missing:
            raise OptionError(f"The engine '{self.engine.name}' has no field '{missing[0]}'; take it off the scene.")
        return {name: found[name] for name in wanted}

    def account(self) -> dict[str, float]:
        """Energies and works [J] of the engine; work_load is that of the estimated load, work_assimilation that of the
        corrections, and both are in work_of_ports, so that the account closes."""
        account = dict(self.engine.account(self.state))
        if self.is_cell:
            account["work_assimilation"] = self.work
            account["work_of_ports"] += self.work
        return account


def _operator(
    body: Body, front_nodes: Int[np.ndarray, "columns rows"] | None, operator: sp.csr_matrix | None
) -> sp.csr_matrix:
    """Positions of the observed points from those of the nodes, [points, nodes]."""
    if operator is not None:
        if operator.shape[1] != body.nodes:
            raise OptionError(f"The operator has {operator.shape[1]} columns, the body {body.nodes} nodes.")
        return sp.csr_matrix(operator)
    if front_nodes is None:
        raise OptionError("A twin needs front_nodes or an operator that says which points are observed.")
    front = front_nodes.ravel()
    return sp.csr_matrix((np.ones(len(front)), (np.arange(len(front)), front)), (len(front), body.nodes))
