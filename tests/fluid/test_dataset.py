"""Data sets of liquids: splits, the same bytes for any number of workers, going on, rejections, what files promise."""

from dataclasses import replace

import numpy as np
import pytest

from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.fluid import dataset
from zsdt.fluid.excitations import MotionOptions
from zsdt.fluid.motion import Excitation, VelocityChange
from zsdt.fluid.sampler import Case, Job, LiquidSynthesisOptions, draw_case, least_particles, plan
from zsdt.fluid.vessel import Vessel
from zsdt.scene import VesselFamily, VesselShape, water
from zsdt.trajectory import Dataset

TINY = LiquidSynthesisOptions(
    train=2,
    val=0,
    test=1,
    beyond=1,
    radius=[0.025, 0.03],
    fill=[0.035, 0.045],
    particles=[90, 140],
    layers=4.1,
    duration=0.024,
    settle=0.15,
    motion=MotionOptions(speed=[0.3, 0.5], ramp=[0.02, 0.03], pulse_fraction=0.0),
    seed=3,
)


def test_held_out_families_and_ranges_are_only_in_their_splits():
    options = LiquidSynthesisOptions(train=60, val=10, test=30, beyond=20)
    low, high = options.held_out

    def shares(case):
        values = (max(case.shape.radii), options.radius), (case.fill, options.fill)
        speed = (case.excitation.describe()["speed"], options.motion.speed)
        found = [(v - a) / (b - a) for v, (a, b) in (*values, speed)]
        return found[1:] if case.shape.family is VesselFamily.tumbler else found  # its radius is that at half the fill

    for job in plan(options):
        case = draw_case(job, options, 0)
        assert (case.shape.family in options.families_beyond) == (job.split == "beyond")
        assert options.particles[0] <= case.particles <= options.particles[1]
        assert case.particles >= least_particles(case.shape, case.fill, options.layers)
        inside = [low - 1e-3 <= s <= high + 1e-3 for s in shares(case)]
        if job.split == "test":
            assert all(inside)
        elif job.split in ("train", "val"):
            assert not any(low + 1e-3 < s < high - 1e-3 for s in shares(case))
    assert len({job.name for job in plan(options)}) == 120


def test_options_that_make_no_sense_are_refused():
    with pytest.raises(OptionError, match="both in families and in families_beyond"):
        LiquidSynthesisOptions(families_beyond=[VesselFamily.jar])
    with pytest.raises(OptionError, match=r"of radius must be \[lowest, highest\]"):
        LiquidSynthesisOptions(radius=[0.05, 0.03])
    with pytest.raises(OptionError, match="outside the range in which water"):
        LiquidSynthesisOptions(liquid=water())
    with pytest.raises(OptionError, match="no family for the split 'beyond'"):
        plan(LiquidSynthesisOptions(families_beyond=[]))
    with pytest.raises(OptionError, match="too few for 9 layers"):
        draw_case(Job("train", 0, VesselFamily.cylinder), replace(TINY, layers=9.0), 0)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("one") / "set"
    return folder, dataset.generate(TINY, folder, workers=1)


def test_data_set_is_bitwise_the_same_for_one_and_two_workers(made, tmp_path):
    folder, _ = made
    dataset.generate(TINY, tmp_path / "two", workers=2)
    files = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(tmp_path / "two") for p in (tmp_path / "two").rglob("*") if p.is_file())
    assert len(files) == 4 + 2
    for file in files:
        assert (folder / file).read_bytes() == (tmp_path / "two" / file).read_bytes(), file


def test_data_set_reads_back_as_it_was_promised(made):
    folder, info = made
    data = Dataset(folder)
    assert [e.split for e in data.entries] == ["train", "train", "test", "beyond"]
    assert [e.family for e in data.entries] == ["cylinder", "tumbler", "cylinder", "bowl"]
    assert info["trajectories"] == 4 and info["frames"] == 28 and info["cpu_s"] > 0
    for entry in data.entries:
        t = data.read(entry)
        body, ledger, meta = t.body, t.ledger, t.meta
        assert entry.regime == body.liquid.name == "glycerin" and t.frames == 7 and body.frame_dt == 0.004
        assert body.pairs.shape == (0, 2) and not body.clamped.any() and not t.load.any()
        np.testing.assert_allclose(body.points, t.fields["position"][0], atol=1e-8)
        vessel = Vessel(body.vessel)
        assert body.mass.sum() == pytest.approx(body.liquid.density * vessel.volume(meta["fill"]), rel=1e-9)
        assert body.mass[0] == pytest.approx(body.liquid.density * body.pitch**3)
        assert (vessel.distance(t.fields["position"].reshape(-1, 3)) > 0).all() and meta["leaks"] == 0
        # The first frame is the end of the excitation: the vessel stands, the liquid moves on in its old direction.
        assert body.motion.times[-1] == 0 and np.abs(body.motion.velocity[-1]).max() < 1e-12
        heading = body.motion.velocity[0]
        assert np.linalg.norm(heading) == pytest.approx(meta["stop"]["speed"])
        assert t.fields["velocity"][0].mean(axis=0) @ heading > 0
        # The account: what the vessel put in is there as motion, height and internal energy.
        mass = body.mass[:, None]
        np.testing.assert_allclose(
            0.5 * (mass * t.fields["velocity"] ** 2).sum(axis=(1, 2)), ledger["kinetic"], rtol=1e-5
        )
        np.testing.assert_allclose(
            (mass * t.fields["internal_energy"]).sum(axis=(1, 2)), ledger["internal"], rtol=1e-4, atol=1e-9
        )
        total = ledger["kinetic"] + ledger["potential"] + ledger["internal"] - ledger["work_inertial"]
        assert np.ptp(total) < 0.02 * ledger["kinetic"].max()
        assert ledger["work_inertial"][0] > 0 and np.ptp(ledger["work_inertial"]) < 1e-12


def test_interrupted_run_goes_on_where_it_was(made, tmp_path, monkeypatch):
    folder, _ = made
    broken = tmp_path / "set"
    (real, calls) = (dataset.make_trajectory, [])

    def fails_at_third(job, options):
        calls.append(job.name)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(job, options)

    monkeypatch.setattr(dataset, "make_trajectory", fails_at_third)
    with pytest.raises(KeyboardInterrupt):
        dataset.generate(TINY, broken)
    assert len(list((broken / "trajectories").iterdir())) == 2
    dataset.generate(TINY, broken)
    assert len(calls) == 5 and calls[3:] == calls[2:3] + calls[4:]
    for file in (folder / "trajectories").iterdir():
        assert file.read_bytes() == (broken / "trajectories" / file.name).read_bytes()
    with pytest.raises(DataError, match="other options"):
        dataset.generate(replace(TINY, seed=4), broken)


def test_rejected_cases_are_drawn_again_named_and_counted(made, monkeypatch):
    seen = []
    some = Dataset(made[0])

    def sometimes(job, case, options):
        seen.append(case)
        if len(seen) < 3:
            raise RunRejected("spill" if len(seen) == 1 else "mach", "said for the test")
        return replace(some.read(some.entries[0]), meta={})

    monkeypatch.setattr(dataset, "simulate", sometimes)
    job = plan(TINY)[0]
    assert dataset.make_trajectory(job, TINY).meta == {"rejected": ["spill", "mach"], "seed": job.seed(TINY.seed, 2)}
    assert len({case.fill for case in seen}) == 3

    def never(job, case, options):
        raise RunRejected("spill", "said for the test")

    monkeypatch.setattr(dataset, "simulate", never)
    with pytest.raises(RunRejected, match="20 spill"):
        dataset.make_trajectory(job, TINY)


def test_liquid_that_goes_over_the_rim_is_rejected():
    """A cup with hardly any freeboard, stopped from the highest speed: the solver itself says why."""
    shape = VesselShape(VesselFamily.cylinder, [0.0, 0.041], [0.03, 0.03])
    stop = Excitation((1.0, 0.0, 0.0), (VelocityChange(0.0, 0.02, (-1.0, 0.0, 0.0)),))
    options = replace(TINY, duration=0.2)
    with pytest.raises(RunRejected) as error:
        dataset.simulate(Job("train", 0, VesselFamily.cylinder), Case(shape, 0.04, 150, stop, 0), options)
    assert error.value.cause == "spill"


def test_stop_at_once_starts_with_the_speed_of_the_vessel():
    shape = VesselShape(VesselFamily.cylinder, [0.0, 0.1], [0.028, 0.028])
    stop = Excitation((0.0, 0.4, 0.0), (VelocityChange(0.0, 0.0, (0.0, -0.4, 0.0)),))
    t = dataset.simulate(Job("train", 0, VesselFamily.cylinder), Case(shape, 0.04, 100, stop, 0), TINY)
    np.testing.assert_allclose(t.fields["velocity"][0], np.broadcast_to([0, 0.4, 0], t.body.points.shape), atol=1e-12)
    np.testing.assert_allclose(t.body.motion.velocity[-2:, 1], [0.4, 0.0], atol=1e-12)
    assert t.ledger["kinetic"][0] == pytest.approx(0.5 * t.body.mass.sum() * 0.16)
