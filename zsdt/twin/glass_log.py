"""What a run of the glass twin leaves behind, frame by frame, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from zsdt.perception.camera import Camera
from zsdt.tignn.engine import NodeField
from zsdt.trajectory import Body
from zsdt.twin.loop_common import latency_table
from zsdt.twin.seen_surface import SurfaceInnovation
from zsdt.twin.trust import TrustReading, TrustSeries

GLASS_PARTS = ("capture", "predict", "segment", "observe", "correct", "decode", "trust")


class GlassStatus(StrEnum):
    """What was done with a frame.

    waiting: before t0, the glass stands, or has not been seen yet. moving: before t0, it moves. started: the frame of
    t0. corrected, open_loop: as the mode wants it. unlooked: predicted between two looks, as `look_every` wants it.
    asleep: at rest, and seen where it was.
    moved: corrected while the vessel is moved again. All others are faults over which the twin predicted on (or waited
    on): deadline: came too late; restarted: the engine gave up and began again from rest; occluded: too little of the
    surface was seen; rejected: what was seen is impossible; no_glass, empty: no glass or no liquid was seen; missing,
    dark, bright, frozen, blurred: see `FrameQuality`.
    """

    waiting = "waiting"
    moving = "moving"
    started = "started"
    corrected = "corrected"
    open_loop = "open_loop"
    unlooked = "unlooked"
    asleep = "asleep"
    moved = "moved"
    deadline = "deadline"
    restarted = "restarted"
    occluded = "occluded"
    rejected = "rejected"
    missing = "missing"
    dark = "dark"
    bright = "bright"
    frozen = "frozen"
    blurred = "blurred"
    no_glass = "no_glass"
    empty = "empty"


_FINE = ("waiting", "moving", "started", "corrected", "open_loop", "unlooked", "asleep", "moved")
GLASS_FAULTS = tuple(s for s in GlassStatus if s.value not in _FINE)


@dataclass
class GlassFrame:
    """One frame of a run with particles, all in the axes of the vessel.

    fields: the decoded ones; predicted_level, level [columns] m: of the twin before and after the correction;
    seen_level [columns] m and seen_px [columns, 2]: NaN where not seen; trust: whether the frame can be believed.
    """

    position: Float[np.ndarray, "nodes 3"]
    fields: dict[str, NodeField]
    predicted_level: Float[np.ndarray, " columns"]
    level: Float[np.ndarray, " columns"]
    seen_level: Float[np.ndarray, " columns"]
    seen_px: Float[np.ndarray, "columns 2"]
    innovation: SurfaceInnovation | None
    account: dict[str, float]
    trust: TrustReading | None = None


@dataclass
class GlassRecord:
    """One frame of a run. origin [3] m: of the vessel in the room, NaN where no glass was seen; outline [points, 2] px:
    of the seen liquid; milliseconds: part -> ms; whole [ms]: from the picture to the decoded fields, parts beside each
    other counted once; liquid: None before t0."""

    index: int
    time: float
    status: GlassStatus
    origin: Float[np.ndarray, "3"]
    outline: Float[np.ndarray, "_ 2"]
    milliseconds: dict[str, float] = field(default_factory=dict)
    whole: float = float("nan")
    liquid: GlassFrame | None = None


@dataclass
class GlassTwinLog:
    """A run over `n` frames, with particles in the last `m` of them: from row `start` on, which is t0.

    mode: closed or open; method: of the correction. body: the liquid at t0 in the axes of the vessel (origin: middle
    of the cavity's floor), `liquid` as told, `motion` as inferred. camera: the told one with its tilt mended; wall,
    floor [m]. frames [n]: numbers in the video; times [n] s; status [n]; origin [n, 3] m: of the vessel in the room,
    NaN where it was not seen.

    positions [m, nodes, 3] m (float32) after the correction; fields: name -> [m, nodes, components] SI (float32).
    places [columns, 2] m: where the surface's profile is told, on the wall that the camera sees; predicted_level,
    level, seen_level [m, columns] m: of the twin before and after the correction, and as observed (NaN where not);
    seen_px [m, columns, 2] px. taken [m]: share of the observed places that were believed; viscosity [m]: over the
    told one, as estimated; level_offset [m] m: by how much observed heights are thought to be off. outline: of the
    seen liquid, [points, 2] px for every frame.

    latency: part -> [n] ms, whole [n] ms; start_ms: part of the beginning -> ms. account: name -> [m] J, and `volume`
    [m3] below the twin's surface. fit: figures of the vessel's fit. trust: what was thought of the last m frames, None
    where it was switched off.
    """

    name: str
    mode: str
    method: str
    body: Body
    camera: Camera
    wall: float
    floor: float
    start: int
    frames: Int[np.ndarray, " n"]
    times: Float[np.ndarray, " n"]
    status: list[str]
    origin: Float[np.ndarray, "n 3"]
    positions: Float[np.ndarray, "m nodes 3"]
    fields: dict[str, Float[np.ndarray, "m nodes components"]]
    places: Float[np.ndarray, "columns 2"]
    predicted_level: Float[np.ndarray, "m columns"]
    level: Float[np.ndarray, "m columns"]
    seen_level: Float[np.ndarray, "m columns"]
    seen_px: Float[np.ndarray, "m columns 2"]
    taken: Float[np.ndarray, " m"]
    viscosity: Float[np.ndarray, " m"]
    level_offset: Float[np.ndarray, " m"]
    outline: list[Float[np.ndarray, "_ 2"]]
    latency: dict[str, Float[np.ndarray, " n"]]
    whole: Float[np.ndarray, " n"]
    account: dict[str, Float[np.ndarray, " m"]]
    start_ms: dict[str, float] = field(default_factory=dict)
    fit: dict[str, float] = field(default_factory=dict)
    trust: TrustSeries | None = None

    @property
    def count(self) -> int:
        """Number of frames, those that never came included."""
        return len(self.frames)

    @property
    def volume(self) -> Float[np.ndarray, " m"]:
        """Volume [m3] below the twin's surface."""
        return self.account["volume"]

    @property
    def innovation(self) -> Float[np.ndarray, "m columns"]:
        """Seen less predicted height [m], NaN where not seen."""
        return self.seen_level - self.predicted_level

    def latency_table(self, skip: int = 5) -> dict[str, dict[str, float]]:
        """Part -> p50, p95, p99 and most [ms] of the frames with particles after the first `skip`; `total` is from the
        picture to the decoded fields, with what runs beside each other counted once."""
        first = self.start + skip
        return latency_table(self.latency, first, self.whole)

    def faults(self) -> dict[str, int]:
        """Number of frames of each fault."""
        return {f.value: self.status.count(f.value) for f in GLASS_FAULTS if f.value in self.status}


def gather(records: list[GlassRecord], start: int, about: dict[str, Any], keep_fields: bool) -> GlassTwinLog:
    """Arrays from the records of a run, which has particles from row `start` on; `about`: what does not change."""
    liquids = [r.liquid for r in records[start:] if r.liquid is not None]
    innovations = [frame.innovation for frame in liquids]
    names = list(liquids[0].fields) if keep_fields else []
    return GlassTwinLog(
        **about,
        start=start,
        frames=np.array([r.index for r in records]),
        times=np.array([r.time for r in records]),
        status=[r.status.value for r in records],
        origin=np.stack([r.origin for r in records]),
        positions=np.stack([frame.position for frame in liquids]).astype(np.float32),
        fields={name: np.stack([f.fields[name] for f in liquids]).astype(np.float32) for name in names},
        predicted_level=np.stack([frame.predicted_level for frame in liquids]),
        level=np.stack([frame.level for frame in liquids]),
        seen_level=np.stack([frame.seen_level for frame in liquids]),
        seen_px=np.stack([frame.seen_px for frame in liquids]),
        taken=np.array([np.nan if i is None else _share(i.taken, np.isfinite(i.distance)) for i in innovations]),
        viscosity=_carried([None if i is None else i.viscosity for i in innovations], 1.0),
        level_offset=_carried([None if i is None else i.level for i in innovations], 0.0),
        outline=[r.outline for r in records],
        latency={p: np.array([r.milliseconds.get(p, np.nan) for r in records]) for p in GLASS_PARTS},
        whole=np.array([r.whole for r in records]),
        account={name: np.array([frame.account[name] for frame in liquids]) for name in liquids[0].account},
        trust=None if liquids[0].trust is None else TrustSeries.of([frame.trust for frame in liquids]),
    )


def _share(taken: Bool[np.ndarray, " places"], seen: Bool[np.ndarray, " places"]) -> float:
    return float(taken.sum()) / max(int(seen.sum()), 1)


def _carried(values: list[float | None], first: float) -> Float[np.ndarray, " m"]:
    """Values with the last known one where there is none."""
    found, last = [], first
    for value in values:
        last = last if value is None else value
        found.append(last)
    return np.array(found)
