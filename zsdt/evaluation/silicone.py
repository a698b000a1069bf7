"""A real silicone beam: its material from the recording without a mass, and what that predicts for the other two.

Recordings: `zsdt.interop.silicone_beam` (motion capture, not this project's virtual lab). Predicted by the finite
elements and by the twin's engine (`zsdt.tignn.cell_engine`, plain constants of the material, nothing learned). Both
begin with the beam straight and at rest at the last frame in which it is held; nothing else of a loaded recording is
used but the mass and where gravity points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from zsdt.interop.silicone_beam import DENSITY, SHAPE, TIP, SiliconeRecording
from zsdt.scene import Foam, Modulus
from zsdt.solid.beam_observation import BeamObservation
from zsdt.solid.characterise import CharacteriseOptions, MaterialEstimate, characterise
from zsdt.solid.free_vibration import Decay, fit_decay
from zsdt.solid.prony import PronyChoice
from zsdt.solid.specimen import HungAt, Specimen, SpecimenFem
from zsdt.tignn.cell_energy import CellOptions, CellStart, nominal_constants
from zsdt.tignn.cell_engine import CellEngine, CellState

MESH = 0.01  # m, also the pitch of the twin's graph
# Silicone keeps its volume (0.499). Slender bending hardly sees that, while the time step would fall by a factor of six
# and St. Venant-Kirchhoff keeps tr E, not J, so it would not become better; the table of choices shows 0.3 to 0.499.
POISSON = 0.45
SKIP, SPAN = 0.15, 2.0  # s after the release between which the swing is looked at, measured and predicted alike


def specimen_of(recording: SiliconeRecording, mesh: float = MESH, hung_at: HungAt = HungAt.top) -> Specimen:
    """The beam of a recording with its mass. The authors' own simulation loads the upper edge of the tip face."""
    return Specimen(SHAPE, DENSITY, mesh, recording.gravity, recording.load, hung_at)


def swinging(recording: SiliconeRecording) -> Bool[np.ndarray, " frames"]:
    """Frames of the free swing."""
    since = recording.times - recording.times[recording.release]
    return (since > SKIP) & (since < SPAN)


def material_options(recording: SiliconeRecording, prony: PronyChoice = PronyChoice.least_g1) -> CharacteriseOptions:
    """Options of the fit: the held shape is as straight as its markers fit their places."""
    return CharacteriseOptions(
        poisson=POISSON, state=Modulus.long_term, prony=prony, straight_sd=recording.misfit, tolerance=5e-4
    )


def material_of(
    recording: SiliconeRecording, options: CharacteriseOptions | None = None, mesh: float = MESH
) -> MaterialEstimate:
    """The material from one recording alone."""
    seen = BeamObservation(
        times=recording.times,
        displacement=recording.displacement,
        places=recording.held[TIP],
        resting=recording.resting,
        swinging=swinging(recording),
    )
    return characterise(specimen_of(recording, mesh), seen, options or material_options(recording))


@dataclass(frozen=True)
class Prediction:
    """What a method says about a recording: displacement [frames, 3, 3] m of the tip markers from the release on, and
    rest [3, 3] m after a long time."""

    method: str
    displacement: Float[np.ndarray, "frames 3 3"]
    rest: Float[np.ndarray, "3 3"]


def frames_after(recording: SiliconeRecording) -> int:
    """Frames from the release to the end, both included."""
    return len(recording.times) - recording.release


def predict_fem(
    recording: SiliconeRecording, material: Foam, mesh: float = MESH, hung_at: HungAt = HungAt.top
) -> Prediction:
    """The finite elements, let go from the straight shape."""
    fem = SpecimenFem(specimen_of(recording, mesh, hung_at), recording.held[TIP])
    moved = fem.swing(material, frames_after(recording), _frame_dt(recording))
    return Prediction("fem", moved, fem.rest(material))


def twin_engine(recording: SiliconeRecording, material: Foam, hung_at: HungAt = HungAt.top) -> CellEngine:
    """The twin's engine, prepared for the beam with its mass."""
    specimen = specimen_of(recording, hung_at=hung_at)
    constants = nominal_constants(material.bulk, material.shear, material.g1, material.tau)
    engine = CellEngine(constants, CellOptions(start=CellStart.plain, inertia=False, anchor_stress=False), name="cell")
    engine.prepare(specimen.body(material, _frame_dt(recording)))
    engine.attach_mass(specimen.extra_mass)
    return engine


def held_state(engine: CellEngine) -> CellState:
    """The beam held straight: no displacement, no velocity, nothing in the memory."""
    fields = {"position": engine.body.points.copy(), "velocity": np.zeros((engine.body.nodes, 3))}
    return engine.start(fields, np.zeros((engine.body.nodes, 3)))


def predict_cell(recording: SiliconeRecording, material: Foam, hung_at: HungAt = HungAt.top) -> Prediction:
    """The twin's engine, let go from the straight shape."""
    engine = twin_engine(recording, material, hung_at)
    observe = specimen_of(recording, hung_at=hung_at).observe(recording.held[TIP])
    state = held_state(engine)
    still = np.zeros((engine.body.nodes, 3))
    seen = [observe @ state.u[:-1]]
    for _ in range(frames_after(recording) - 1):
        state = engine.step(state, still, still)
        seen.append(observe @ state.u[:-1])
    engine.equilibrate(state, engine.weight)
    return Prediction("cell", np.stack(seen), observe @ state.u[:-1])


def _frame_dt(recording: SiliconeRecording) -> float:
    return float(recording.times[-1] / (len(recording.times) - 1))


def measured_swing(recording: SiliconeRecording) -> Decay:
    """Frequency and damping of the mean tip marker along gravity, as recorded."""
    chosen = swinging(recording)
    return fit_decay(recording.times[chosen], (recording.displacement @ recording.down).mean(axis=1)[chosen])


def predicted_swing(recording: SiliconeRecording, prediction: Prediction) -> Decay:
    """The same of a prediction, over the same frames."""
    chosen = swinging(recording)[recording.release :]
    height = (prediction.displacement @ recording.down).mean(axis=1)
    return fit_decay(recording.times[recording.release :][chosen], height[chosen])


def compare(recording: SiliconeRecording, prediction: Prediction) -> dict[str, float | str]:
    """Measured beside predicted: static drops [mm], frequency [Hz], damping ratio, first extreme [mm], and the error
    of the whole curve as a share of the movement."""
    drop, rest = 1e3 * recording.drop, 1e3 * prediction.rest @ recording.down
    seen, said = measured_swing(recording).mode, predicted_swing(recording, prediction).mode
    curve = (recording.displacement[recording.release :] @ recording.down).mean(axis=1)
    guess = (prediction.displacement @ recording.down).mean(axis=1)
    return {
        "recording": recording.name,
        "method": prediction.method,
        "measured drop mm": float(drop.mean()),
        "predicted drop mm": float(rest.mean()),
        "drop error %": 100.0 * float(rest.mean() / drop.mean() - 1.0),
        "measured Tip-1 drop mm": float(drop[0]),
        "predicted Tip-1 drop mm": float(rest[0]),
        "Tip-1 drop error %": 100.0 * float(rest[0] / drop[0] - 1.0),
        "measured Hz": seen.frequency,
        "predicted Hz": said.frequency,
        "frequency error %": 100.0 * (said.frequency / seen.frequency - 1.0),
        "measured damping": seen.damping,
        "predicted damping": said.damping,
        "measured lowest mm": 1e3 * float(curve.max()),
        "predicted lowest mm": 1e3 * float(guess.max()),
        "open-loop error of the curve %": 100.0 * math.sqrt(float(((guess - curve) ** 2).sum() / (curve**2).sum())),
    }


def damping_over_time(recording: SiliconeRecording) -> tuple[float, float]:
    """Damping ratios fitted to the first and the second half of the measured swing: equal for a linear material."""
    chosen = np.flatnonzero(swinging(recording))
    height = (recording.displacement @ recording.down).mean(axis=1)
    first, second = (
        fit_decay(recording.times[half], height[half], resamples=0).mode.damping for half in np.array_split(chosen, 2)
    )
    return first, second
