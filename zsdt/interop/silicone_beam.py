"""Motion capture of a real silicone beam that is held straight, let go, and swings to rest under a hung mass.

Data of Dubied et al., IEEE RA-L 2022 (github.com/srl-ethz/diffPD_sim2real, MIT): Dragon Skin 10, 30 x 30 x 100 mm,
clamped at one end, 100 frames a second. Three markers sit near the tip, three on the clamp; files without a mass and
with 52 g and 101 g hung on the tip's edge.

**Axes.** Capture axes have gravity along -x. Beam axes are those of a `zsdt.trajectory.Body`: x from the clamp
(x = 0) to the tip, y across, z up. The best rigid placement takes the six markers of the beam *as it is held* to where
the authors say that they sit. The clamp's three markers alone would leave the tip 2 to 6 mm off: they are 27 mm
apart in height, their places are known to half a millimetre, and the tip is 94 mm away. The held beam points 6.5 to
7.5 degrees downward, so gravity has a part along the beam.

**What is not known.** "Straight" is what a hand held (the six markers fit to 0.8-1.1 mm), and this is what a drop is
measured from. Seen in the files: a clamp marker that slips by 0.3 mm before the release, another by 0.8 mm at the
release with 52 g, and single frames in which clamp markers jump by 0.3 mm.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from zsdt.errors import DataError
from zsdt.files import data_root
from zsdt.scene import BeamShape

SHAPE = BeamShape(length=0.1, width=0.03, depth=0.03)
DENSITY = 1070.0  # kg/m3
AUTHORS_YOUNG = 263.8e3  # Pa, fitted by the authors to all their recordings
STANDARD_GRAVITY = 9.81
MARKERS = ("Tip-1", "Tip-2", "Tip-3", "Base-1", "Base-2", "Base-3")
TIP, BASE = slice(0, 3), slice(3, 6)
# Places [m] in beam axes (SOURCE.md of the data, moved from the tip to the clamp).
PLACES = np.array(
    [
        [0.100, 0.015, 0.0360],
        [0.100, -0.006, 0.0240],
        [0.100, 0.036, 0.0060],
        [0.006, -0.010, -0.0010],
        [0.006, 0.040, 0.0275],
        [0.006, 0.040, 0.0000],
    ]
)
RECORDINGS = {"gravity": 0.0, "load52": 0.052, "load101": 0.101}  # kg hung on the tip's edge
UNITS = {"m": 1.0, "mm": 1e-3}
MOVED = 3e-4  # m, movement of the tip markers that counts as let go
SUSTAINED = 5  # frames for which it must last
HOLD, REST = 10, 0.5  # frames before the release, seconds at the end, over which places are averaged


@dataclass(frozen=True)
class SiliconeRecording:
    """One release in beam axes.

    load: hung mass [kg]. times [frames] s. markers [frames, 6, 3] m in the order of `MARKERS`, NaN where one was not
    seen. gravity [3] m/s2. release: last frame in which the beam is held. misfit [m]: root mean square by which the
    held markers miss their places.
    """

    name: str
    load: float
    times: Float[np.ndarray, " frames"]
    markers: Float[np.ndarray, "frames 6 3"]
    gravity: Float[np.ndarray, "3"]
    release: int
    misfit: float

    @cached_property
    def held(self) -> Float[np.ndarray, "6 3"]:
        """Places [m] of the markers while the beam is held straight."""
        return np.nanmean(self.markers[max(self.release - HOLD, 0) : self.release + 1], axis=0)

    @cached_property
    def resting(self) -> Bool[np.ndarray, " frames"]:
        """Frames at the end over which the beam counts as at rest."""
        return self.times >= self.times[-1] - REST

    @cached_property
    def rest(self) -> Float[np.ndarray, "6 3"]:
        """Places [m] of the markers at the end."""
        return np.nanmean(self.markers[self.resting], axis=0)

    @property
    def down(self) -> Float[np.ndarray, "3"]:
        """Unit vector along gravity."""
        return self.gravity / np.linalg.norm(self.gravity)

    @property
    def drop(self) -> Float[np.ndarray, "3"]:
        """Fall of the three tip markers [m] along gravity, from held to rest."""
        return (self.rest - self.held)[TIP] @ self.down

    @property
    def displacement(self) -> Float[np.ndarray, "frames 3 3"]:
        """Displacement [m] of the tip markers from where they were held."""
        return self.markers[:, TIP] - self.held[TIP]

    @property
    def base_motion(self) -> Float[np.ndarray, "3"]:
        """Distance [m] between held and rest of each clamp marker: zero for a clamp that does not give."""
        return np.linalg.norm((self.rest - self.held)[BASE], axis=1)


def read_silicone(name: str, folder: Path | None = None) -> SiliconeRecording:
    """Recording `gravity`, `load52` or `load101`.

    Raises: DataError where the name is unknown or the file is missing, broken, or shows no release.
    """
    if name not in RECORDINGS:
        raise DataError(f"There is no silicone recording '{name}'; choose one of {', '.join(RECORDINGS)}.")
    path = (folder or data_root() / "silicone_beam") / f"beam_{name}_V2_a.csv"
    times, markers = read_markers(path)
    release = release_frame(markers[:, TIP], path.name)
    held = np.nanmean(markers[max(release - HOLD, 0) : release + 1], axis=0)
    if not np.isfinite(held).all():
        raise DataError(f"{path} does not show all six markers just before the release; place the beam by hand.")
    turn, shift, misfit = rigid_placement(held, PLACES)
    return SiliconeRecording(
        name=name,
        load=RECORDINGS[name],
        times=times,
        markers=markers @ turn.T + shift,
        gravity=turn @ np.array([-STANDARD_GRAVITY, 0.0, 0.0]),
        release=release,
        misfit=misfit,
    )


def read_markers(path: Path) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, "frames 6 3"]]:
    """Times [s] from the first frame on and marker positions [m] in capture axes; an empty cell becomes NaN.

    Columns: `t_s`, then `Tip-1_x_m` and so on in any order; `_mm` is converted.
    Raises: DataError where a column or a number is missing, or times do not rise in equal steps.
    """
    if not path.is_file():
        raise DataError(f"There is no {path}; put the data folder beside the repository or set ZSDT_DATA.")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [row for row in csv.reader(file) if row]
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path} is not a table of text ({error}); fetch it again.") from error
    head = [name.strip() for name in rows[0]] if rows else []
    if len(rows) < 2 * HOLD or any(len(row) != len(head) for row in rows):
        raise DataError(f"{path} is cut off or has rows of different lengths; fetch it again.")
    try:
        table = np.array([[float(cell) if cell.strip() else np.nan for cell in row] for row in rows[1:]])
    except ValueError as error:
        raise DataError(f"{path} holds something that is no number ({error}); fetch it again.") from error
    times = table[:, _column(path, head, "t", {"s": 1.0, "ms": 1e-3})[0]]
    steps = np.diff(times)
    if not (np.isfinite(times).all() and (steps > 0).all() and np.ptp(steps) < 0.02 * steps.mean()):
        raise DataError(f"The times of {path} do not rise in equal steps; fetch it again or resample it.")
    markers = np.empty((len(times), len(MARKERS), 3))
    for m, marker in enumerate(MARKERS):
        for c, axis in enumerate("xyz"):
            column, unit = _column(path, head, f"{marker}_{axis}", UNITS)
            markers[:, m, c] = unit * table[:, column]
    markers[~np.isfinite(markers).all(axis=2)] = np.nan  # a marker is seen as a whole or not at all
    return times - times[0], markers


def _column(path: Path, head: list[str], name: str, units: dict[str, float]) -> tuple[int, float]:
    for unit, factor in units.items():
        if f"{name}_{unit}" in head:
            return head.index(f"{name}_{unit}"), factor
    raise DataError(f"{path} has no column {name}_{next(iter(units))}; it is not a recording of the silicone beam.")


def release_frame(tip: Float[np.ndarray, "frames markers 3"], name: str = "The recording") -> int:
    """Last frame before the tip markers leave, for good, the place where they are at first.

    Raises: DataError where they never leave it.
    """
    away = np.linalg.norm(tip - np.nanmedian(tip[: 2 * HOLD], axis=0), axis=2)
    with np.errstate(invalid="ignore"):
        moved = np.nanmedian(np.where(np.isfinite(away), away, np.nan), axis=1) > MOVED
    lasting = np.lib.stride_tricks.sliding_window_view(moved, SUSTAINED).all(axis=1)
    if not lasting.any() or np.argmax(lasting) == 0:
        raise DataError(f"{name} shows no release: the tip markers must rest at first and move by 0.3 mm later.")
    return int(np.argmax(lasting)) - 1


def rigid_placement(
    seen: Float[np.ndarray, "points 3"], wanted: Float[np.ndarray, "points 3"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"], float]:
    """Rotation R, shift t [m] with `R seen + t` nearest to `wanted` (Kabsch), and the root mean square miss [m]."""
    middle, target = seen.mean(axis=0), wanted.mean(axis=0)
    turn = Rotation.align_vectors(wanted - target, seen - middle)[0].as_matrix()
    shift = target - turn @ middle
    miss = seen @ turn.T + shift - wanted
    return turn, shift, float(np.sqrt((miss**2).sum(axis=1).mean()))
