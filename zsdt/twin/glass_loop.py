"""The loop of the glass twin over a video: watch, begin where the glass stops, predict, observe, correct.

    source = open_video("clip.mp4")
    log = run_glass_twin(source, load_glass_segmenter(folder), GlassTwinScene(), GlassTwinOptions(),
                         camera=load_camera("camera.json"), engine=load_engine(folder), psi_ini=load(folder))

Glass and liquid are segmented in every frame. t0, the moment the vessel has come to rest, is only certain a few frames
later: these frames are kept, the twin begins at t0 and is run through what they showed. Prediction needs only the last
state and segmentation only the new picture, so they run beside each other, each on a core. With several glasses in
view the largest is followed. A frame that is missing, dark, frozen, blurred, covered or late is predicted over and
named in the log; a vessel that is moved again pushes its liquid by inertia. `sink` is called with every `GlassRecord`
as it comes and the picture (None for a frame that never came).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from zsdt.errors import OptionError
from zsdt.perception.camera import Camera
from zsdt.perception.free_surface import SurfaceOptions
from zsdt.perception.glass_segmentation import GlassSegmenter
from zsdt.perception.region_of_interest import RegionOptions
from zsdt.perception.vessel_track import Motion, RestOptions
from zsdt.perception.video import FrameSource, VideoFrame
from zsdt.tignn.engine import Engine
from zsdt.tignn.sleep import Sleeper
from zsdt.twin.glass_graph import GlassGraphOptions
from zsdt.twin.glass_log import GlassFrame, GlassRecord, GlassStatus, GlassTwinLog, gather
from zsdt.twin.glass_scene import GlassTwinScene
from zsdt.twin.glass_start import Beginning, SightedProfile, begin_glass, no_beginning
from zsdt.twin.glass_watch import GlassWatch, Sighting
from zsdt.twin.liquid_assimilation import LiquidAssimilationOptions
from zsdt.twin.liquid_history import FirstState
from zsdt.twin.loop_common import Clock, Image, LoopMode, LoopOptions, missed_frames
from zsdt.twin.trust import TrustMonitor, limits_of

log = logging.getLogger(__name__)

HARDEST = 30.0  # m/s2: accelerations of a vessel beyond this are wrong
NOWHERE = np.full(3, np.nan)
AT_EASE = (
    GlassStatus.corrected,
    GlassStatus.open_loop,
    GlassStatus.unlooked,
)  # frames in which a liquid may fall asleep

Sink = Callable[[GlassRecord, Image | None], None]


@dataclass
class GlassTwinOptions(LoopOptions):
    """The loop of the glass; see `LoopOptions`, too. beside: predicts on a thread of its own while the next picture is
    segmented. still_start: a glass that stands from the first frame on is taken for one with liquid at rest after so
    many frames (0: never; the twin waits until it has been moved). first_state: where the velocity at t0 comes from."""

    beside: bool = True
    still_start: int = 0
    first_state: FirstState = FirstState.history
    assimilation: LiquidAssimilationOptions = field(default_factory=LiquidAssimilationOptions)
    region: RegionOptions = field(default_factory=RegionOptions)
    rest: RestOptions = field(default_factory=RestOptions)
    surface: SurfaceOptions = field(default_factory=SurfaceOptions)
    graph: GlassGraphOptions = field(default_factory=GlassGraphOptions)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.still_start < 0:
            raise OptionError("still_start counts frames; it cannot be negative.")


def run_glass_twin(
    source: FrameSource,
    segmenter: GlassSegmenter,
    scene: GlassTwinScene,
    options: GlassTwinOptions | None = None,
    *,
    camera: Camera,
    engine: Engine,
    psi_ini: Any | None = None,
    sink: Sink | None = None,
    clock: Clock | None = None,
) -> GlassTwinLog:
    """Runs the twin over a video; see the module for a call.

    psi_ini: anything with ``infer_fields(body, positions)``, None for a liquid that is at rest at t0.

    Raises: DataError where no glass is seen, it is empty or it never comes to rest; RunRejected where no liquid of
    particles can be made of it.
    """
    run = _Run(source, segmenter, scene, options or GlassTwinOptions(), camera, engine, psi_ini, sink, clock or Clock())
    try:
        frames = iter(source)
        while not run.options.frames or len(run.records) < run.options.frames:
            began = run.clock.now()
            frame = next(frames, None)
            if frame is None:
                break
            run.take(frame, 1e3 * (run.clock.now() - began))
        return run.log()
    finally:
        run.close()


class _Run:
    """State of `run_glass_twin`."""

    def __init__(
        self,
        source: FrameSource,
        segmenter: GlassSegmenter,
        scene: GlassTwinScene,
        options: GlassTwinOptions,
        camera: Camera,
        engine: Engine,
        psi_ini: Any | None,
        sink: Sink | None,
        clock: Clock,
    ):
        self.scene, self.options, self.camera = scene, options, camera
        self.engine, self.psi_ini, self.sink, self.clock = engine, psi_ini, sink, clock
        self.fps, self.name = scene.fps or source.fps, source.name
        self.closed = options.mode is LoopMode.closed
        self.looks = self.closed or options.watch
        self.watch = GlassWatch(segmenter, camera, options.region, options.rest)
        self.records: list[GlassRecord] = []
        self.sightings: list[Sighting] = []
        self.begun: Beginning | None = None
        self.sleeper = Sleeper(options.sleep, 1.0 / self.fps)
        self.start_row, self.restarts, self.last_time = 0, 0, float("nan")
        self.told_speed = 0.0  # of the vessel [m/s] since t0
        self.ahead: Future[float] | None = None
        self.monitor: TrustMonitor | None = None
        self.pool = ThreadPoolExecutor(1) if options.beside else None

    def close(self) -> None:
        """Ends the thread."""
        if self.pool is not None:
            self.pool.shutdown(wait=True)

    # ---- every frame ------------------------------------------------------------------------------------------

    def take(self, frame: VideoFrame, capture_ms: float) -> None:
        """One frame of the video, and those that should have come before it."""
        if not self.records:
            self.origin, self.last_time = self.clock.now() - frame.time, frame.time
        for missed in missed_frames(frame, self.last_time, self.fps):
            self._take_one(missed, None, {})
        self.last_time = frame.time
        self._take_one(frame, frame.image, {"capture": capture_ms})

    def _take_one(self, frame: VideoFrame, image: Image | None, milliseconds: dict[str, float]) -> None:
        now = self.clock.now
        if self.options.realtime and image is not None and now() - self.origin < frame.time:
            self.clock.wait(frame.time - (now() - self.origin))
        came = now()
        late = self.begun is not None and self._is_late(frame)
        if image is None:
            sighting = Sighting(frame.index, frame.time, GlassStatus.missing, motion=self.watch.rest.state)
        elif self.begun is not None and (late or not self._looks_now()):
            fault = GlassStatus.deadline if late else GlassStatus.unlooked if self.looks else None
            sighting = Sighting(frame.index, frame.time, fault, motion=self.watch.rest.state)
        else:
            began = now()
            masks, fault = self.watch.segment(image, self._expected_motion())
            segmented = now()
            sighting = self.watch.read(frame.index, frame.time, masks, fault)
            milliseconds["segment"] = 1e3 * (segmented - began)
            milliseconds["observe"] = 1e3 * (now() - segmented)
        record = GlassRecord(
            frame.index, frame.time, self._waiting_status(sighting), self._origin(sighting), sighting.outline,
            milliseconds,
        )  # fmt: skip
        self.records.append(record)
        self.sightings.append(sighting)
        if self.begun is None:
            self._perhaps_begin()
        else:
            self._follow(record, sighting)
        record.whole = 1e3 * (now() - came)
        if self.sink is not None:
            self.sink(record, image)
        if record.liquid is not None and not self.options.keep_fields:
            record.liquid.fields = {}

    def _looks_now(self) -> bool:
        return self.looks and (len(self.records) - self.start_row) % self.options.look_every == 0

    def _is_late(self, frame: VideoFrame) -> bool:
        allowed = self.options.deadline or 1.0 / self.fps
        return self.options.realtime and self.clock.now() - self.origin - frame.time > allowed

    def _expected_motion(self) -> float:
        """By how many pixels the surface should have moved since the last frame."""
        if self.begun is None or self.records[-1].liquid is None:
            return 0.0
        levels = [r.liquid.level for r in self.records[-2:] if r.liquid is not None]
        return self.begun.px_per_m * float(np.abs(levels[-1] - levels[0]).max())

    def _waiting_status(self, sighting: Sighting) -> GlassStatus:
        """Status of a frame before t0."""
        if sighting.fault is not None:
            return sighting.fault
        if self.begun is None and not sighting.has_liquid:
            return GlassStatus.empty
        return GlassStatus.moving if sighting.motion is Motion.moving else GlassStatus.waiting

    def _origin(self, sighting: Sighting) -> np.ndarray:
        """Where the vessel is in the room [m]: where it was last seen while it is not seen."""
        if np.isfinite(sighting.x):
            offset = self.begun.offset if self.begun else 0.0
            return np.array([sighting.x + offset, 0.0, self.scene.floor])
        return self.records[-1].origin if self.begun and self.records else NOWHERE

    # ---- the beginning ----------------------------------------------------------------------------------------

    def _perhaps_begin(self) -> None:
        """Begins the twin at t0 where it is known by now, and runs it through the frames since then."""
        rest, options = self.watch.rest, self.options
        if rest.state is not Motion.rest or not self.sightings[-1].has_liquid:
            return
        if not rest.moved_before and not 0 < options.still_start <= len(rest.times):
            return
        assert rest.t0 is not None
        first = rest.t0 if rest.moved_before else self.sightings[-1].time
        row = next((k for k, s in enumerate(self.sightings) if s.time >= first - 1e-9 and s.has_liquid), None)
        if row is None:
            return
        self.begun = begin_glass(
            self.sightings, row, self.watch.rest, self.camera, self.scene, self.fps, self.engine, self.psi_ini,
            options, self.clock,
        )  # fmt: skip
        self.start_row = row
        if options.trust:
            self.monitor = TrustMonitor(limits_of(self.engine), self.begun.twin.body, alone=not self.closed)
        began = self.clock.now()
        if self.closed:
            self.begun.twin.look_back([self._seen_since(s) for s in self.sightings[row:]])
        for k in range(row, len(self.records)):
            record, sighting = self.records[k], self.sightings[k]
            record.origin = self._origin(sighting) if k == row else record.origin
            if k == row:
                record.status = GlassStatus.started
                self._keep(record, sighting, None, self.begun.surface())
            else:
                self._follow(record, sighting, alone=True)
        self.begun.start_ms["catch_up"] = 1e3 * (self.clock.now() - began)
        self._predict_ahead()

    def _seen_since(self, sighting: Sighting) -> SightedProfile | None:
        """The surface in a frame since t0."""
        assert self.begun is not None
        if not sighting.has_liquid or sighting.edges is None:
            return None
        return self.begun.thinned(self.begun.observe(sighting.edges, float(self._origin(sighting)[0])))

    # ---- with particles ---------------------------------------------------------------------------------------

    def _predict(self) -> float:
        """Runs the twin to the next frame; how long that took [ms]."""
        assert self.begun is not None
        began = self.clock.now()
        self.begun.twin.predict(self._acceleration())
        return 1e3 * (self.clock.now() - began)

    def _predict_ahead(self) -> None:
        """Begins with the next frame's prediction, beside whatever comes."""
        if self.pool is not None:
            self.ahead = self.pool.submit(self._predict)

    def _acceleration(self) -> np.ndarray | None:
        """Of a vessel that is moved again [m/s2]: what brings the velocity that the twin was told to the one seen.

        What a frame told too late or too little the next one makes good, so that a stop takes back all that the start
        gave."""
        recent = [s for s in self.sightings[-3 * self.options.look_every :] if s.fault is not GlassStatus.unlooked][-3:]
        x, t = np.array([s.x for s in recent]), np.array([s.time for s in recent])
        if len(recent) < 3 or not np.isfinite(x).all():
            return None
        seen, stop = 0.0, self.watch.rest.stop
        away = stop is not None and abs(x[2] - stop.place) > 3.0 * self.options.rest.still
        if away or recent[-1].motion is Motion.moving:
            before, last = np.diff(x) / np.diff(t)
            seen = last + 0.5 * (last - before)  # now, not in the middle of the last frame
        along = float(np.clip((seen - self.told_speed) * self.fps, -HARDEST, HARDEST))
        self.told_speed += along / self.fps
        return np.array([along, 0.0, 0.0])

    def _follow(self, record: GlassRecord, sighting: Sighting, alone: bool = False) -> None:
        """A frame after t0. alone: not prepared ahead."""
        assert self.begun is not None
        now, begun = self.clock.now, self.begun
        if self.ahead is not None and not alone:
            record.milliseconds["predict"], self.ahead = self.ahead.result(), None
        elif not self._sleeps_on(sighting):
            record.milliseconds["predict"] = self._predict()
        record.origin = self._origin(sighting)
        predicted = begun.surface()
        status, profile, innovation = sighting.fault or GlassStatus.open_loop, None, None
        if sighting.edges is not None:
            began = now()
            profile = begun.observe(sighting.edges, float(record.origin[0]))
            observed = now()
            if not sighting.has_liquid:
                status = GlassStatus.empty
            elif not profile.known:
                status = GlassStatus.occluded
            elif self.sleeper.asleep and self._is_seen_asleep(begun.thinned(profile), record):
                status, innovation = GlassStatus.asleep, begun.twin.compare(begun.thinned(profile))
            elif self.closed:
                innovation = begun.twin.correct(begun.thinned(profile))
                status = GlassStatus.corrected if innovation.taken.any() else GlassStatus.occluded
                status = GlassStatus.rejected if innovation.rejected else status
                if sighting.motion is Motion.moving and status is GlassStatus.corrected and not alone:
                    status = GlassStatus.moved
            else:
                innovation = begun.twin.compare(begun.thinned(profile))
            record.milliseconds["observe"] = record.milliseconds.get("observe", 0.0) + 1e3 * (observed - began)
            record.milliseconds["correct"] = 1e3 * (now() - observed)
        if begun.twin.restarts > self.restarts:
            status, self.restarts = GlassStatus.restarted, begun.twin.restarts
        record.status = status
        distance = None if innovation is None else innovation.distance
        if status in AT_EASE and not alone and self.sleeper.note(begun.twin.position, distance):
            begun.twin.rest()
        self._keep(record, sighting, innovation, predicted, profile)
        if not alone and not self.sleeper.asleep:
            self._predict_ahead()

    def _sleeps_on(self, sighting: Sighting) -> bool:
        """Whether the liquid sleeps and its vessel stands."""
        if sighting.motion is Motion.moving:
            self.sleeper.wake()
        return self.sleeper.asleep

    def _is_seen_asleep(self, profile: SightedProfile, record: GlassRecord) -> bool:
        """Whether a sleeping liquid is seen where it sleeps; wakes it where not, and predicts this frame."""
        assert self.begun is not None
        if not self.sleeper.is_disturbed(self.begun.twin.compare(profile).distance):
            return True
        self.sleeper.wake()
        record.milliseconds["predict"] = self._predict()
        return False

    def _keep(
        self, record: GlassRecord, sighting: Sighting, innovation: Any, predicted: np.ndarray, profile: Any = None
    ) -> None:
        """Decodes what is wanted and keeps it."""
        assert self.begun is not None
        began, begun = self.clock.now(), self.begun
        if profile is None and sighting.edges is not None:
            profile = begun.observe(sighting.edges, float(record.origin[0]))
        seen, pixels = begun.along(profile, float(record.origin[0]))
        twin = begun.twin
        record.liquid = GlassFrame(
            twin.position.copy(), twin.fields(self.scene.fields), predicted, begun.surface(), seen, pixels, innovation,
            {**twin.account(), "volume": twin.volume_below()},
        )  # fmt: skip
        record.milliseconds["decode"] = 1e3 * (self.clock.now() - began)
        if self.monitor is not None:
            began, liquid = self.clock.now(), record.liquid
            liquid.trust = self.monitor.frame(
                liquid.position, twin.state.velocity, account=liquid.account, second=twin.pressure(), seen=innovation,
                doubt=twin.doubt if self.closed else math.nan, found={"viscosity_found": twin.viscosity},
                restarted=record.status is GlassStatus.restarted,
            )  # fmt: skip
            record.milliseconds["trust"] = 1e3 * (self.clock.now() - began)

    def log(self) -> GlassTwinLog:
        """All records as arrays. Raises: DataError where the twin never began."""
        if self.begun is None:
            raise no_beginning(self.name, len(self.records), self.watch)
        if self.ahead is not None:
            self.ahead.result()
        about = {
            "name": self.name,
            "mode": self.options.mode.value,
            "method": self.options.assimilation.method.value,
            "body": self.begun.twin.body,
            "camera": self.begun.fit.camera,
            "wall": self.scene.wall,
            "floor": self.scene.floor,
            "places": self.begun.places,
            "start_ms": self.begun.start_ms,
            "fit": {**self.begun.fit.notes, "other_glasses": float(max(s.others for s in self.sightings))},
        }
        return gather(self.records, self.start_row, about, self.options.keep_fields)
