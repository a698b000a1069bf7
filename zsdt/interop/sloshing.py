"""Real sloshing: a glass cylinder of water on a robot, a swayed tank and collapsing columns of water.

**Cylinder** (github.com/GiorgioMedico/AntiSloshing, MIT, experiments of Di Leva, Soprani, Palli, Biagiotti and
Carricato): 21 motions of a container of radius 49 mm with 80 mm of water. Two cameras ride on the robot's hand, so
the height is that of the highest point of the surface over its rest level along the container's own axis. Position
and orientation are those of the middle of the container's floor, in room axes that are the container's at rest.

**Axes.** The container also spins about its own axis, which water in a round glass does not notice (its boundary
layer is 0.2 mm thin). Hence motion is given in *carried* axes: they tilt with the container, without its spin.

**Sign of the tilt in Tilt_TRD.** In TRD recordings the hand that carries glass and cameras was turned by half a turn
about the vertical (the authors' CfrMSDvsPTilting.m starts them with the last joint at -0.4 rad, not 3.14 rad), which
reverses the tilt in the room against the motion file: linear theory meets the measured heights with correlations of
0.96, 0.94 and 0.97 and peaks within 13 % with the tilt reversed, but with 0.91, 0.86, 0.90 and peaks 30 % too low as
written; no other recording gains by it. The reader reverses it; `as_written=True` leaves it.

**What the cameras see** depends on the side of the crest: in the cameras' axes the measured height is 0.9 to 1.1 of
the linear theory's where the crest is between 45 and 180 degrees, and 0.6 to 0.8 between 200 and 330 degrees, in all
21 recordings (`zsdt.evaluation.real_water` makes the table). `crest_side` tells the side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.optimize import curve_fit
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from zsdt.errors import DataError
from zsdt.files import data_root

CYLINDER_RADIUS, CYLINDER_DEPTH = 0.049, 0.08  # m
GRAVITY = 9.81
SMOOTHING = 0.05  # s, window of the smoothing derivative
REVERSED_TILT = "Tilt_TRD"
TURNED_HAND = ("TRD", "Tilt_TRD")
CAMERA_SIDE = math.radians(112.0)  # azimuth in the cameras' axes where they see a crest at its full height


@dataclass
class Kinematics:
    """Motion of a vessel in carried axes at equidistant times [s]; each array has the shape [steps, 3].

    acceleration: of the middle of the floor [m/s2]; gravity [m/s2]; angular_velocity [rad/s]; angular_acceleration
    [rad/s2].
    """

    times: Float[np.ndarray, " steps"]
    acceleration: Float[np.ndarray, "steps 3"]
    gravity: Float[np.ndarray, "steps 3"]
    angular_velocity: Float[np.ndarray, "steps 3"]
    angular_acceleration: Float[np.ndarray, "steps 3"]

    @property
    def specific_force(self) -> Float[np.ndarray, "steps 3"]:
        """Acceleration less gravity [m/s2]: what an accelerometer on the floor reads."""
        return self.acceleration - self.gravity


@dataclass
class CylinderRecording:
    """One motion of the robot and the height of the water that the cameras saw.

    times [s] of position [m] and quaternion (x y z w, of unit length); video_times [s] of height [m]. The two clocks
    differ by an unknown shift, see `align`.
    """

    name: str
    times: Float[np.ndarray, " steps"]
    position: Float[np.ndarray, "steps 3"]
    quaternion: Float[np.ndarray, "steps 4"]
    video_times: Float[np.ndarray, " frames"]
    height: Float[np.ndarray, " frames"]

    @property
    def kind(self) -> str:
        """LE (lemniscate), RD, TRD, Tilt_LE, ... followed by 2D or 3D."""
        words = self.name.split("_")
        return " ".join(words[: 1 + next((i for i, word in enumerate(words) if word in ("2D", "3D")), 0)])

    def span(self) -> tuple[float, float]:
        """Begin and end of the motion [s]: the first and the last sample off the ends by 0.1 mm."""
        begin = np.abs(self.position - self.position[0]).max(axis=1) > 1e-4
        end = np.abs(self.position - self.position[-1]).max(axis=1) > 1e-4
        if not begin.any():
            raise DataError(f"The container of {self.name} never moves; the motion file is not the recorded one.")
        return float(self.times[np.argmax(begin)]), float(self.times[len(end) - 1 - np.argmax(end[::-1])])

    def crest_side(
        self, times: Float[np.ndarray, " frames"], crest: Float[np.ndarray, "frames 2"]
    ) -> Float[np.ndarray, " frames"]:
        """Cosine of the angle between a crest in carried axes at `times` [s] and the side that the cameras see best."""
        spin = 2.0 * np.unwrap(np.arctan2(self.quaternion[:, 2], self.quaternion[:, 3]))
        turn = np.interp(times, self.times, spin) + (np.pi if self.name.startswith(TURNED_HAND) else 0.0)
        return np.cos(np.arctan2(crest[:, 1], crest[:, 0]) - turn - CAMERA_SIDE)

    def kinematics(self, start: float = 0.0, rest: float = 0.0) -> Kinematics:
        """Motion from `start` [s] on, then `rest` [s] at the last pose; time zero is `start`."""
        step = float(self.times[1] - self.times[0])
        hold = max(round(rest / step), 0)
        position = np.concatenate([self.position, np.repeat(self.position[-1:], hold, axis=0)])
        carried = _without_spin(np.concatenate([self.quaternion, np.repeat(self.quaternion[-1:], hold, axis=0)]))
        to_carried = np.swapaxes(carried, 1, 2)
        acceleration = _derivative(position, step, 2)
        spin = to_carried @ _derivative(carried.reshape(-1, 9), step, 1).reshape(-1, 3, 3)
        angular_velocity = 0.5 * np.stack(
            [spin[:, 2, 1] - spin[:, 1, 2], spin[:, 0, 2] - spin[:, 2, 0], spin[:, 1, 0] - spin[:, 0, 1]], axis=-1
        )
        first = round(start / step)
        return Kinematics(
            times=step * np.arange(len(position) - first),
            acceleration=np.einsum("tij,tj->ti", to_carried, acceleration)[first:],
            gravity=-GRAVITY * to_carried[first:, :, 2],
            angular_velocity=angular_velocity[first:],
            angular_acceleration=_derivative(angular_velocity, step, 1)[first:],
        )


def recording_names(folder: Path | None = None) -> list[str]:
    """Names of the recorded motions of the cylinder, sorted.

    Raises: DataError where there are none.
    """
    motion = (folder or data_root() / "sloshing_cylinder") / "motion"
    names = sorted(p.stem for p in motion.glob("*.csv"))
    if not names:
        raise DataError(
            f"There are no recordings in {motion}; put the data folder beside the repository or set ZSDT_DATA."
        )
    return names


def read_cylinder(name: str, folder: Path | None = None, as_written: bool = False) -> CylinderRecording:
    """Reads one recording of the cylinder (see above for `as_written`).

    Raises: DataError where a file is missing or broken.
    """
    root = folder or data_root() / "sloshing_cylinder"
    motion = _table(root / "motion" / f"{name}.csv", ";", 8, header=False)
    height = _table(root / "heights" / f"{name}.csv", ",", 2, header=True)
    times, quaternion = motion[:, 0], motion[:, 4:8]
    step = np.diff(times)
    if len(times) < 100 or np.ptp(step) > 1e-6 or (step <= 0).any() or (np.diff(height[:, 0]) <= 0).any():
        raise DataError(f"The times of {name} are not equidistant or do not rise; fetch its two files again.")
    norm = np.linalg.norm(quaternion, axis=1)
    if np.abs(norm - 1.0).max() > 1e-3:
        raise DataError(f"The orientations of {name} are not unit quaternions; fetch its motion file again.")
    quaternion = quaternion / norm[:, None]
    if name.startswith(REVERSED_TILT) and not as_written:
        quaternion = quaternion * np.array([-1.0, -1.0, -1.0, 1.0])
    return CylinderRecording(
        name=name,
        times=times,
        position=motion[:, 1:4],
        quaternion=quaternion,
        video_times=height[:, 0],
        height=1e-3 * height[:, 1],
    )


def align(
    video_times: Float[np.ndarray, " frames"],
    height: Float[np.ndarray, " frames"],
    times: Float[np.ndarray, " steps"],
    model: Float[np.ndarray, " steps"],
) -> tuple[float, float]:
    """Video time [s] of the model's time zero, and the correlation there, from the best cross-correlation.

    The whole model must lie inside the video; its times [s] are equidistant. Accurate to a fraction of a frame.
    Raises: DataError where the video is shorter than the model.
    """
    step = float(np.median(np.diff(video_times)))
    clock = np.arange(video_times[0], video_times[-1], step)
    seen = np.interp(clock, video_times, height)
    wanted = np.interp(np.arange(times[0], times[-1], step), times, model)
    if len(seen) < len(wanted):
        raise DataError("The video is shorter than the motion it is compared with; cut the motion's rest.")
    windows = np.lib.stride_tricks.sliding_window_view(seen, len(wanted))
    wanted = wanted - wanted.mean()
    spread = windows.std(axis=1) * wanted.std() * len(wanted)
    score = (windows @ wanted) / np.maximum(spread, 1e-12)
    best = int(np.argmax(score))
    offset = 0.0
    if 0 < best < len(score) - 1:
        left, top, right = score[best - 1 : best + 2]
        bend = left - 2.0 * top + right
        offset = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return float(clock[0] + (best + offset) * step - times[0]), float(score[best])


@dataclass(frozen=True)
class Residual:
    """Free oscillation after the motion: frequency [Hz], decay rate of the height [1/s], height at its begin [m].

    visible: share of the squared height that oscillates; a surface that just turns round (0) shows no frequency.
    """

    frequency: float
    decay: float
    height: float
    visible: float


def residual_oscillation(
    times: Float[np.ndarray, " frames"], height: Float[np.ndarray, " frames"], frequency: float = 3.0
) -> Residual:
    """Fits the free decay of the highest point of the surface; `frequency` [Hz] is the first guess.

    The first mode swings in an ellipse with half-axes A and B; its highest point obeys `height^2 = exp(-2 c t)
    ((A^2 + B^2)/2 + (A^2 - B^2)/2 cos(2 omega t + phase))`, which is fitted by least squares.
    Raises: DataError where no such fit is found.
    """
    t = times - times[0]
    square = height**2

    def model(t, level, cosine, sine, decay, omega):
        return np.exp(-2.0 * decay * t) * (level + cosine * np.cos(2.0 * omega * t) + sine * np.sin(2.0 * omega * t))

    trials = []
    for factor in (0.95, 1.0, 1.05):
        guess = (square.mean(), 0.3 * square.mean(), 0.3 * square.mean(), 0.2, 2.0 * np.pi * frequency * factor)
        try:
            found, _ = curve_fit(model, t, square, p0=guess, maxfev=5000)
        except RuntimeError:
            continue
        trials.append((float(np.sum((model(t, *found) - square) ** 2)), found))
    if not trials:
        raise DataError("No free oscillation fits these heights; take a window after the motion.")
    level, cosine, sine, decay, omega = min(trials, key=lambda trial: trial[0])[1]
    swing = float(np.hypot(cosine, sine))
    return Residual(
        frequency=float(abs(omega) / (2.0 * np.pi)),
        decay=float(decay),
        height=float(np.sqrt(max(level + swing, 0.0))),
        visible=swing / max(abs(float(level)), 1e-30),
    )


def faltinsen(folder: Path | None = None) -> Float[np.ndarray, "points 2"]:
    """Time [s] and surface elevation [m] 0.05 m from the left wall of a swayed tank.

    1.73 m long, 1.15 m high, 0.6 m of water, sway of amplitude 0.032 m and period 1.3 s (Faltinsen et al., J. Fluid
    Mech. 407, 2000, figure 7, digitised).
    """
    return _table((folder or data_root() / "sloshing_digitised") / "faltinsen.csv", ",", 2, header=False)


def martin_moyce(folder: Path | None = None) -> dict[str, Float[np.ndarray, "points 2"]]:
    """Front of collapsing columns twice as high as wide (a): t sqrt(2 g / a) and z / a.

    Martin and Moyce, Phil. Trans. R. Soc. A 244, 1952, with a = 1.125 and 2.25 in; Koshizuka and Oka, Nucl. Sci. Eng.
    123, 1996.
    """
    root = folder or data_root() / "sloshing_digitised"
    files = {"a = 1.125 in": "mm_data_1.csv", "a = 2.25 in": "mm_data_2.csv", "Koshizuka": "ko_data.csv"}
    return {name: _table(root / file, ",", 2, header=False) for name, file in files.items()}


def _without_spin(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices [steps, 3, 3] that turn z into the container's axis along the shortest way."""
    axis = Rotation.from_quat(quaternion).apply([0.0, 0.0, 1.0])
    if axis[:, 2].min() < -0.99:
        raise DataError("The container is upside down, where its tilt has no direction; the motion file is broken.")
    swing = np.stack([-axis[:, 1], axis[:, 0], np.zeros(len(axis)), 1.0 + axis[:, 2]], axis=-1)
    return Rotation.from_quat(swing / np.linalg.norm(swing, axis=1)[:, None]).as_matrix()


def _derivative(values: np.ndarray, step: float, order: int) -> np.ndarray:
    """Savitzky-Golay derivative along the first axis; what is before and after is taken to rest."""
    window = 2 * round(0.5 * SMOOTHING / step) + 1
    return savgol_filter(values, window, 4, deriv=order, delta=step, axis=0, mode="nearest")


def _table(path: Path, delimiter: str, columns: int, header: bool) -> np.ndarray:
    """Numbers of a text file; DataError says what is wrong with it."""
    if not path.is_file():
        raise DataError(f"There is no {path}; put the data folder beside the repository or set ZSDT_DATA.")
    try:
        values = np.loadtxt(path, delimiter=delimiter, skiprows=int(header), ndmin=2)
    except ValueError as error:
        raise DataError(f"{path} is not a table of numbers ({error}); fetch it again.") from error
    if values.shape[1:] != (columns,) or len(values) < 2 or not np.isfinite(values).all():
        raise DataError(f"{path} does not hold {columns} columns of finite numbers; fetch it again.")
    return values
