"""The loop of the beam twin over a video: predict, observe, correct, and nothing that the scene does not need.

    source = open_video("clip.mp4")
    log = run_twin(source, load_segmenter(folder), scene, TwinOptions(),
                   camera=load_camera("camera.json"), engine=load_engine(folder), psi_ini=load(folder))

The grid is segmented once, in the first picture that shows it; from then on its nodes are tracked. Fields are decoded
only if the scene asks for them. A frame that is missing, dark, frozen, blurred, occluded or late is predicted over and
named in the log. `sink` is called with every `FrameRecord` and the picture (None for a frame that never came).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from zsdt.errors import DataError, OptionError
from zsdt.perception.camera import Camera
from zsdt.perception.depth import DepthMaps
from zsdt.perception.grid_graph import GridGraph, GridOptions, extract_grid
from zsdt.perception.optical_flow import GridTracker, TrackerOptions
from zsdt.perception.segmentation import Segmenter
from zsdt.perception.video import FrameSource, VideoFrame
from zsdt.tignn.engine import Engine
from zsdt.tignn.sleep import Sleeper, come_to_rest
from zsdt.twin.assimilation import AssimilationOptions
from zsdt.twin.beam_graph import BeamGraph, build_beam_graph, thinned
from zsdt.twin.beam_twin import BeamTwin, Innovation
from zsdt.twin.loop_common import Clock, Image, LoopMode, LoopOptions, missed_frames
from zsdt.twin.observation import Observation
from zsdt.twin.trust import TrustMonitor, limits_of
from zsdt.twin.twin_log import FrameRecord, FrameStatus, TwinLog, gather
from zsdt.twin.twin_scene import BeamTwinScene

__all__ = ["Clock", "LoopMode", "LoopOptions", "TwinOptions", "run_twin"]

log = logging.getLogger(__name__)

FEWEST = 3  # points, below which a frame says nothing about a beam
AT_EASE = (FrameStatus.corrected, FrameStatus.open_loop, FrameStatus.unlooked)  # frames in which a body may fall asleep
Sink = Callable[[FrameRecord, Image | None], None]


@dataclass
class TwinOptions(LoopOptions):
    """The loop of the beam. search: pictures in which a grid is looked for before giving up; the rest as in
    `LoopOptions`."""

    search: int = 30
    assimilation: AssimilationOptions = field(default_factory=AssimilationOptions)
    tracker: TrackerOptions = field(default_factory=TrackerOptions)
    grid: GridOptions = field(default_factory=GridOptions)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.search < 1:
            raise OptionError("search must be at least 1.")


@runtime_checkable
class Tracks(Protocol):
    """What a tracker says of a frame: pixels [points, 2], seen [points], quality of the frame (`good` or a fault)."""

    pixels: Any
    seen: Any
    quality: Any


@runtime_checkable
class Tracker(Protocol):
    """Follows points of the first picture (see `zsdt.perception.optical_flow.GridTracker`)."""

    def start(self, image: Image, pixels: Float[np.ndarray, "points 2"], edges: Int[np.ndarray, "edges 2"]) -> None:
        """Learns the points of the first picture."""

    def track(self, image: Image | None, predicted: Float[np.ndarray, "points 2"] | None = None) -> Tracks:
        """Finds them in the next one, near where they are predicted; None for a frame that never came."""


def run_twin(
    source: FrameSource,
    segmenter: Segmenter,
    scene: BeamTwinScene,
    options: TwinOptions | None = None,
    *,
    camera: Camera,
    engine: Engine,
    psi_ini: Any | None = None,
    tracker: Tracker | None = None,
    depth_maps: DepthMaps | None = None,
    sink: Sink | None = None,
    clock: Clock | None = None,
) -> TwinLog:
    """Runs the twin over a video; see the module for a call.

    psi_ini: anything with ``infer_fields(body, positions)``, None for the engine's own stress at rest. tracker: a
    `GridTracker` by default.

    Raises: DataError where no picture shows a usable grid; RunRejected where the engine finds no rest.
    """
    options, clock = options or TwinOptions(), clock or Clock()
    fps = scene.fps or source.fps
    frames = iter(source)
    run = _Run(scene, options, camera, depth_maps, sink, clock, fps, source.name)
    follower: Any = tracker or GridTracker(options.tracker)
    run.start(frames, segmenter, engine, psi_ini, follower)
    while not options.frames or len(run.records) < options.frames:
        began = clock.now()
        frame = next(frames, None)
        if frame is None:
            break
        run.take(frame, 1e3 * (clock.now() - began))
    return run.log()


class _Run:
    """State of `run_twin`."""

    def __init__(
        self,
        scene: BeamTwinScene,
        options: TwinOptions,
        camera: Camera,
        depth_maps: DepthMaps | None,
        sink: Sink | None,
        clock: Clock,
        fps: float,
        name: str,
    ):
        self.scene, self.options, self.told_camera, self.depth_maps = scene, options, camera, depth_maps
        self.sink, self.clock, self.fps, self.name = sink, clock, fps, name
        self.closed = options.mode is LoopMode.closed
        self.looks = self.closed or options.watch
        self.records: list[FrameRecord] = []
        self.start_ms: dict[str, float] = {}
        self.restarts = 0

    # ---- the first frame --------------------------------------------------------------------------------------

    def start(
        self, frames: Iterator[VideoFrame], segmenter: Segmenter, engine: Engine, psi_ini: Any, tracker: Tracker
    ) -> None:
        """Looks for the grid, builds the body, begins the twin and the tracker."""
        frame, grid, graph = self._search(frames, segmenter)
        began = self.clock.now()
        self.graph, self.tracker = graph, tracker
        self.twin = BeamTwin(
            engine, psi_ini, graph.body, graph.front_nodes, graph.camera, self.options.assimilation,
            planar=self.scene.planar,
            roll_doubt=graph.roll_doubt,
        )  # fmt: skip
        pixels = np.ascontiguousarray(grid.pixels.reshape(-1, 2))
        positions = graph.positions.reshape(-1, 3)
        seen = np.isfinite(positions).all(axis=1)
        has_depth = self.depth_maps is not None
        self.twin.begin(Observation(frame.index, frame.time, pixels, seen, positions, has_depth))
        self.monitor = None
        if self.options.trust:
            found = {"stiffness_found": self.twin.stiffness, "density_found": self.twin.density}
            self.monitor = TrustMonitor(limits_of(engine), self.twin.body, found, not self.closed)
        self.start_ms["begin"] = 1e3 * (self.clock.now() - began)
        if self.looks:
            began = self.clock.now()
            tracker.start(frame.image, pixels, grid.edges)
            self.start_ms["tracker"] = 1e3 * (self.clock.now() - began)
        self.sleeper = Sleeper(self.options.sleep, 1.0 / self.fps)
        self.first, self.last_time = frame, frame.time
        self.origin = self.clock.now() - frame.time
        self._keep(frame, FrameStatus.started, np.where(seen[:, None], pixels, np.nan), seen, None, {})

    def _search(self, frames: Iterator[VideoFrame], segmenter: Segmenter) -> tuple[VideoFrame, GridGraph, BeamGraph]:
        """The first picture with a usable grid. Raises: DataError with the last reason where there is none."""
        reason: DataError | None = None
        for tried, frame in enumerate(frames, 1):
            depth_map = None if self.depth_maps is None else self.depth_maps.frame(frame.index)
            times = [self.clock.now()]
            try:
                probability = segmenter.probability(frame.image)
                times.append(self.clock.now())
                grid = thinned(extract_grid(probability, frame.image, self.options.grid), self.scene.stride)
                graph = build_beam_graph(grid, self.told_camera, self.scene, self.fps, depth_map)
            except DataError as error:
                reason = error
                log.info("Frame %d shows no usable grid: %s", frame.index, error)
                if tried >= self.options.search:
                    break
                continue
            times.append(self.clock.now())
            self.start_ms.update(segment=1e3 * (times[1] - times[0]), graph=1e3 * (times[2] - times[1]))
            return frame, grid, graph
        raise reason or DataError(f"{self.name} holds no frame; check the file.")

    # ---- every other frame ------------------------------------------------------------------------------------

    def take(self, frame: VideoFrame, capture_ms: float) -> None:
        """One frame of the video, and those that should have come before it."""
        for missed in missed_frames(frame, self.last_time, self.fps):
            self._take_one(missed, None, {})
        self.last_time = frame.time
        self._take_one(frame, frame.image, {"capture": capture_ms})

    def _take_one(self, frame: VideoFrame, image: Image | None, milliseconds: dict[str, float]) -> None:
        now = self.clock.now
        if self.options.realtime and image is not None and now() - self.origin < frame.time:
            self.clock.wait(frame.time - (now() - self.origin))
        began = now()
        if not self.sleeper.asleep:
            self.twin.predict()
            milliseconds["predict"] = 1e3 * (now() - began)
        pixels, seen, innovation = self._nothing()
        status = FrameStatus.open_loop
        if self.closed and self._is_late(frame):
            status = FrameStatus.deadline
        elif self.looks and len(self.records) % self.options.look_every:
            status, seen = FrameStatus.unlooked, self.records[-1].seen
            innovation = Innovation(
                np.full(len(seen), np.nan), np.zeros(len(seen), bool), load=self.twin.load.sum(axis=0)
            )
        elif self.looks:
            began = now()
            tracks = self.tracker.track(image, self.twin.predicted_pixels())
            milliseconds["track"] = 1e3 * (now() - began)
            began = now()
            status, pixels, seen, innovation = self._correct(frame, tracks)
            milliseconds["correct"] = 1e3 * (now() - began)
        distance = None if innovation is None else innovation.distance
        if status in AT_EASE and self.twin.is_cell and self.sleeper.note(self.twin.position, distance):
            self.twin.state = come_to_rest(self.twin.engine, self.twin.state)
        self._keep(frame, status, pixels, seen, innovation, milliseconds, image)

    def _nothing(self) -> tuple[Float[np.ndarray, "front 2"], Bool[np.ndarray, " front"], Innovation | None]:
        count = self.graph.front_nodes.size
        return np.full((count, 2), np.nan), np.zeros(count, bool), None

    def _is_late(self, frame: VideoFrame) -> bool:
        allowed = self.options.deadline or 1.0 / self.fps
        return self.options.realtime and self.clock.now() - self.origin - frame.time > allowed

    def _correct(
        self, frame: VideoFrame, tracks: Tracks
    ) -> tuple[FrameStatus, Float[np.ndarray, "front 2"], Bool[np.ndarray, " front"], Innovation | None]:
        """Gives the twin what was seen (in the closed loop), and says why where it was not."""
        quality = str(getattr(tracks.quality, "value", tracks.quality))
        depth_map = None if self.depth_maps is None else self.depth_maps.frame(frame.index)
        pixels = np.asarray(tracks.pixels, np.float64)
        observation = self.twin.observe(
            pixels, np.asarray(tracks.seen, bool), frame.index, frame.time, depth_map, self.scene.depth_maps
        )
        seen = observation.seen
        shown = np.where(seen[:, None], pixels, np.nan)
        if quality != "good":
            return FrameStatus(quality), shown, seen, None
        if seen.sum() < FEWEST:
            return FrameStatus.occluded, shown, seen, None
        if not self.closed:
            return FrameStatus.open_loop, shown, seen, self.twin.compare(observation)
        if self.sleeper.asleep:
            innovation = self.twin.compare(observation)
            if not self.sleeper.is_disturbed(innovation.distance):
                return FrameStatus.asleep, shown, seen, innovation
            self.sleeper.wake()
            self.twin.predict()
        innovation = self.twin.correct(observation)
        status = FrameStatus.corrected if innovation.taken.any() else FrameStatus.occluded
        if self.twin.restarts > self.restarts:
            status, self.restarts = FrameStatus.restarted, self.twin.restarts
        return status, shown, seen, innovation

    def _keep(
        self,
        frame: VideoFrame,
        status: FrameStatus,
        pixels: Float[np.ndarray, "front 2"],
        seen: Bool[np.ndarray, " front"],
        innovation: Innovation | None,
        milliseconds: dict[str, float],
        image: Image | None = None,
    ) -> None:
        """Decodes what is wanted, keeps the record and shows it to the sink."""
        began = self.clock.now()
        fields = self.twin.fields(self.scene.fields)
        milliseconds["decode"] = 1e3 * (self.clock.now() - began)
        record = FrameRecord(
            index=frame.index, time=frame.time, status=status, position=self.twin.position, fields=fields,
            predicted_px=self.twin.predicted_pixels(), observed_px=pixels, seen=seen,
            innovation=_of_whole_width(innovation, self.scene.copies), milliseconds=milliseconds,
            account={name: self.scene.copies * joules for name, joules in self.twin.account().items()},
        )  # fmt: skip
        if self.monitor is not None:
            began = self.clock.now()
            record.trust = self.monitor.frame(
                record.position, fields["velocity"] if "velocity" in fields else self.twin.velocity,  # noqa: SIM401  (dear)
                account=record.account, second=fields.get("stress"), seen=innovation,
                doubt=self.twin.doubt() if self.closed else math.nan,
                restarted=status is FrameStatus.restarted,
            )  # fmt: skip
            milliseconds["trust"] = 1e3 * (self.clock.now() - began)
        if self.sink is not None:
            self.sink(record, image if self.records else frame.image)
        if not self.options.keep_fields:
            record.fields = {}
        self.records.append(record)

    def log(self) -> TwinLog:
        """All records as arrays."""
        assert self.twin.camera is not None
        about = {
            "name": self.name,
            "mode": self.options.mode.value,
            "body": self.twin.body,
            "front_nodes": self.graph.front_nodes,
            "camera": self.twin.camera,
            "stiffness": self.twin.stiffness,
            "density": self.twin.density,
            "start_ms": self.start_ms,
        }
        return gather(self.records, about, self.options.keep_fields)


def _of_whole_width(innovation: Innovation | None, copies: float) -> Innovation | None:
    """Load and work of the whole beam where the graph is one of `copies` equal slices of it."""
    if innovation is None or copies == 1.0:
        return innovation
    load = None if innovation.load is None else copies * innovation.load
    return replace(innovation, load=load, work=copies * innovation.work)
