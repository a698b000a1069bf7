"""Beams that swing under a load that nobody tells the twin, and how a camera would see their nodes."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from zsdt.perception.camera import Camera, ClampSide
from zsdt.perception.grid_graph import GridGraph
from zsdt.perception.video import VideoFrame
from zsdt.scene import Foam
from zsdt.tignn.cell_energy import CellOptions, nominal_constants
from zsdt.tignn.cell_engine import CellEngine
from zsdt.trajectory import Body
from zsdt.twin.beam_graph import beam_body, build_beam_graph, front_nodes_of
from zsdt.twin.beam_twin import BeamTwin
from zsdt.twin.observation import Observation
from zsdt.twin.twin_scene import BeamTwinScene

FPS = 60.0
SIDE = ClampSide.left


def scene_of(width=0.1, material=None, **more):
    return BeamTwinScene(width=width, material=material or Foam(), fps=FPS, depth=1.0, **more)


def camera_of(length, width, side=SIDE, **more):
    look_at = (length / 2, 0.0)
    return Camera.facing(
        distance=1.0, look_at=look_at, focal=800.0, beam_width=width, clamp_side=side, size=(640, 480), **more
    )


def cell_engine(material=None):
    """The sub-step form with the material's own constants: nothing is trained."""
    material = material or Foam()
    card = (material.bulk, material.shear, material.g1, material.tau)
    constants = replace(nominal_constants(*card), card=card)
    return CellEngine(constants, CellOptions())


@dataclass
class Clip:
    """What happened: position, stress [frames, nodes, ...]; and what is seen: pixels [frames, columns, rows, 2]."""

    body: Body
    position: np.ndarray
    stress: np.ndarray
    front: np.ndarray
    pixels: np.ndarray
    camera: Camera
    load: np.ndarray

    @property
    def frames(self):
        return len(self.position)

    @property
    def free(self):
        return ~self.body.clamped

    def grid(self, noise=0.0, seed=0):
        """The grid of the first picture with `noise` px."""
        pixels = self.pixels[0] + noise * np.random.default_rng(seed).standard_normal(self.pixels[0].shape)
        found = np.ones(pixels.shape[:2], bool)
        columns, rows = found.shape
        links = np.ones((columns - 1) * rows + columns * (rows - 1), bool)
        return GridGraph(pixels, found, SIDE, 40.0, 0.01, links)

    def tracked(self, noise=0.0, first=0.0, seed=0):
        """Pixels [frames, points, 2] of a tracker with `noise` px in each frame, that began on `grid(first)`."""
        flat = self.pixels.reshape(self.frames, -1, 2)
        flat = flat + (self.grid(first).pixels - self.pixels[0]).reshape(-1, 2)
        return flat + noise * np.random.default_rng([7, seed]).standard_normal(flat.shape)


def tip_force(body, total):
    """Force [N] spread over the tip, as [nodes, 3]."""
    tip = body.points[:, 0] > body.points[:, 0].max() - 1e-9
    return np.where(tip[:, None], np.asarray(total) / tip.sum(), 0.0)


def hold_and_release(times, rise=0.3, hold=0.6, fall=0.05):
    """Factor over time: up, hold, and gone at once."""
    up = np.clip(times / rise, 0, 1)
    down = np.clip((times - rise - hold) / fall, 0, 1)
    return 0.5 * (1 - np.cos(np.pi * up)) * 0.5 * (1 + np.cos(np.pi * down))


def cell_clip(columns=7, rows=3, width=0.1, frames=90, material=None, peak=(0.0, 0.0, -0.25), history=None):
    """Truth by the sub-step form with a material of its own (what the twin is told is up to the test)."""
    material = material or Foam()
    body = beam_body(columns, rows, scene_of(width, material), FPS)
    engine = cell_engine(material)
    engine.prepare(body)
    force = tip_force(body, peak)
    course = (history or hold_and_release)(np.arange(frames) / FPS)
    zero = np.zeros_like(body.points)
    state = engine.start({"position": body.points.copy(), "velocity": zero}, force * course[0])
    state.offset[:] = 0.0
    read = [engine.read(state)]
    for k in range(1, frames):
        state = engine.step(state, force * course[k - 1], force * course[k])
        read.append(engine.read(state))
    position, stress = np.stack([r["position"] for r in read]), np.stack([r["stress"] for r in read])
    return clip_of(body, position, stress, force * course[:, None, None])


def clip_of(body, position, stress, load, side=SIDE):
    front = front_nodes_of(body, side)
    camera = camera_of(float(np.ptp(body.points[:, 0])), float(np.ptp(body.points[:, 1])), side)
    pixels = np.stack([camera.project(p[front.ravel()]).reshape(*front.shape, 2) for p in position])
    return Clip(body, position, stress, front, pixels, camera, load)


def twin_on(clip, options, material=None, noise=0.0, engine=None, psi_ini=None, planar=True):
    """A twin that was told `material` (nominal by default) and has begun."""
    width = float(np.ptp(clip.body.points[:, 1]))
    scene = scene_of(width, material, planar=planar)
    graph = build_beam_graph(clip.grid(noise), clip.camera, scene, FPS)
    twin = BeamTwin(
        engine or cell_engine(), psi_ini, graph.body, graph.front_nodes, graph.camera, options, planar=planar
    )
    seen = np.ones(graph.front_nodes.size, bool)
    pixels = clip.grid(noise).pixels.reshape(-1, 2)
    twin.begin(Observation(0, 0.0, pixels, seen, graph.positions.reshape(-1, 3)))
    return twin


def follow(twin, clip, tracked=None, fault=None, closed=True):
    """Runs the twin over the clip; position and stress over the frames.

    fault(frame, pixels, seen) -> (pixels, seen) or None for a frame that is not there.
    """
    position, stress = [twin.position], [twin.fields(["stress"])["stress"]]
    everything = np.ones(clip.front.size, bool)
    for k in range(1, clip.frames):
        twin.predict()
        seen = (tracked[k], everything) if tracked is not None else None
        if fault is not None:
            seen = fault(k, tracked[k].copy(), everything.copy())
        if closed and seen is not None:
            twin.correct(twin.observe(*seen, k, k / FPS))
        position.append(twin.position)
        stress.append(twin.fields(["stress"])["stress"])
    return np.stack(position), np.stack(stress)


def rms(values):
    return float(np.sqrt((values**2).sum(-1).mean()))


class DrawnVideo:
    """A source whose pictures show nothing but a flat grey and their number; the grid is in `DrawnSegmenter`."""

    name = "drawn"
    fps = FPS
    size = (640, 480)

    def __init__(self, frames, lost=()):
        self.count, self.missing = frames, list(lost)

    def __iter__(self):
        image = np.full((480, 640, 3), 128, np.uint8)
        for index in range(self.count):
            if index not in self.missing:
                image[0, 0, :2] = index % 256, index // 256  # what `KnowingTracker` reads
                yield VideoFrame(index, index / FPS, image)


class DrawnSegmenter:
    """Probability of grid lines, drawn with the exact pixels of the first frame."""

    def __init__(self, clip):
        self.pixels = clip.pixels[0]

    def probability(self, image):
        canvas = np.zeros(image.shape[:2], np.uint8)
        lines = [*self.pixels, *self.pixels.swapaxes(0, 1)]
        fixed = [np.rint(line * 16).astype(np.int32) for line in lines]
        cv2.polylines(canvas, fixed, False, 255, 5, cv2.LINE_AA, 4)
        return canvas.astype(np.float32) / 255


@dataclass
class Seen:
    """What `GridTracker` says of a frame."""

    pixels: np.ndarray
    seen: np.ndarray
    quality: str = "good"


class KnowingTracker:
    """A tracker that knows the true pixels of each frame; `faults`: frame -> quality, or a function of pixels, seen."""

    def __init__(self, tracked, faults=None, lost=()):
        self.tracked, self.faults, self.lost = tracked, faults or {}, lost
        self.frame, self.calls = 0, 0

    def start(self, image, pixels, edges):
        self.offset = pixels - self.tracked[0]

    def track(self, image, predicted=None):
        self.calls += 1
        self.frame = self.frame + 1 if image is None else int(image[0, 0, 0]) + 256 * int(image[0, 0, 1])
        pixels, seen = self.tracked[self.frame] + self.offset, np.ones(len(self.offset), bool)
        fault = "missing" if image is None else self.faults.get(self.frame)
        if callable(fault):
            return Seen(*fault(pixels.copy(), seen))
        if fault:
            return Seen(np.array(predicted), ~seen, fault)
        return Seen(pixels, seen)
