"""What a run of the twin leaves behind, frame by frame, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float, Int

from zsdt.perception.camera import Camera
from zsdt.tignn.engine import NodeField
from zsdt.trajectory import Body
from zsdt.twin.beam_twin import Innovation
from zsdt.twin.loop_common import latency_table
from zsdt.twin.trust import TrustReading, TrustSeries

PARTS = ("capture", "predict", "track", "correct", "decode", "trust")


class FrameStatus(StrEnum):
    """What was done with a frame. unlooked: predicted between two looks, as `look_every` wants it. asleep: at rest and
    seen where it was. All but `started`, `corrected`, `open_loop`, `unlooked` and `asleep` are faults over which the
    twin predicted on; the names after `occluded` are those of the tracker (`FrameQuality`)."""

    started = "started"
    corrected = "corrected"
    open_loop = "open_loop"
    unlooked = "unlooked"
    asleep = "asleep"
    deadline = "deadline"
    restarted = "restarted"
    occluded = "occluded"
    missing = "missing"
    dark = "dark"
    bright = "bright"
    frozen = "frozen"
    blurred = "blurred"


_FINE = tuple(FrameStatus(s) for s in ("started", "corrected", "open_loop", "unlooked", "asleep"))
FAULTS = tuple(s for s in FrameStatus if s not in _FINE)


@dataclass
class FrameRecord:
    """One frame of a run. predicted_px, observed_px [front, 2] (NaN where not seen); seen [front]; milliseconds: part
    -> ms; fields: the decoded ones; trust: whether the frame can be believed, None where nobody asked."""

    index: int
    time: float
    status: FrameStatus
    position: Float[np.ndarray, "nodes 3"]
    fields: dict[str, NodeField]
    predicted_px: Float[np.ndarray, "front 2"]
    observed_px: Float[np.ndarray, "front 2"]
    seen: Bool[np.ndarray, " front"]
    innovation: Innovation | None
    milliseconds: dict[str, float]
    account: dict[str, float]
    trust: TrustReading | None = None


@dataclass
class TwinLog:
    """A run over `n` frames.

    frames [n]: numbers in the video; times [n] s; mode: closed or open; status [n]. positions [n, nodes, 3] m after the
    correction; fields: name -> [n, nodes, components] SI. predicted_px, observed_px [n, front, 2]; seen, taken [n,
    front]; innovation [n, front] m: between seen and predicted, NaN where not seen; load [n, 3] N: sum of the estimated
    load. latency: part -> [n] ms, start_ms: part -> ms of the first frame; account: name -> [n] J. body: with the
    calibrated material, whose Young's modulus is `stiffness` and density `density` times the told one; camera: in the
    axes of the body. trust: what was thought of each frame, None where it was switched off.
    """

    name: str
    mode: str
    body: Body
    front_nodes: Int[np.ndarray, "columns rows"]
    camera: Camera
    stiffness: float
    density: float
    frames: Int[np.ndarray, " n"]
    times: Float[np.ndarray, " n"]
    status: list[str]
    positions: Float[np.ndarray, "n nodes 3"]
    fields: dict[str, Float[np.ndarray, "n nodes components"]]
    predicted_px: Float[np.ndarray, "n front 2"]
    observed_px: Float[np.ndarray, "n front 2"]
    seen: Bool[np.ndarray, "n front"]
    taken: Bool[np.ndarray, "n front"]
    innovation: Float[np.ndarray, "n front"]
    load: Float[np.ndarray, "n 3"]
    latency: dict[str, Float[np.ndarray, " n"]]
    account: dict[str, Float[np.ndarray, " n"]]
    start_ms: dict[str, float] = field(default_factory=dict)
    trust: TrustSeries | None = None

    @property
    def count(self) -> int:
        """Number of frames, those that never came included."""
        return len(self.frames)

    def latency_table(self, skip: int = 5) -> dict[str, dict[str, float]]:
        """Part -> p50, p95, p99 and most [ms] of the frames after the first `skip`; `total` is without `capture`."""
        return latency_table(self.latency, skip)

    def dissipated_power(self) -> Float[np.ndarray, " n"]:
        """Power that turned into heat [W]: entropy production times temperature; the first frame has none."""
        heat = self.account.get("dissipated", np.zeros(self.count))
        steps = np.maximum(np.diff(self.times), 1e-9)
        return np.concatenate([[0.0], np.diff(heat) / steps])

    def faults(self) -> dict[str, int]:
        """Number of frames of each fault."""
        return {f.value: self.status.count(f.value) for f in FAULTS if f.value in self.status}


def gather(records: list[FrameRecord], about: dict, keep_fields: bool) -> TwinLog:
    """Arrays from the records of a run; `about`: what does not change (name, mode, body, ...)."""
    front = len(records[0].seen)
    unknown, nobody = np.full(front, np.nan), np.zeros(front, bool)
    innovations = [r.innovation for r in records]
    loads = [np.zeros(3) if i is None or i.load is None else i.load for i in innovations]
    names = records[0].fields if keep_fields else {}
    return TwinLog(
        **about,
        frames=np.array([r.index for r in records]),
        times=np.array([r.time for r in records]),
        status=[r.status.value for r in records],
        positions=np.stack([r.position for r in records]),
        fields={name: np.stack([r.fields[name] for r in records]) for name in names},
        predicted_px=np.stack([r.predicted_px for r in records]),
        observed_px=np.stack([r.observed_px for r in records]),
        seen=np.stack([r.seen for r in records]),
        taken=np.stack([nobody if i is None else i.taken for i in innovations]),
        innovation=np.stack([unknown if i is None else i.distance for i in innovations]),
        load=np.stack(loads),
        latency={p: np.array([r.milliseconds.get(p, np.nan) for r in records]) for p in PARTS},
        account={name: np.array([r.account[name] for r in records]) for name in records[0].account},
        trust=None if records[0].trust is None else TrustSeries.of([r.trust for r in records]),
    )
