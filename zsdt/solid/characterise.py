"""Material of a clamped beam from how it hangs and how it swings (the seed's first step; DESIGN 3.1).

Static shape -> relaxed Young's modulus: closed form of a bending beam, then the finite elements with large
displacements, scaled until they hang as the beam does. Free vibration -> frequency and damping, that is one complex
modulus at one complex frequency (`zsdt.solid.prony`): the finite elements swing with a trial material, and the ratio of
the two squared complex frequencies gives the next trial. What is seen are displacements of any points of the beam:
markers of motion capture, nodes of a twin that a camera tracks, or nodes of a simulation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.scene import Foam, Modulus
from zsdt.solid.beam_observation import BeamObservation
from zsdt.solid.free_vibration import Decay, fit_decay, principal_trace
from zsdt.solid.prony import (
    MaterialFamily,
    PronyChoice,
    complex_frequency,
    complex_young,
    from_given_tau,
    from_least_g1,
    from_static_ratio,
    loss_factor,
    relaxed_young,
)
from zsdt.solid.solver import SolverOptions
from zsdt.solid.specimen import Specimen, SpecimenFem

LEAST_NOISE = 1e-4  # m, of an observed place


@dataclass
class CharacteriseOptions:
    """How a material is fitted.

    poisson: taken as known, of the state `state` of the material. prony: what fixes g1 and tau. tau [s]: for
    `given_tau`. straight_sd [m]: how well the straight shape is known from which displacements count; it decides
    how much the static shape weighs against the vibration (not with `static_ratio`, which believes both). turn_sd
    [rad]: how well the direction of the straight shape is known in the plane of gravity, where a picture was laid on
    a short clamp; the turn and a shift of `straight_sd` are then fitted with the sag, whose curve tells them apart.
    rounds, tolerance: of the iteration with the finite elements, on frequencies and displacements. resamples: of the
    bootstrap. seed: of its draws.
    """

    poisson: float = 0.3
    state: Modulus = Modulus.instantaneous
    prony: PronyChoice = PronyChoice.static_ratio
    tau: float = 0.05
    straight_sd: float = 0.0
    turn_sd: float = 0.0
    rounds: int = 8
    tolerance: float = 1e-3
    resamples: int = 48
    seed: int = 0

    def __post_init__(self) -> None:
        if not -1.0 < self.poisson < 0.5:
            raise OptionError(f"Poisson ratio {self.poisson} is outside (-1, 0.5); choose one inside.")
        if min(self.straight_sd, self.turn_sd) < 0:
            raise OptionError("straight_sd and turn_sd must not be negative; 0 means exactly known.")
        if self.tau <= 0 or self.rounds < 1 or self.resamples < 2 or self.tolerance <= 0:
            raise OptionError("tau, rounds and tolerance must be positive and resamples above 1.")


@dataclass(frozen=True)
class MaterialEstimate:
    """A material and how well it is known.

    material: density, Young's modulus, Poisson ratio, g1, tau as the solver and engines take them. *_sd: standard
    deviations from the bootstrap of the vibration and from `straight_sd` (another Prony choice, Poisson ratio or
    density is not in them). relaxed_young: of that material [Pa]; static_young: relaxed modulus that the static shape
    alone asks for, static_young_sd its uncertainty; beam_theory_young: the same by the closed form. vibration_young:
    relaxed modulus that the vibration alone asks for with the chosen Prony term. storage_young, loss_factor: at
    `frequency` [Hz], well known whatever was chosen. frequency, damping: as seen; fem_frequency, fem_damping: of the
    finite elements with the material that the vibration alone asks for. notes: what a reader should know.
    """

    material: Foam
    young_sd: float
    g1_sd: float
    tau_sd: float
    relaxed_young: float
    static_young: float
    static_young_sd: float
    beam_theory_young: float
    vibration_young: float
    storage_young: float
    loss_factor: float
    loss_factor_sd: float
    frequency: float
    frequency_sd: float
    damping: float
    damping_sd: float
    fem_frequency: float
    fem_damping: float
    notes: list[str] = field(default_factory=list)

    def summary(self) -> dict[str, Any]:
        """All numbers by name, for tables and JSON (SI)."""
        own = {k: v for k, v in vars(self).items() if isinstance(v, float)}
        m = self.material
        card = {"density": m.density, "young": m.young, "poisson": m.poisson, "g1": m.g1, "tau": m.tau}
        return {**card, "modulus": m.modulus.value, **own}


def characterise(
    specimen: Specimen,
    seen: BeamObservation,
    options: CharacteriseOptions | None = None,
    solver: SolverOptions | None = None,
) -> MaterialEstimate:
    """Young's modulus, g1 and tau of a clamped beam.

    Raises: DataError where the beam neither sags nor swings as one, RunRejected where no material of this kind does
    what was seen (the sentence says which part does not fit).
    """
    options = options or CharacteriseOptions()
    fem = SpecimenFem(specimen, seen.places, solver)
    rest = seen.rest()
    theory = specimen.beam_theory(options.poisson).young_from_shape(
        np.clip(seen.places[:, 0], 0.0, specimen.shape.length), rest[:, 2]
    )
    family = MaterialFamily(specimen.density, options.poisson, options.state)
    trace, pattern = principal_trace(seen.displacement[seen.swinging])
    times = seen.times[seen.swinging]
    decay = fit_decay(times, trace, options.resamples, options.seed)
    fit = _Fit(fem, family, options, rest, theory, times, trace, pattern, decay)
    return fit.run()


@dataclass
class _Fit:
    """The iteration between what was seen and the finite elements."""

    fem: SpecimenFem
    family: MaterialFamily
    options: CharacteriseOptions
    rest: np.ndarray
    theory: float
    times: np.ndarray
    trace: np.ndarray
    pattern: np.ndarray
    decay: Decay
    static_spread: float = 0.0  # relative standard deviation of the static modulus

    def run(self) -> MaterialEstimate:
        """Fixed point: trial material -> finite elements -> factors -> next trial."""
        options = self.options
        target = complex_frequency(self.decay.mode.frequency, self.decay.mode.damping)
        theory_hz = self.fem.specimen.beam_theory(options.poisson).frequency(self.theory)
        inertia: complex = self.theory / (2.0 * math.pi * theory_hz) ** 2  # M in E(s) = -M s^2
        sag = 1.0  # static modulus of the finite elements over that of beam theory
        for _ in range(options.rounds):
            material = self.choose(self.theory * sag, -inertia * target**2, target)
            previous = sag
            sag *= self.static_factor(material, self.theory * sag)
            swung = self.swing(material)
            found = complex_frequency(swung.mode.frequency, swung.mode.damping)
            inertia = -complex_young(material, found) / found**2
            if abs(found / target - 1.0) < options.tolerance and abs(sag / previous - 1.0) < options.tolerance:
                break
        else:
            raise RunRejected(
                "no_fit",
                f"After {options.rounds} rounds the finite elements swing at {swung.mode.frequency:.3g} Hz where "
                f"{self.decay.mode.frequency:.3g} Hz were seen; check sizes, density and tip mass of the beam.",
            )
        return self.estimate(material, self.theory * sag, -inertia * target**2, inertia, swung)

    def choose(self, static: float, modulus: complex, s: complex) -> Foam:
        """The material by the chosen rule."""
        if self.options.prony is PronyChoice.static_ratio:
            return from_static_ratio(self.family, static, modulus, s)
        if self.options.prony is PronyChoice.given_tau:
            return from_given_tau(self.family, modulus, s, self.options.tau)
        return from_least_g1(self.family, modulus, s)

    def static_factor(self, material: Foam, static: float) -> float:
        """By what the relaxed modulus `static` must be multiplied so that the beam hangs as it was seen.

        The material is scaled to that modulus; secants in logarithms, so few relaxations do.
        """
        step, slope, last = 0.0, -1.0, (0.0, 0.0)  # in the logarithms of modulus and share; sag is about 1 / E
        for attempt in range(15):
            trial = scaled(material, math.exp(step) * static / relaxed_young(material))
            share, self.static_spread = self.sag_share(self.fem.rest(trial))
            if share <= 0:
                raise DataError("The beam hangs to the other side of gravity; check the axes of the recording.")
            if abs(share - 1.0) < 0.1 * self.options.tolerance:
                return math.exp(step)
            gap = -math.log(share)
            if attempt and abs(step - last[0]) > 1e-9:
                slope = float(np.clip((gap - last[1]) / (step - last[0]), -3.0, -0.2))
            last = step, gap
            step -= gap / slope
        raise RunRejected("static", "No modulus lets the beam hang as it was seen; check sizes, density and tip mass.")

    def sag_share(self, hang: np.ndarray) -> tuple[float, float]:
        """Observed sag over `hang` [points, 3] m, and its standard deviation, with the doubts of the straight shape."""
        options, rest, places = self.options, self.rest, self.fem.places
        if options.turn_sd == 0.0:
            spread = options.straight_sd * math.sqrt(len(rest)) / float(np.linalg.norm(rest))
            return float((rest**2).sum()) / float((hang * rest).sum()), spread
        zero, one = np.zeros(len(rest)), np.ones(len(rest))
        turn = np.stack([places[:, 2] + rest[:, 2], zero, -(places[:, 0] + rest[:, 0])], axis=1)
        shifts = [np.stack([one, zero, zero], axis=1), np.stack([zero, zero, one], axis=1)]
        columns = np.stack([c.ravel() for c in (hang, turn, *shifts)], axis=1)
        noise = max(options.straight_sd, LEAST_NOISE)
        weights = np.diag([0.0, 1.0 / options.turn_sd, 1.0 / noise, 1.0 / noise])
        rows = np.concatenate([columns / noise, weights])
        found = np.linalg.lstsq(rows, np.concatenate([rest.ravel() / noise, np.zeros(4)]), rcond=None)[0]
        return float(found[0]), math.sqrt(float(np.linalg.inv(rows.T @ rows)[0, 0]))

    def swing(self, material: Foam) -> Decay:
        """The finite elements' own swing with the amplitude that was seen, looked at in the same way."""
        direction = self.pattern[np.argmax(np.linalg.norm(self.pattern, axis=1))]
        direction = direction / np.linalg.norm(direction)
        specimen = self.fem.specimen
        inertia_moment = specimen.shape.width * specimen.shape.depth**3 / 12.0
        stiffness = 3.0 * relaxed_young(material) * inertia_moment / specimen.shape.length**3
        amplitude = self.decay.mode.amplitude * float(np.linalg.norm(self.pattern, axis=1).max())
        dt = float(self.times[1] - self.times[0])
        moved = self.fem.swing(material, len(self.times), dt, stiffness * amplitude * direction)
        trace = moved.reshape(len(moved), -1) @ self.pattern.ravel()
        return fit_decay(self.times, trace, resamples=0, near=self.decay.mode.frequency)

    def estimate(
        self, material: Foam, static: float, modulus: complex, inertia: complex, swung: Decay
    ) -> MaterialEstimate:
        """The result, with the bootstrap of the closed forms around the solution."""
        options, mode = self.options, self.decay.mode
        spread = self.static_spread
        rows, refused = self._resample(static, spread, inertia)
        sds = rows.std(axis=0)
        vibration = relaxed_young(material)
        if options.prony is PronyChoice.static_ratio:
            blended = material
        else:
            blended = scaled(material, _blend(vibration, float(sds[3]), static, spread * static) / vibration)
        notes = [_IDENTIFIED[options.prony]]
        if refused:
            notes.append(f"{refused} of {options.resamples} resamples had no such Prony term and were left out.")
        return MaterialEstimate(
            material=blended,
            young_sd=float(sds[0]),
            g1_sd=float(sds[1]),
            tau_sd=float(sds[2]),
            relaxed_young=relaxed_young(blended),
            static_young=static,
            static_young_sd=spread * static,
            beam_theory_young=self.theory,
            vibration_young=vibration,
            storage_young=complex_young(material, 2j * math.pi * mode.frequency).real,
            loss_factor=loss_factor(material, mode.frequency),
            loss_factor_sd=float(sds[4]),
            frequency=mode.frequency,
            frequency_sd=self.decay.frequency_sd,
            damping=mode.damping,
            damping_sd=self.decay.damping_sd,
            fem_frequency=swung.mode.frequency,
            fem_damping=swung.mode.damping,
            notes=notes,
        )

    def _resample(self, static: float, spread: float, inertia: complex) -> tuple[np.ndarray, int]:
        """(young, g1, tau, relaxed young, loss factor) of each resample, and how many had no material."""
        generator = np.random.default_rng(self.options.seed)
        rows, refused = [], 0
        for frequency, damping in self.decay.samples:
            s = complex_frequency(float(frequency), float(damping))
            drawn = static * (1.0 + spread * generator.normal())
            try:
                m = self.choose(drawn, -inertia * s**2, s)
            except RunRejected:
                refused += 1
                continue
            rows.append([m.young, m.g1, m.tau, relaxed_young(m), loss_factor(m, float(frequency))])
        if len(rows) < 2:
            raise RunRejected("bootstrap", "Hardly any resample gives a material; the recording is too noisy.")
        return np.array(rows), refused


_IDENTIFIED: dict[PronyChoice, str] = {
    PronyChoice.static_ratio: "g1 and tau come from the difference between the vibration's modulus and the static one.",
    PronyChoice.least_g1: "One frequency fixes storage modulus and loss factor only; g1 is the smallest that explains "
    "the damping, which puts the peak of the loss near the observed frequency.",
    PronyChoice.given_tau: "One frequency fixes storage modulus and loss factor only; tau was given.",
}


def scaled(material: Foam, factor: float) -> Foam:
    """The same material with all moduli multiplied."""
    m = material
    return Foam(m.density, m.young * factor, m.poisson, m.g1, m.tau, m.modulus)


def _blend(first: float, first_sd: float, second: float, second_sd: float) -> float:
    """Mean of two moduli weighed by their variances; the second alone where it is exact."""
    if second_sd == 0 and first_sd == 0:
        return 0.5 * (first + second)
    share = second_sd**2 / (first_sd**2 + second_sd**2)
    return share * first + (1.0 - share) * second
