"""The twin of a liquid in a glass: begun when the glass stands still, run ahead, corrected by its seen surface.

    twin = GlassTwin(engine, psi_ini, body, LiquidAssimilationOptions())
    twin.begin()
    for profile in later_frames:
        twin.predict()
        twin.correct(profile)              # leave it out: open loop
        velocity = twin.fields(["velocity"])["velocity"]

Everything is in the axes of the vessel. What the vessel does after the first frame comes as `predict(acceleration)`.
"""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from zsdt.errors import OptionError, RunRejected
from zsdt.fluid.slosh_modes import SloshModes, slosh_modes
from zsdt.fluid.vessel import Vessel
from zsdt.tignn.engine import Engine, NodeField
from zsdt.trajectory import Body
from zsdt.twin.assimilation import Fit, robust_fit
from zsdt.twin.glass_levels import FINE_DEGREE, reader_of
from zsdt.twin.liquid_assimilation import (
    BIASES,
    FlowModes,
    LiquidAssimilationOptions,
    LiquidMethod,
    SloshObserver,
    biases_of,
    flow_modes,
)
from zsdt.twin.liquid_columns import stretch_columns
from zsdt.twin.liquid_ports import ports_of
from zsdt.twin.seen_surface import Profile, SurfaceInnovation, leans_over

log = logging.getLogger(__name__)

DEPTHS = np.linspace(1.0, -0.95, 14)  # of the half-depth of the vessel, at which lines of sight look for liquid
KNOWN = 0.5  # share of the first doubts that is left where the frames that mended the beginning are taken again
FEWEST = 4  # seen places, below which a surface says nothing
IMPOSSIBLE = 30.0  # of what was expected (squared), from which a whole surface is not believed at first
MOST_SURPRISE = 100.0  # by how much variances are widened at most
MOST_PUSH = 0.4  # of the liquid's motion: largest change of its velocity in one correction (root mean squares)
LEAST_PUSH = 0.005  # m/s: that is always allowed
MOST_MOVE = 0.5  # of the particle spacing: largest correction of a particle in one frame
THICKNESS = (0.5, 2.0)  # of the told viscosity: what is thought possible


@dataclass(frozen=True)
class _Flow:
    """gradient [n, 3, potentials] at the particles; modes; rate [modes] of the twin; unevenness [m]: root mean square
    of the surface about its rest level."""

    gradient: Float[np.ndarray, "n 3 potentials"]
    modes: FlowModes
    rate: Float[np.ndarray, " modes"]
    unevenness: float


class GlassTwin:
    """See the module. `state` is the engine's, after `begin`."""

    def __init__(
        self, engine: Engine, psi_ini: Any | None, body: Body, options: LiquidAssimilationOptions | None = None
    ):
        """psi_ini: anything with ``infer_fields(body, positions)``, None for a liquid at rest.

        Raises: OptionError where the body is no liquid in a vessel.
        """
        self.options = options or LiquidAssimilationOptions()
        self.engine, self.psi_ini, self.body = copy.copy(engine), psi_ini, body  # its owner's engine stays as it is
        self.ports = ports_of(self.engine)
        if body.liquid is None or body.vessel is None:
            raise OptionError("The twin of a glass needs a liquid in a vessel.")
        self.told = body.liquid.viscosity
        self.volume = float(body.mass.sum()) / body.liquid.density
        self.still = Vessel(body.vessel).level(self.volume)
        self.gravity = float(np.linalg.norm(body.gravity))
        self.nothing = np.zeros_like(body.points)
        self.doubt = math.nan  # m: see `SloshObserver.doubt`, at the last prediction
        self._now: _Flow | None = None
        self._surface: Float[np.ndarray, " terms"] | None = None
        self._shown: tuple[Profile, tuple[Float[np.ndarray, " c"], Float[np.ndarray, "c 2"]]] | None = None

    # ---- begin ------------------------------------------------------------------------------------------------

    def prepare(self) -> None:
        """All that depends on vessel and number of particles alone: walls, modes, surface."""
        assert self.body.vessel is not None
        self.engine.prepare(self.body)
        self.modes: SloshModes = slosh_modes(self.body.vessel, self.still, self.options.modes)
        self.reader = reader_of(self.body.vessel, self.body.pitch)
        self.fine_reader = reader_of(self.body.vessel, self.body.pitch, FINE_DEGREE)

    def begin(self, known: dict[str, NodeField] | None = None) -> None:
        """Starts at the body's points; velocity and internal energy come from Psi_ini, or are `known`.

        Raises: RunRejected where the particles cannot be balanced.
        """
        if not hasattr(self, "modes"):
            self.prepare()
        fields: dict[str, NodeField] = {"position": self.body.points, "velocity": self.nothing}
        if known is not None:
            fields.update(known)
        elif self.psi_ini is not None:
            fields.update(self.psi_ini.infer_fields(self.body, self.body.points))
        self.state = self.engine.start(fields, self.nothing)
        assert self.body.liquid is not None
        nu = self.told / self.body.liquid.density
        self.observer = SloshObserver(self.modes.count, nu, self.gravity, self.body.frame_dt, self.options)
        self._forget()
        self.observer.begin(self._flow().modes, self._flow().rate, carried=known is not None)
        self.viscosity, self.biases, self.work = 1.0, np.zeros(BIASES), 0.0
        self.refused = self.restarts = 0

    def look_back(self, profiles: Sequence[Profile | None]) -> None:
        """Mends the beginning by what the frames from the first on showed (None: nothing), before they are run through.

        t0 is only known a few frames later. How the surface went on since then tells its velocity at t0, which no
        single picture does. Errors swing as the observer says; its covariance stays as if nothing had been seen but
        for what is now better known.
        """
        if self.options.method is not LiquidMethod.modes or self.options.gain == 0.0 or len(profiles) < 3:
            return
        first, covariance = self.state, self.observer.covariance
        onward = np.eye(len(covariance))
        rows, gaps, noises = [], [], []
        for k, profile in enumerate(profiles):
            if k > 0:
                self.predict()
                onward = self.swings @ onward
            if profile is None:
                continue
            gap, seen = self._compared(profile)
            if seen.sum() < FEWEST:
                continue
            rise, biases, noise, fit = self._fitted(profile, gap, seen)
            chosen = fit.taken
            rows.append((self.observer.rows(rise, biases) @ onward)[chosen])
            gaps.append(gap[chosen])
            noises.append(noise[chosen] * fit.scatter * math.sqrt(max(1.0, chosen.sum() / self.options.independent)))
        self.state, self.observer.covariance = first, covariance
        self._forget()
        if not rows:
            return
        found = self.observer.look_back(np.concatenate(rows), np.concatenate(gaps), np.concatenate(noises))
        self._move(found.move, found.push)
        self.work = 0.0
        self.state = self.engine.start(self.fields(["position", "velocity", "internal_energy"]), self.nothing)
        self._forget()
        self.observer.covariance = covariance * KNOWN + self.observer.covariance * (1.0 - KNOWN)

    # ---- every frame ------------------------------------------------------------------------------------------

    def predict(self, acceleration: Float[np.ndarray, "3"] | None = None) -> None:
        """One frame ahead. acceleration [m/s2]: of the vessel in the room, where it is moved again.

        Raises: RunRejected where the liquid of an engine flew apart that would do it again.
        """
        load = self.nothing
        if acceleration is not None and np.any(acceleration):
            load = -self.body.mass[:, None] * np.asarray(acceleration)
        try:
            self.state = self.engine.step(self.state, load, load)
        except RunRejected as reason:
            if not self.ports.begins_again:
                raise
            self._restart(str(reason))
        self._forget()
        if self.options.method is LiquidMethod.modes:
            flow, observer = self._flow(), self.observer
            shaken = 0.0 if acceleration is None else float(np.linalg.norm(acceleration)) * self.body.frame_dt
            self.swings, added = observer.swing(flow.modes, flow.rate, flow.unevenness, shaken)
            observer.covariance = self.swings @ observer.covariance @ self.swings.T + added
            self.biases[2:] *= observer.keep
            self.doubt = observer.doubt(flow.modes)

    def rest(self) -> None:
        """The liquid stands still: what it still moved turns into heat."""
        self.state = self.ports.come_to_rest(self.state)
        self._forget()

    def _restart(self, reason: str) -> None:
        """Goes back to the first frame, but at rest: better far off than gone."""
        log.warning("The twin of the glass starts again from rest: %s", reason)
        self.restarts += 1
        self._set_viscosity(1.0)
        fields = {"position": self.body.points, "velocity": self.nothing}
        self.state, self.work = self.engine.start(fields, self.nothing), 0.0
        self._forget()
        self.observer.begin(self._flow().modes, self._flow().rate)
        self.observer.widen(MOST_SURPRISE)

    def correct(self, profile: Profile) -> SurfaceInnovation:
        """Takes the surface seen at the time of the last prediction; with gain 0 it only says how far off it is."""
        gap, seen = self._compared(profile)
        distance = np.where(seen, gap, np.nan)
        nothing = SurfaceInnovation(distance, np.zeros(len(seen), bool), viscosity=self.viscosity)
        if seen.sum() < FEWEST:
            return nothing
        if self.options.method is LiquidMethod.columns:
            return self._stretch(profile, gap, seen)
        return self._observe(profile, gap, seen)

    def compare(self, profile: Profile) -> SurfaceInnovation:
        """How far off the prediction is, without a correction."""
        gap, seen = self._compared(profile)
        return SurfaceInnovation(np.where(seen, gap, np.nan), np.zeros(len(seen), bool), viscosity=self.viscosity)

    def _compared(self, profile: Profile) -> tuple[Float[np.ndarray, " c"], Bool[np.ndarray, " c"]]:
        """Seen less predicted heights [m], and which places are seen at possible heights."""
        height = np.asarray(profile.height, float)
        predicted = self.shown(profile)[0]
        assert self.body.vessel is not None
        with np.errstate(invalid="ignore"):
            seen = np.asarray(profile.seen, bool) & (height > 0.0) & (height < self.body.vessel.rim)
            seen &= ~leans_over(self.body.vessel, np.fmax(height, predicted))
        return np.where(seen, height - predicted, 0.0), seen

    def shown(self, profile: Profile) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, "c 2"]]:
        """Heights [m] at which the surface would be seen at the places of a profile, and where the lines of sight touch
        it (x, y) [m]. A correction asks for it four times: it is found once for a profile and a surface."""
        if self._shown is None or self._shown[0] is not profile:
            self._shown = profile, self._touched(profile)
        return self._shown[1]

    def _touched(self, profile: Profile) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, "c 2"]]:
        """See `shown`."""
        places = np.asarray(profile.places, float)
        climb = getattr(profile, "climb", None)
        self._coefficients()
        if climb is None:
            return self.surface(places), places
        across = np.stack([places * [1.0, share] for share in DEPTHS], axis=1)
        height = self.fine_reader.at(self._fine, across.reshape(-1, 2)).reshape(len(places), -1)
        height -= (across[:, :, 1] - places[:, 1, None]) * np.asarray(climb, float)[:, None]
        best = height.argmax(axis=1)
        rows = np.arange(len(places))
        return height[rows, best], across[rows, best]

    def _observe(
        self, profile: Profile, gap: Float[np.ndarray, " c"], seen: Bool[np.ndarray, " c"]
    ) -> SurfaceInnovation:
        """The correction of the observer."""
        o, observer = self.options, self.observer
        distance = np.where(seen, gap, np.nan)
        gap = gap - np.where(seen, self._biases(profile) @ self.biases, 0.0)
        rise, biases, noise, fit = self._fitted(profile, gap, seen)
        few = bool(fit.taken.sum() < FEWEST)
        if o.gain == 0.0 or few:
            return SurfaceInnovation(
                distance, fit.taken, few, fit.scatter, self.viscosity, self.level_offset, whitened=fit.whitened
            )
        if fit.surprise > IMPOSSIBLE and self.refused < o.patience:
            self.refused += 1
            return SurfaceInnovation(
                distance, np.zeros(len(seen), bool), True, fit.scatter, self.viscosity, self.level_offset,
                whitened=fit.whitened,
            )  # fmt: skip
        if fit.surprise > IMPOSSIBLE:
            observer.widen(min(fit.surprise, MOST_SURPRISE))
        self.refused = 0
        found = observer.update(rise, biases, gap, fit.taken, fit.scatter * noise, o.gain)
        work = self._move(found.move, found.push)
        if o.viscosity_doubt > 0.0:
            self._set_viscosity(self.viscosity * math.exp(found.viscosity))
        self.biases = self.biases + found.biases
        return SurfaceInnovation(
            distance, fit.taken, False, fit.scatter, self.viscosity, self.level_offset, work, fit.whitened
        )

    def _fitted(
        self, profile: Profile, gap: Float[np.ndarray, " c"], seen: Bool[np.ndarray, " c"]
    ) -> tuple[Float[np.ndarray, "c potentials"], Float[np.ndarray, "c biases"], Float[np.ndarray, " c"], Fit]:
        """How what is shown rises with the potentials and the biases, the noise [m] of the gaps, and which of them to
        believe."""
        o, biases = self.options, self._biases(profile)
        rise = self._rise(self.shown(profile)[1])
        rows, prior = self.observer.seen(rise, biases, self._flow().modes)
        noise = np.hypot(max(o.noise, o.sight or 0.0), o.steep_noise * biases[:, 1])
        return (
            rise,
            biases,
            noise,
            robust_fit((rows / noise[:, None])[:, None, :], (gap / noise)[:, None], seen, prior, o.gate),
        )

    def _biases(self, profile: Profile) -> Float[np.ndarray, "c biases"]:
        """By how much heights of a profile are off per bias of the observer."""
        assert self.body.vessel is not None
        across = np.asarray(profile.places, float)[:, 0] / float(np.max(self.body.vessel.radii))
        return biases_of(across, self.shown(profile)[0] - self.still)

    @property
    def level_offset(self) -> float:
        """By how much seen heights are thought to be off as a whole [m]."""
        return float(self.biases[0])

    def _rise(self, places: Float[np.ndarray, "c 2"]) -> Float[np.ndarray, "c potentials"]:
        """By how much the surface over each place rises per displacement potential, where and as steep as it is now."""
        self._coefficients()
        slope = self.fine_reader.slopes(places) @ self._fine
        points = np.column_stack([places, self.fine_reader.at(self._fine, places)])
        gradient = self.modes.at(points)[1]
        return gradient[:, 2] - np.einsum("ci,cik->ck", slope, gradient[:, :2])

    def _flow(self) -> _Flow:
        """Modes of the liquid in its present shape, and how it moves in them."""
        if self._now is None:
            gradient = self.modes.at(self.state.position)[1]
            share = self.volume / len(gradient)
            flat = gradient.reshape(-1, self.modes.count)
            columns, area = self.reader.columns, self.reader.area
            height = self.surface(columns)
            assert self.body.vessel is not None
            wet = Vessel(self.body.vessel).distance(np.column_stack([columns, np.maximum(height, 1e-3)])) > 0.0
            rise = self._rise(columns[wet])
            modes = flow_modes(share * flat.T @ flat, rise, area[wet], self.gravity)
            rate = modes.mix.T @ (share * flat.T @ self.state.velocity.ravel())
            spread = math.sqrt(float(np.average((height[wet] - self.still) ** 2, weights=area[wet])))
            self._now = _Flow(gradient, modes, rate, spread)
        return self._now

    def _forget(self) -> None:
        """The particles have moved."""
        self._surface, self._now, self._shown = None, None, None

    def _move(self, move: Float[np.ndarray, " potentials"], push: Float[np.ndarray, " potentials"]) -> float:
        """Moves and pushes the particles along gradients of potentials; the work [J]."""
        x = self.state.position
        gradient = self._flow().gradient
        step, kick = gradient @ move, gradient @ push
        furthest = float(np.abs(step).max()) / (MOST_MOVE * self.body.pitch)
        allowed = MOST_PUSH * math.sqrt(float((self.state.velocity**2).mean())) + LEAST_PUSH
        share = 1.0 / max(1.0, furthest, math.sqrt(float((kick**2).mean())) / allowed)
        # Half-way there the flow points elsewhere: so the volume is kept to the third order of the move.
        step = self.modes.at(x + 0.5 * share * step)[1] @ (share * move)
        self.state, work = self.ports.displace(self.state, step, share * kick)
        self.work += work
        self._forget()
        return work

    def _set_viscosity(self, factor: float) -> None:
        """The engine's liquid becomes `factor` times as viscous as told."""
        factor = float(np.clip(factor, *THICKNESS))
        self.ports.thicken(factor * self.told)
        self.viscosity = factor

    def _stretch(
        self, profile: Profile, gap: Float[np.ndarray, " c"], seen: Bool[np.ndarray, " c"]
    ) -> SurfaceInnovation:
        """The correction of the seed: every column by itself."""
        distance = np.where(seen, gap, np.nan)
        if self.options.gain == 0.0:
            return SurfaceInnovation(distance, seen)
        assert self.body.vessel is not None
        found = stretch_columns(
            self.body.vessel, self.state.position, np.asarray(profile.places, float), gap, seen, self.surface,
            self.options,
        )  # fmt: skip
        push = self.options.velocity_gain / self.body.frame_dt * found.move
        self.state, work = self.ports.displace(self.state, found.move, push)
        self.work += work
        self._forget()
        return SurfaceInnovation(distance, found.taken, work=work)

    # ---- what it knows ----------------------------------------------------------------------------------------

    @property
    def position(self) -> Float[np.ndarray, "n 3"]:
        """Positions of all particles [m]."""
        return self.state.position

    def pressure(self) -> Float[np.ndarray, "n 1"] | None:
        """Pressure of the particles [Pa]; None where the engine knows none."""
        return self.ports.pressure(self.state)

    def _coefficients(self) -> Float[np.ndarray, " terms"]:
        if self._surface is None:
            columns = self.reader.read(self.state.position)
            self._raw = self.reader.through(*columns)
            self._surface = self.reader.holding(self._raw, self.volume)
            self._fine = self.fine_reader.holding(self.fine_reader.through(*columns), self.volume)
        return self._surface

    def surface(self, places: Float[np.ndarray, "c 2"]) -> Float[np.ndarray, " c"]:
        """Heights [m] of the free surface over places (x, y) [m]."""
        return self.reader.at(self._coefficients(), places)

    def volume_below(self) -> float:
        """Volume [m3] below the surface that the particles show, which would tell of clustering or voids."""
        self._coefficients()
        return self.reader.volume(self._raw)[0]

    def fields(self, names: Iterable[str]) -> dict[str, NodeField]:
        """The named fields at the particles now. Raises: OptionError where the engine knows no such field."""
        wanted = list(names)
        found = self.engine.read(self.state) if wanted else {}
        missing = [name for name in wanted if name not in found]
        if missing:
            raise OptionError(f"The engine '{self.engine.name}' has no field '{missing[0]}'; take it off the scene.")
        return {name: found[name] for name in wanted}

    def account(self) -> dict[str, float]:
        """Energies and works [J] of the engine; work_assimilation, of the corrections, is in work_of_ports where the
        engine has that."""
        account = dict(self.engine.account(self.state))
        account["work_assimilation"] = self.work
        if "work_of_ports" in account:
            account["work_of_ports"] += self.work
        return account
