"""Hard cases of liquids and cameras: the way of a vessel, what should rest rests, and troubles are what they say."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from zsdt.evaluation import stability_cameras
from zsdt.evaluation.stability_camera_cases import CAMERA_CASES, CameraCase, Trouble
from zsdt.evaluation.stability_cameras import Troubled
from zsdt.evaluation.stability_faults import spoiling
from zsdt.evaluation.stability_film import Film
from zsdt.evaluation.stability_glass_cases import GLASS_CASES, LEAD, cylinder
from zsdt.evaluation.stability_glass_truth import glass_truth, lumps, way_of
from zsdt.evaluation.stability_glasses import coarser, run_glass
from zsdt.evaluation.stability_row import Outcome, Party
from zsdt.lab.clips import Clip
from zsdt.perception.video import VideoFrame
from zsdt.shipped import TwinWeights, shipped
from zsdt.tignn.engine import load_engine, roll_out

CASES = {case.name: case for case in GLASS_CASES}
WEIGHTS = TwinWeights(*(shipped("glycerin_glass", part) for part in ("tignn", "psi_ini", "vision")))


@pytest.fixture(scope="module")
def resting():
    case = replace(CASES["rest_5000"], particles=150, frames=8)
    return case, glass_truth(case)


def test_a_vessel_comes_evenly_stops_within_its_ramp_and_stands(resting):
    case = CASES["normal_stop"]
    way = way_of(case.excitation(), LEAD, 3, case)
    assert np.allclose(np.diff(way[: LEAD + 1]) * case.fps, case.speed, rtol=1e-2)
    assert np.abs(way[LEAD + 3 :]).max() < 1e-6 and way[0] < 0 and len(way) == LEAD + 3 + case.frames
    assert np.abs(resting[1].way).max() == 0.0


@pytest.mark.parametrize("party", [Party.solver, Party.network])
def test_what_rests_stays_at_rest_and_keeps_its_energy(resting, party):
    case, truth = resting
    row = run_glass(case, party, truth, WEIGHTS)
    assert row.outcome == Outcome.bounded and row.note.startswith("moves at")
    speed = float(row.note.split()[2])  # mm/s
    assert speed < 10.0 and truth.spilled == 0 and truth.known == case.frames
    if party is Party.network:
        assert max(row.error) < 0.002


def test_a_coarser_liquid_weighs_the_same_and_moves_as_the_finer_one(resting):
    fine = resting[1].trajectory
    fine.fields["velocity"][0] = [0.1, 0.0, 0.0]
    few = coarser(fine, 60)
    assert few.body.nodes == 60 and np.isclose(few.body.mass.sum(), fine.body.mass.sum())
    assert np.allclose(few.fields["velocity"][0], [0.1, 0.0, 0.0], atol=1e-6)
    off = few.fields["position"][0].mean(axis=0) - fine.fields["position"][0].mean(axis=0)
    assert np.linalg.norm(off) < 0.05 * fine.body.pitch * 3


def test_lumps_hang_apart_over_the_floor_of_their_vessel():
    points = lumps(CASES["two_lumps"].volume, 0.0045, 0.035)
    left, right = points[points[:, 0] < 0], points[points[:, 0] > 0]
    assert len(left) == len(right) and right[:, 2].min() > left[:, 2].min() > 0.005
    radius = np.linalg.norm(points[:, :2], axis=1).max()
    assert radius < 0.035 - 0.5 * 0.0045
    assert len(points) * 0.0045**3 == pytest.approx(CASES["two_lumps"].volume, rel=0.1)


def test_a_film_shows_a_level_surface_where_it_is():
    shape = cylinder()
    film = Film(shape, np.zeros(2), np.array([[0.05, 0, 0, 0, 0], [0.04, 0, 0, 0, 0]]), 60.0)
    seen = [film.masks(frame.image) for frame in film]
    top = [np.flatnonzero((m.liquid > 0.5).any(axis=1))[0] for m in seen]
    assert top[1] > top[0] and all((m.liquid <= m.container + 1e-6).all() for m in seen)
    floor = film.camera.project(np.array([[0.0, 0.0, 0.006]]))[0]
    assert (seen[0].container > 0.5)[int(floor[1]), int(floor[0])]


class Counting:
    """Frames whose grey says their number."""

    name, fps, size, missing, count = "counting", 60.0, (8, 8), [], 60

    def __iter__(self):
        for k in range(60):
            yield VideoFrame(k, k / 60.0, np.full((8, 8, 3), 2 * k, np.uint8))


def shown(case):
    return [int(np.median(f.image)) // 2 for f in Troubled(Counting(), case)]


def test_frames_freeze_and_change_places_only_from_the_start_on():
    frozen = shown(CameraCase("", "", Trouble.frozen, 30.0))
    assert frozen[:21] == list(range(21)) and set(frozen[20:50]) == {20} and frozen[50:] == list(range(50, 60))
    swapped = shown(CameraCase("", "", Trouble.swapped, 0.5))
    assert sorted(swapped) == list(range(60)) and swapped != list(range(60)) and swapped[:20] == list(range(20))
    assert max(abs(a - k) for k, a in enumerate(swapped)) == 1


def test_noise_and_light_are_as_large_as_told():
    frames = list(Troubled(Counting(), CameraCase("", "", Trouble.noise, 8.0)))
    assert frames[19].image.std() == 0 and 6.0 < np.std([f.image.std() for f in frames[25:]]) + 7.0 < 10.0
    light = [
        float(f.image.mean()) / (2 * k)
        for k, f in enumerate(Troubled(Counting(), CameraCase("", "", Trouble.exposure, 2.0)))
        if k > 25
    ]
    assert min(light) == pytest.approx(0.5, rel=0.05) and max(light) == pytest.approx(2.0, rel=0.05)


def test_every_trouble_is_tried():
    assert {case.trouble for case in CAMERA_CASES} == set(Trouble)


@pytest.mark.parametrize(
    ("thrown", "cause"),
    [((np.nan, 0, 0), "not_finite"), ((0.5, 0, 0), "mach"), ((0, 0, -0.5), "mach"), ((0, 0, 2.5), "left_range")],
)
def test_a_particle_that_was_lost_ends_the_run_with_its_reason(resting, thrown, cause):
    engine = spoiling(load_engine(WEIGHTS.tignn), 3, np.array(thrown, float))
    rollout = roll_out(engine, resting[1].trajectory)
    assert rollout.diverged_at == 3 and rollout.reason.startswith(cause)


def test_a_particle_that_was_thrown_into_the_air_falls_back(resting):
    engine = spoiling(load_engine(WEIGHTS.tignn), 3, np.array([0.0, 0.0, 0.02]))
    rollout = roll_out(engine, resting[1].trajectory)
    assert rollout.diverged_at is None and not rollout.reason


def test_cases_that_start_together_paint_their_clip_once(tmp_path, monkeypatch):
    painting, clip = tmp_path / "painting", object.__new__(Clip)

    def paint(options, folder):
        painting.mkdir()  # fails where somebody else paints
        time.sleep(0.3)
        painting.rmdir()

    monkeypatch.setattr(stability_cameras, "make_clips", paint)
    monkeypatch.setattr(stability_cameras, "ClipSet", lambda folder: [clip])
    with ThreadPoolExecutor(3) as pool:
        assert list(pool.map(stability_cameras.clip_in, [tmp_path / "clips"] * 3)) == [clip] * 3
