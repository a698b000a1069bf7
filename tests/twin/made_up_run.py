"""A run of a twin that nobody ran: a beam that swings by a formula, its twin a little off, the open loop more."""

import numpy as np

from tests.twin.made_up_face import picture
from zsdt.graph import brick_grid
from zsdt.perception.camera import Camera
from zsdt.trajectory import Body, Trajectory
from zsdt.twin.twin_view import TwinView, truth_view

COUNTS, PITCH = (12, 2, 3), 0.05
FRAMES = 12


def beam():
    """60 x 10 x 15 cm, clamped at x = 0, and its nodes on the face y = 0 [columns, rows]."""
    grid = brick_grid(COUNTS, PITCH)
    body = Body(
        grid.points,
        grid.pairs,
        grid.points[:, 0] == 0,
        np.ones(len(grid.points)),
        1 / 60,
        PITCH,
        cells=grid.cells,
    )
    nx, ny, nz = (n + 1 for n in COUNTS)
    front = np.arange(nx)[:, None] + nx * ny * np.arange(nz)[None]
    return body, front


def bent(points, drop):
    """Points of the beam when its tip hangs `drop` of its length lower; sections turn with the slope."""
    length, middle = COUNTS[0] * PITCH, COUNTS[2] * PITCH / 2
    x = points[:, 0] / length
    slope = np.arctan(drop * (3.0 * x - 1.5 * x**2))
    up = points[:, 2] - middle
    axis = length * drop * (1.5 * x**2 - 0.5 * x**3)
    return np.stack([points[:, 0] + up * np.sin(slope), points[:, 1], middle - axis + up * np.cos(slope)], axis=1)


def swinging(frames=FRAMES, share=1.0, phase=0.0):
    """Truth: positions and stress of bending, in proportion to the curvature."""
    body, _ = beam()
    times = np.arange(frames) / 60
    drops = share * (0.10 + 0.09 * np.cos(2 * np.pi * 1.2 * times + phase))
    positions = np.stack([bent(body.points, d) for d in drops])
    x, z = body.points[:, 0] / (COUNTS[0] * PITCH), body.points[:, 2] / (COUNTS[2] * PITCH / 2) - 1.0
    stress = np.zeros((frames, body.nodes, 6))
    stress[..., 0] = 2.2e4 * drops[:, None] * (1.0 - x) ** 1.2 * z
    stress[..., 4] = 1.5e3 * drops[:, None] * (1.0 - z**2)
    velocity = np.gradient(positions, times, axis=0)
    heat = 2e-3 * times
    fields = {"position": positions, "velocity": velocity, "stress": stress}
    ledger = {"kinetic": 1e-3 * np.sin(9 * times) ** 2, "elastic": 0.1 * drops**2, "dissipated": heat}
    return Trajectory(body, times, fields, np.zeros((frames, body.nodes, 3)), ledger, {"name": "swing"})


def made_up_run(frames=FRAMES):
    """(closed loop, open loop, truth) on the same frames; in some of them a hand hides four nodes."""
    body, front = beam()
    camera = Camera.facing(distance=1.05, look_at=(0.31, 0.0), focal=1150.0, beam_width=COUNTS[1] * PITCH)
    truth = swinging(frames)
    sides = []
    for name, share, phase in (("closed loop", 1.004, 0.02), ("open loop", 1.18, 0.35)):
        guess = swinging(frames, share, phase)
        seen = np.ones((frames, *front.shape), bool)
        faults = [""] * frames
        if name == "closed loop":
            seen[frames // 3 : frames // 2, 6:8, 1:3] = False
            faults[frames // 2 : frames // 2 + 2] = ["dark", "dark"]
        off = 1e-3 * np.random.default_rng(0).random((frames, *front.shape))
        random = np.random.default_rng(1)
        sides.append(
            TwinView(
                name=name,
                body=body,
                front=front,
                camera=camera,
                frames=np.arange(frames),
                times=truth.times,
                positions=guess.fields["position"],
                fields={k: guess.fields[k] for k in ("velocity", "stress")},
                seen=seen,
                innovation=np.where(seen, off, np.nan),
                latency={
                    k: m * random.lognormal(0, 0.2, frames)
                    for k, m in (("track", 2.1), ("predict", 3.4), ("correct", 0.6))
                },
                faults=faults,
                account=guess.ledger,
                source="virtual lab",
                closed=name == "closed loop",
            )
        )
    return (*sides, truth_view(truth, sides[0]))


def pictures_of(truth):
    """The bare pictures of a made-up truth: (number, image)."""
    for number, pixels in zip(truth.frames, truth.pixels(), strict=True):
        yield int(number), picture(pixels, truth.camera.height, truth.camera.width)
