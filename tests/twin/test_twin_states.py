"""A twin's run as a trajectory file: the same states, what it estimated frame by frame, and nothing made up."""

from pathlib import Path

import numpy as np

from tests.tignn.conftest import make_body, make_trajectory
from tests.tignn.liquid_bodies import make_flow, make_liquid
from zsdt.perception.camera import Camera
from zsdt.trajectory import read_trajectory
from zsdt.twin.glass_log import GlassTwinLog
from zsdt.twin.twin_log import TwinLog
from zsdt.twin.twin_states import write_states

FRONT, COLUMNS, FRAMES = 6, 4, 5
CAMERA = Camera(
    np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 180.0], [0.0, 0.0, 1.0]]), np.zeros(5), np.eye(3), np.zeros(3), 640, 360
)


def beam_log() -> TwinLog:
    made = make_trajectory(make_body(), FRAMES)
    innovation = np.full((FRAMES, FRONT), 3e-4)
    innovation[1, :2], innovation[2] = np.nan, np.nan  # two nodes are hidden, then the frame never comes
    return TwinLog(
        name="seen",
        mode="closed",
        body=made.body,
        front_nodes=np.arange(FRONT).reshape(2, 3),
        camera=CAMERA,
        stiffness=1.1,
        density=0.9,
        frames=np.arange(FRAMES),
        times=made.times,
        status=["started", "corrected", "missing", "corrected", "corrected"],
        positions=made.fields["position"],
        fields={"stress": made.fields["stress"], "von_mises": made.fields["stress"][..., :1]},
        predicted_px=np.zeros((FRAMES, FRONT, 2)),
        observed_px=np.zeros((FRAMES, FRONT, 2)),
        seen=np.isfinite(innovation),
        taken=np.isfinite(innovation),
        innovation=innovation,
        load=np.arange(3.0 * FRAMES).reshape(FRAMES, 3),
        latency={},
        account={"kinetic": np.arange(FRAMES) * 1.0},
    )


def test_a_beam_twin_reads_back_as_a_trajectory(tmp_path: Path) -> None:
    log = beam_log()
    write_states(tmp_path / "twin.h5", log)
    back = read_trajectory(tmp_path / "twin.h5")
    assert np.array_equal(back.times, log.times) and np.array_equal(back.body.cells, log.body.cells)
    assert set(back.fields) == {"position", "stress"}, "von Mises follows from the stress"
    for name, values in (("position", log.positions), ("stress", log.fields["stress"])):
        assert np.array_equal(back.fields[name], values.astype(np.float32))
    assert np.isnan(back.load).all(), "the load of each node is not known"
    assert np.array_equal(back.ledger["kinetic"], log.account["kinetic"])
    frames = back.meta["frame_data"]
    assert np.array_equal(frames["estimated_load_N"], log.load)
    assert frames["seen_nodes"] == [6, 4, 0, 6, 6] and frames["predicted_on"] == [0, 0, 1, 0, 0]
    assert frames["innovation_rms_m"][2] is None
    assert np.allclose([v for k, v in enumerate(frames["innovation_rms_m"]) if k != 2], 3e-4)


def test_a_glass_twin_begins_where_it_has_particles(tmp_path: Path) -> None:
    flow = make_flow(make_liquid(), FRAMES)
    before = 3
    whole = before + FRAMES
    levels = np.full((FRAMES, COLUMNS), 0.03)
    log = GlassTwinLog(
        name="glass",
        mode="closed",
        method="modes",
        body=flow.body,
        camera=CAMERA,
        wall=0.002,
        floor=0.004,
        start=before,
        frames=np.arange(whole),
        times=0.004 * np.arange(whole),
        status=["waiting"] * before + ["started", "corrected", "occluded", "corrected", "corrected"],
        origin=np.linspace(0, 1, 3 * whole).reshape(whole, 3),
        positions=flow.fields["position"].astype(np.float32),
        fields={"velocity": flow.fields["velocity"].astype(np.float32)},
        places=np.zeros((COLUMNS, 2)),
        predicted_level=levels,
        level=levels,
        seen_level=levels + 0.001,
        seen_px=np.zeros((FRAMES, COLUMNS, 2)),
        taken=np.ones(FRAMES),
        viscosity=np.ones(FRAMES),
        level_offset=np.zeros(FRAMES),
        outline=[np.zeros((0, 2))] * whole,
        latency={},
        whole=np.zeros(whole),
        account={"kinetic": np.ones(FRAMES), "volume": np.full(FRAMES, 1e-4)},
    )
    write_states(tmp_path / "twin.h5", log)
    back = read_trajectory(tmp_path / "twin.h5")
    assert np.array_equal(back.times, log.times[before:]) and back.body.vessel == flow.body.vessel
    assert np.array_equal(back.fields["velocity"], log.fields["velocity"])
    assert list(back.ledger) == ["kinetic"], "a volume is no energy"
    frames = back.meta["frame_data"]
    assert np.allclose(frames["innovation_rms_m"], 0.001) and np.allclose(frames["volume_below_surface_m3"], 1e-4)
    assert frames["predicted_on"] == [0, 0, 1, 0, 0]
    assert np.allclose(frames["vessel_place_m"], log.origin[before:])
