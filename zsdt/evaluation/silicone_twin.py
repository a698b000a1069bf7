"""The twin loop on a real beam whose only observation is motion capture: two tip markers seen, the third predicted.

Each of the three tip markers is withheld in turn. Open and closed loop know the same: the material (from the recording
without a mass), the hung mass, gravity, and that the beam is straight and at rest at the release. The open loop runs
free from there; the closed loop is shown two markers in every frame.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from zsdt.evaluation.silicone import Prediction, frames_after, held_state, predict_cell, specimen_of, twin_engine
from zsdt.interop.silicone_beam import MARKERS, TIP, SiliconeRecording
from zsdt.scene import Foam
from zsdt.twin.assimilation import AssimilationOptions
from zsdt.twin.beam_twin import BeamTwin
from zsdt.twin.observation import Observation


@dataclass(frozen=True)
class Withheld:
    """One loop without one marker: what the twin says of it and where it was.

    predicted, seen [frames, 3] m: displacement of the withheld marker from the release on; open_loop likewise.
    """

    recording: SiliconeRecording
    marker: int
    predicted: Float[np.ndarray, "frames 3"]
    seen: Float[np.ndarray, "frames 3"]
    open_loop: Float[np.ndarray, "frames 3"]

    def row(self) -> dict[str, float | str]:
        """Root mean square errors [mm], from the release on and over the last half second."""
        size = _rms(self.seen)
        late = slice(-round(0.5 / float(self.recording.times[1] - self.recording.times[0])), None)
        closed, free = self.predicted - self.seen, self.open_loop - self.seen
        return {
            "recording": self.recording.name,
            "withheld": MARKERS[self.marker],
            "movement rms mm": 1e3 * size,
            "open loop rms mm": 1e3 * _rms(free),
            "closed loop rms mm": 1e3 * _rms(closed),
            "open loop %": 100.0 * _rms(free) / size,
            "closed loop %": 100.0 * _rms(closed) / size,
            "open over closed": _rms(free) / _rms(closed),
            "open loop at rest mm": 1e3 * _rms(free[late]),
            "closed loop at rest mm": 1e3 * _rms(closed[late]),
            "closed loop worst mm": 1e3 * float(np.linalg.norm(closed, axis=1).max()),
        }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean((values**2).sum(axis=1))))


def loop_options() -> AssimilationOptions:
    """The twin's options: the material is known, nothing unknown pulls at first.

    noise: motion capture itself is good to 0.01 mm, but the markers ride on soft silicone (the distances between them
    change by 0.1 mm), and a model of it is not right to better than some tenths of a millimetre.
    """
    return AssimilationOptions(noise=3e-4, first_noise=3e-4, calibrate=False, modes=3, sideways_modes=2, load_rate=1.0)


def closed_loop(
    recording: SiliconeRecording,
    material: Foam,
    shown: Iterable[int],
    rest: Float[np.ndarray, "3 3"],
    options: AssimilationOptions | None = None,
) -> Float[np.ndarray, "frames 3 3"]:
    """Displacement [m] of all three tip markers from the release on, by a twin that is shown the markers `shown`.

    rest [3, 3] m: displacement of the markers in the model's own rest, about which the twin takes its modes.
    """
    specimen, chosen = specimen_of(recording), list(shown)
    places = recording.held[TIP]
    everything = specimen.observe(places)
    engine = twin_engine(recording, material)
    twin = BeamTwin(
        engine, None, engine.body, None, None, options or loop_options(),
        planar=False, operator=everything[chosen], extra_mass=specimen.extra_mass,
    )  # fmt: skip
    twin.begin(_observation(recording.release, 0.0, (places + rest)[chosen]))
    twin.state = held_state(engine)
    moved = [everything @ twin.position - places]
    for frame in range(recording.release + 1, len(recording.times)):
        twin.predict()
        twin.correct(_observation(frame, float(recording.times[frame]), recording.markers[frame, TIP][chosen]))
        moved.append(everything @ twin.position - places)
    return np.stack(moved)


def _observation(frame: int, time: float, positions: Float[np.ndarray, "points 3"]) -> Observation:
    seen = np.isfinite(positions).all(axis=1)
    pixels = np.full((len(positions), 2), np.nan)
    return Observation(frame, time, pixels, seen, positions, has_depth=True)


def leave_one_out(recording: SiliconeRecording, material: Foam, open_loop: Prediction | None = None) -> list[Withheld]:
    """The closed loop without each of the tip markers in turn, beside the open loop."""
    free = open_loop or predict_cell(recording, material)
    seen = recording.displacement[recording.release :]
    assert len(seen) == frames_after(recording)
    results = []
    for marker in range(3):
        moved = closed_loop(recording, material, [m for m in range(3) if m != marker], free.rest)
        results.append(Withheld(recording, marker, moved[:, marker], seen[:, marker], free.displacement[:, marker]))
    return results
