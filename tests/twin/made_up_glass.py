"""A run of a glass twin that nobody ran: a liquid sways by a formula, its twin is a little off, the open loop more."""

import numpy as np

from zsdt.perception.camera import Camera
from zsdt.scene import Liquid, VesselShape
from zsdt.trajectory import Body, Trajectory
from zsdt.twin.glass_view import GlassTwinView, glass_truth_view

START, FRAMES, FPS = 4, 24, 60.0
RADIUS, LEVEL, PITCH = 0.035, 0.05, 0.0055
OMEGA, DECAY = 2 * np.pi * 3.0, 2.5
VESSEL = VesselShape(heights=[0.0, 0.11], radii=[RADIUS, RADIUS])
FLOOR, WALL = 0.006, 0.0025
SIZE = (400, 640)


def camera():
    """In front of the glass, 12 cm above the table, looking 8 degrees down."""
    tilt = np.radians(8.0)
    axes = np.array([[1.0, 0.0, 0.0], [0.0, -np.sin(tilt), -np.cos(tilt)], [0.0, np.cos(tilt), -np.sin(tilt)]])
    matrix = np.array([[1400.0, 0.0, 319.5], [0.0, 1400.0, 199.5], [0.0, 0.0, 1.0]])
    return Camera(matrix, np.zeros(5), axes, -axes @ np.array([0.0, -0.6, 0.14]), SIZE[1], SIZE[0])


def lattice():
    """Particles at rest: a cubic lattice inside of the cylinder, up to the level."""
    steps = np.arange(-RADIUS + 0.5 * PITCH, RADIUS, PITCH)
    grid = np.stack(np.meshgrid(steps, steps, np.arange(0.5 * PITCH, LEVEL, PITCH), indexing="ij"), axis=-1)
    points = grid.reshape(-1, 3)
    return points[np.hypot(points[:, 0], points[:, 1]) < RADIUS - 0.4 * PITCH]


def swaying(amplitude=0.008, phase=0.0, decay=DECAY, frames=FRAMES, start=0):
    """Truth: columns that go up and down with x (the first mode of the surface), none before frame `start`."""
    points = lattice()
    times = np.arange(frames) / FPS
    after = np.maximum(times - times[start], 0.0)
    height = amplitude * np.exp(-decay * after) * np.cos(OMEGA * after + phase) * (np.arange(frames) >= start)
    share = 1.0 + height[:, None] * points[:, 0] / RADIUS / LEVEL
    position = np.repeat(points[None], frames, axis=0)
    position[..., 2] *= share
    velocity = np.gradient(position, times, axis=0)
    heat = np.repeat(1e-3 * after[:, None, None], len(points), axis=1)
    body = Body(
        points, np.zeros((0, 2), np.int64), np.zeros(len(points), bool), np.full(len(points), 1261.0 * PITCH**3),
        1 / FPS, PITCH, liquid=Liquid(), vessel=VESSEL,
    )  # fmt: skip
    fields = {"position": position, "velocity": velocity, "internal_energy": heat}
    return Trajectory(body, times, fields, np.zeros_like(position), {}, {"name": "sway"})


def places():
    """Columns of the profile, on the far wall."""
    x = np.linspace(-0.9, 0.9, 13) * RADIUS
    return np.stack([x, np.sqrt(RADIUS**2 - x**2)], axis=1)


def pose():
    """The vessel comes from the left and stands still from t0 on."""
    back = np.minimum(np.arange(FRAMES) - START, 0) * 0.005
    return np.stack([back, np.zeros(FRAMES), np.full(FRAMES, FLOOR)], axis=1)


def made_up_glass():
    """(closed loop, open loop, truth) on the same frames; two frames are dark, one never came."""
    truth = swaying(start=START)
    runs = []
    for name, amplitude, decay in (("closed loop", 0.0075, DECAY), ("open loop", 0.007, 3 * DECAY)):
        run = swaying(amplitude, phase=0.1, decay=decay, start=START)
        position = run.fields["position"][START:]
        height = position[:, :1, 2] * 0 + LEVEL
        own = height + places()[:, 0] / RADIUS * _sway(amplitude, 0.1, decay)[:, None]
        seen = height + places()[:, 0] / RADIUS * _sway(0.008, 0.0, DECAY)[:, None]
        faults = [""] * FRAMES
        if name == "closed loop":
            faults[START + 6 : START + 9] = ["dark", "dark", "missing"]
            seen[6:9] = np.nan
        spots = np.concatenate([np.broadcast_to(places(), (*seen.shape, 2)), seen[..., None]], axis=2)
        seen_px = camera().project((spots + pose()[-1]).reshape(-1, 3)).reshape(*seen.shape, 2)
        seen_px[np.isnan(seen)] = np.nan
        runs.append(
            GlassTwinView(
                name, run.body, camera(), WALL, FLOOR, START, np.arange(FRAMES), np.arange(FRAMES) / FPS, pose(),
                position, places(), own, {k: v[START:] for k, v in run.fields.items() if k != "position"},
                predicted_level=own + 1e-4, seen_level=seen, seen_px=seen_px,
                latency={"predict": np.full(FRAMES, 11.0), "segment": np.full(FRAMES, 9.0)}, faults=faults,
                account={"volume": np.full(FRAMES - START, 1.9e-4), "kinetic": np.exp(-np.arange(FRAMES - START))},
                source="virtual lab", closed=name == "closed loop",
            )
        )  # fmt: skip
    return *runs, glass_truth_view(truth, pose(), camera(), runs[0])


def _sway(amplitude, phase, decay):
    times = np.arange(FRAMES - START) / FPS
    return amplitude * np.exp(-decay * times) * np.cos(OMEGA * times + phase)


def picture(number=0):
    """A room that is lighter above than below, with a table."""
    image = np.full((*SIZE, 3), (150, 165, 175), np.uint8)
    image[250:] = (70, 95, 120)
    image[:, ::40] = (130, 140, 150)
    return image
