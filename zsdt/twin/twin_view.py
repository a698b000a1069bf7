"""What a run of a twin on a clip shows to people, as plain arrays: overlay, recording and plots read nothing else.

A `TwinView` is a twin's own run (closed or open loop) or, in the virtual lab, the truth in the same dress
(`truth_view`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from zsdt.errors import DataError
from zsdt.fields import von_mises
from zsdt.perception.camera import Camera
from zsdt.trajectory import Body, Trajectory
from zsdt.twin.field_scale import ShownName
from zsdt.twin.trust import TrustSeries

WAITING = ("capture",)  # parts of the latency that are the source's and not the twin's
WARM_UP = 5  # frames
_NEEDED: dict[str, str] = {
    ShownName.speed: "velocity",
    ShownName.von_mises: "stress",
    ShownName.axial_stress: "stress",
}  # shown field -> field of the state that it is made of


@dataclass
class TwinView:
    """A run over `frames` frames of a clip.

    name: of the side, such as ``closed loop``. body: of the twin; front [columns, rows]: its nodes on the visible
    face, from the clamp and from below. camera: as the twin knows it. frames [frames]: numbers in the clip, times
    [frames] s. positions [frames, nodes, 3] m. fields: name -> [frames, nodes, components] SI, those that were decoded
    (velocity, stress). seen [frames, columns, rows]: nodes that the camera found. innovation [frames, columns, rows] m:
    how far the observed place was from the predicted one, NaN where nothing was observed. latency: part -> [frames] ms.
    faults [frames]: why a frame was not used, empty where it was. account: name -> [frames] J, the twin's energy
    account. rest [nodes, 3] m: the body without load, where the twin's clamp is; its reference points if not given.
    source: what the pictures are, such as ``virtual lab``. closed: whether the twin was corrected. trust: what was
    thought of each frame, None for the truth and where it was switched off.
    """

    name: str
    body: Body
    front: Int[np.ndarray, "columns rows"]
    camera: Camera
    frames: Int[np.ndarray, " frames"]
    times: Float[np.ndarray, " frames"]
    positions: Float[np.ndarray, "frames nodes 3"]
    fields: dict[str, Float[np.ndarray, "frames nodes _"]] = field(default_factory=dict)
    seen: Bool[np.ndarray, "frames columns rows"] | None = None
    innovation: Float[np.ndarray, "frames columns rows"] | None = None
    latency: Mapping[str, Float[np.ndarray, " frames"]] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    account: Mapping[str, Float[np.ndarray, " frames"]] = field(default_factory=dict)
    rest: Float[np.ndarray, "nodes 3"] | None = None
    source: str = ""
    closed: bool = True
    trust: TrustSeries | None = None

    def __post_init__(self) -> None:
        count = len(self.frames)
        self.faults = self.faults or [""] * count
        series: dict[str, Any] = {
            "times": self.times,
            "positions": self.positions,
            **self.fields,
            **self.latency,
            **self.account,
        }
        series["faults"] = self.faults
        for name, values in series.items():
            if len(values) != count:
                raise DataError(f"{name} of the run {self.name} has {len(values)} frames instead of {count}.")
        shape = (count, *self.front.shape)
        if self.seen is None:
            self.seen = np.ones(shape, bool)
        if self.innovation is None:
            self.innovation = np.full(shape, np.nan)
        if self.rest is None:
            self.rest = self.body.points

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self.frames)

    def on_front(self, values: Float[np.ndarray, "frames nodes *_"]) -> Float[np.ndarray, "frames columns rows *_"]:
        """Nodal values on the visible face."""
        return values[:, self.front]

    def pixels(self) -> Float[np.ndarray, "frames columns rows 2"]:
        """Where the twin's visible nodes are in the picture [px]; NaN behind the camera."""
        places = self.on_front(self.positions)
        return self.camera.project(places.reshape(-1, 3)).reshape(*places.shape[:3], 2)

    def rest_pixels(self) -> Float[np.ndarray, "columns rows 2"]:
        """The visible face without load in the picture [px]."""
        assert self.rest is not None
        return self.camera.project(self.rest[self.front].reshape(-1, 3)).reshape(*self.front.shape, 2)

    def shows(self, name: str) -> bool:
        """Whether what this field is made of was decoded."""
        return name not in _NEEDED or name in self.fields or _NEEDED[name] in self.fields

    def values(self, name: str) -> Float[np.ndarray, "frames nodes"]:
        """A field that can be shown, at all nodes, in SI.

        innovation is 0 at nodes that are not on the visible face. Raises: DataError where the run has not decoded it.
        """
        assert self.rest is not None and self.innovation is not None
        if name == ShownName.displacement:
            return np.linalg.norm(self.positions - self.rest, axis=2)
        if name == ShownName.innovation:
            spread = np.zeros(self.positions.shape[:2])
            spread[:, self.front] = self.innovation
            return spread
        if name in self.fields:
            return self.fields[name][..., 0]
        if not self.shows(name):
            raise DataError(
                f"The run {self.name} has not decoded {_NEEDED[name]}, which {name} is made of; ask for it."
            )
        if name == ShownName.speed:
            return np.linalg.norm(self.fields["velocity"], axis=2)
        if name == ShownName.von_mises:
            return von_mises(self.fields["stress"])
        return self.fields["stress"][..., 0]

    def tip(self) -> Float[np.ndarray, "frames 2"]:
        """The middle of the free end of the visible face in the picture [px]."""
        return self.pixels()[:, -1].mean(axis=1)

    def milliseconds(self) -> Float[np.ndarray, " frames"]:
        """Sum of all parts of the latency [ms] but the waiting for a picture; NaN where none were measured."""
        parts = [values for name, values in self.latency.items() if name not in WAITING]
        return np.sum(np.nan_to_num(parts), axis=0) if parts else np.full(self.count, np.nan)

    def warm(self, series: Float[np.ndarray, " frames"]) -> Float[np.ndarray, " kept"]:
        """A series without the first frames, in which things are compiled and filled; all of a very short run."""
        return series[WARM_UP:] if self.count > 2 * WARM_UP else series

    def innovation_rms(self) -> Float[np.ndarray, " frames"]:
        """Root mean square of the innovation over the seen nodes [m]; NaN in frames without any."""
        assert self.innovation is not None
        squares = np.square(self.innovation.reshape(self.count, -1))
        known = np.isfinite(squares)
        return np.sqrt(
            np.where(known, squares, 0.0).sum(axis=1) / np.where(known.any(axis=1), known.sum(axis=1), np.nan)
        )


def truth_view(
    truth: Trajectory,
    like: TwinView,
    camera: Camera | None = None,
    front: Int[np.ndarray, "columns rows"] | None = None,
) -> TwinView:
    """The truth of a lab clip at the frames of a run, dressed like it.

    like: whose frames and source are taken. camera: the true one, that of the run if not given. front: of the
    truth's body; the same numbers as in the run if not given.

    Raises: DataError where the truth does not reach to the last frame.
    """
    if int(like.frames.max(initial=0)) >= truth.frames:
        raise DataError(
            f"The truth {truth.name} has {truth.frames} frames, but the run {like.name} goes on to frame "
            f"{int(like.frames.max())}; take the truth of the same clip."
        )
    fields = {k: v[like.frames] for k, v in truth.fields.items() if k != "position"}
    return TwinView(
        name="truth",
        body=truth.body,
        front=like.front if front is None else front,
        camera=camera or like.camera,
        frames=like.frames,
        times=like.times,
        positions=truth.fields["position"][like.frames],
        fields=fields,
        account={k: v[like.frames] for k, v in truth.ledger.items()},
        source=like.source,
    )
