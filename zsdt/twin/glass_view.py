"""What a run of a glass twin shows to people, as plain arrays: overlay, recording and plots read nothing else.

A `GlassTwinView` is a twin's own run (closed or open loop) or, in the virtual lab, the truth in the same dress
(`glass_truth_view`). Its frames begin before the particles do: row `start` is t0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from zsdt.errors import DataError
from zsdt.evaluation.sloshing import centroid
from zsdt.fluid.vessel import Vessel
from zsdt.perception.camera import Camera
from zsdt.trajectory import Body, Trajectory
from zsdt.twin.field_scale import LiquidName
from zsdt.twin.glass_levels import surface_heights
from zsdt.twin.trust import TrustSeries

RIGHT = np.array([1.0, 0.0, 0.0])  # of the picture, in the axes of room and vessel
WAITING = ("capture",)  # parts of the latency that are the source's and not the twin's
WARM_UP = 5  # frames
_NEEDED: dict[str, str] = {
    LiquidName.vertical_velocity: "velocity",
    LiquidName.speed: "velocity",
    LiquidName.internal_energy: "internal_energy",
}  # shown field -> field of the state that it is made of


@dataclass
class GlassTwinView:
    """A run over `frames` frames of a clip, with particles from row `start` on (`moving` rows).

    name: of the side, such as ``closed loop``. body: the liquid, in the axes of its vessel (origin: middle of the
    cavity's floor). camera: as the twin knows it, in the axes of the room; wall, floor [m]: thickness of the
    glass. frames [frames]: numbers in the clip, times [frames] s; origin [frames, 3] m: of the vessel in the room, NaN
    where no glass was seen. positions [moving, nodes, 3] m, fields: name -> [moving, nodes, components] SI.

    places [columns, 2] m: (x, y) of the surface's profile in the vessel; level [moving, columns] m: of the run,
    predicted_level: before it was corrected, seen_level: as observed, NaN where nothing was; seen_px [moving, columns,
    2] px: where in the picture. outlines [frames]: contour [points, 2] px of the seen liquid, empty if there is none.

    latency: part -> [frames] ms; whole [frames] ms: of them all, what runs side by side counted once. faults [frames]:
    why a frame was not used, empty where it was; phases [frames]: what was done before t0 (waiting, moving), empty
    afterwards. account: name -> [moving] J, `volume` [m3]. viscosity [moving]: as estimated, over the told one.
    source: what the pictures are, such as ``virtual lab``. closed: whether the twin was corrected. trust:
    what was thought of each frame from `start` on, None for the truth and where it was switched off.
    """

    name: str
    body: Body
    camera: Camera
    wall: float
    floor: float
    start: int
    frames: Int[np.ndarray, " frames"]
    times: Float[np.ndarray, " frames"]
    origin: Float[np.ndarray, "frames 3"]
    positions: Float[np.ndarray, "moving nodes 3"]
    places: Float[np.ndarray, "columns 2"]
    level: Float[np.ndarray, "moving columns"]
    fields: dict[str, Float[np.ndarray, "moving nodes _"]] = field(default_factory=dict)
    predicted_level: Float[np.ndarray, "moving columns"] | None = None
    seen_level: Float[np.ndarray, "moving columns"] | None = None
    seen_px: Float[np.ndarray, "moving columns 2"] | None = None
    outlines: list[Float[np.ndarray, "_ 2"]] = field(default_factory=list)
    latency: Mapping[str, Float[np.ndarray, " frames"]] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    phases: list[str] = field(default_factory=list)
    account: Mapping[str, Float[np.ndarray, " moving"]] = field(default_factory=dict)
    whole: Float[np.ndarray, " frames"] | None = None
    viscosity: Float[np.ndarray, " moving"] | None = None
    source: str = ""
    closed: bool = True
    trust: TrustSeries | None = None

    def __post_init__(self) -> None:
        if self.body.vessel is None:
            raise DataError(f"The run {self.name} has no vessel to draw; give a body with one.")
        unknown = np.full(self.level.shape, np.nan)
        self.predicted_level = self.level if self.predicted_level is None else self.predicted_level
        self.seen_level = unknown if self.seen_level is None else self.seen_level
        self.seen_px = np.full((*self.level.shape, 2), np.nan) if self.seen_px is None else self.seen_px
        self.outlines = self.outlines or [np.zeros((0, 2))] * self.count
        self.faults = self.faults or [""] * self.count
        self.phases = self.phases or ["waiting"] * self.start + [""] * (self.count - self.start)
        whole: dict[str, Any] = {"times": self.times, "origin": self.origin, "outlines": self.outlines}
        whole |= {"faults": self.faults, "phases": self.phases, **self.latency}
        moving: dict[str, Any] = {"positions": self.positions, "level": self.level, "seen_level": self.seen_level}
        moving |= {"predicted_level": self.predicted_level, "seen_px": self.seen_px, **self.fields, **self.account}
        for count, series in ((self.count, whole), (self.count - self.start, moving)):
            for name, values in series.items():
                if len(values) != count:
                    raise DataError(f"{name} of the run {self.name} has {len(values)} frames instead of {count}.")

    @property
    def count(self) -> int:
        """Number of frames, those before t0 included."""
        return len(self.frames)

    @property
    def clock(self) -> Float[np.ndarray, " moving"]:
        """Seconds since t0 of the frames with particles."""
        return self.times[self.start :] - self.times[self.start]

    @property
    def vessel(self) -> Vessel:
        """The cavity."""
        assert self.body.vessel is not None
        return Vessel(self.body.vessel)

    def row_of(self, k: int) -> int | None:
        """Row among those with particles of frame row `k`, None before t0."""
        return k - self.start if k >= self.start else None

    def pixels(self, k: int) -> Float[np.ndarray, "nodes 2"]:
        """Where the particles of frame row `k` would be in the picture [px] if nothing refracted."""
        return self.camera.project(self.positions[k - self.start] + self.origin[k])

    def shows(self, name: str) -> bool:
        """Whether what this field is made of was decoded."""
        return _NEEDED.get(name, name) in self.fields

    def values(self, name: str) -> Float[np.ndarray, "moving nodes"]:
        """A field that can be shown, in SI. Raises: DataError where the run has not decoded it."""
        if not self.shows(name):
            raise DataError(
                f"The run {self.name} has not decoded {_NEEDED.get(name, name)}, which {name} is made of; ask for it."
            )
        values = self.fields[_NEEDED.get(name, name)]
        if name == LiquidName.vertical_velocity:
            return values[..., 2]
        return np.linalg.norm(values, axis=2) if name == LiquidName.speed else values[..., 0]

    def walls(self) -> Float[np.ndarray, "moving 2"]:
        """Height of the surface [m] beside the left and the right wall: at the outermost columns of the profile."""
        return self.level[:, self._ends()]

    def seen_walls(self) -> Float[np.ndarray, "moving 2"]:
        """What was observed there [m], NaN where it was not seen."""
        assert self.seen_level is not None
        return self.seen_level[:, self._ends()]

    def _ends(self) -> Int[np.ndarray, "2"]:
        return np.argsort(self.places[:, 0])[[0, -1]]

    def centroid(self) -> Float[np.ndarray, "moving 3"]:
        """Centre of mass [m] in the vessel."""
        return centroid(self.body, self.positions)

    def rise(self) -> Float[np.ndarray, " moving"]:
        """Root mean square of the vertical velocity over the particles [m/s]."""
        return np.sqrt(np.mean(np.square(self.values(LiquidName.vertical_velocity)), axis=1))

    def innovation_rms(self) -> Float[np.ndarray, " moving"]:
        """Root mean square over the seen columns of observed less predicted level [m]; NaN in frames without any."""
        assert self.seen_level is not None and self.predicted_level is not None
        squares = np.square(self.seen_level - self.predicted_level)
        known = np.isfinite(squares)
        total = np.where(known, squares, 0.0).sum(axis=1)
        return np.sqrt(total / np.where(known.any(axis=1), known.sum(axis=1), np.nan))

    def milliseconds(self) -> Float[np.ndarray, " frames"]:
        """From the picture to the decoded fields [ms]; the sum of the parts, without the waiting for a picture, where
        the run does not say; NaN where nothing was measured."""
        if self.whole is not None:
            return self.whole
        parts = [values for name, values in self.latency.items() if name not in WAITING]
        return np.sum(np.nan_to_num(parts), axis=0) if parts else np.full(self.count, np.nan)

    def warm(self, series: Float[np.ndarray, " frames"]) -> Float[np.ndarray, " kept"]:
        """A series of all frames from t0 on, without the first, in which things are compiled and filled."""
        moving = series[self.start :]
        return moving[WARM_UP:] if len(moving) > 2 * WARM_UP else moving


def glass_truth_view(
    truth: Trajectory,
    pose: Float[np.ndarray, "all_frames 3"],
    camera: Camera,
    like: GlassTwinView,
) -> GlassTwinView:
    """The truth of a lab clip at the frames of a run, dressed like it.

    truth: at all frames of the clip; pose [m]: of its vessel in the room; camera: the one that filmed.

    Raises: DataError where the truth does not reach to the last frame.
    """
    last = int(like.frames.max(initial=0))
    if last >= truth.frames:
        raise DataError(
            f"The truth {truth.name} has {truth.frames} frames, but the run {like.name} goes on to frame {last}; take "
            "the truth of the same clip."
        )
    rows = like.frames[like.start :]
    positions = truth.fields["position"][rows]
    return GlassTwinView(
        name="truth",
        body=truth.body,
        camera=camera,
        wall=like.wall,
        floor=like.floor,
        start=like.start,
        frames=like.frames,
        times=like.times,
        origin=pose[like.frames],
        positions=positions,
        places=like.places,
        level=np.stack([surface_heights(truth.body, places, like.places) for places in positions]),
        fields={k: v[rows] for k, v in truth.fields.items() if k != "position"},
        phases=like.phases,
        account={k: v[rows] for k, v in truth.ledger.items()},
        source=like.source,
    )
