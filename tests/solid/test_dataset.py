"""Data sets: splits, the same bytes for any number of workers, going on after an interruption, rejections."""

import csv
from dataclasses import replace

import joblib
import numpy as np
import pytest

from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.solid import dataset
from zsdt.solid.loads import LoadOptions, Regime, bending_demand, buckling_demand
from zsdt.solid.sampler import Job, SizeRange, SynthesisOptions, draw_case, plan
from zsdt.trajectory import Dataset, read_trajectory

TINY = SynthesisOptions(
    train=2,
    val=0,
    test=1,
    beyond=1,
    sizes=SizeRange([35, 40], [10, 10], [10, 10]),
    beyond_sizes=SizeRange([35, 45], [10, 10], [10, 10]),
    hand_duration=0.05,
    dynamic_duration=0.03,
    mesh=0.05,
    seed=3,
)


def test_splits_share_no_size_that_they_should_not():
    options = SynthesisOptions(train=200, val=20, test=30, beyond=30)
    jobs = plan(options)
    assert len({job.name for job in jobs}) == 280
    sizes = {s: {j.size_cm for j in jobs if j.split == s} for s in ("train", "val", "test", "beyond")}
    inside = set(options.sizes.sizes())
    assert sizes["val"] <= inside - sizes["test"] and sizes["train"] <= inside - sizes["test"]
    assert sizes["test"] <= inside
    assert not sizes["beyond"] & inside
    for split in sizes:
        hand = [j.regime is Regime.hand for j in jobs if j.split == split]
        assert abs(np.mean(hand) - options.hand_fraction) < 0.05


def test_ranges_that_make_no_sense_are_refused():
    with pytest.raises(OptionError, match="multiples of 5 cm"):
        SizeRange([35, 38]).sizes()
    with pytest.raises(OptionError, match="no sizes for the split 'beyond'"):
        plan(SynthesisOptions(beyond_sizes=SizeRange()))


def test_sampler_skips_hopeless_demand():
    options = SynthesisOptions(loads=LoadOptions(demand_limit=1.2))
    job = Job("train", 0, (80, 10, 10), Regime.hand)
    for attempt in range(30):
        case = draw_case(job, options, attempt)
        assert bending_demand(job.shape, options.material, options.gravity, case) <= 1.2
        assert buckling_demand(job.shape, options.material, case) <= options.loads.buckling_limit
    with pytest.raises(OptionError, match="No load in the given range is bearable"):
        draw_case(job, replace(options, loads=LoadOptions(demand_limit=0.5)), 0)


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
    assert info["trajectories"] == 4 and info["rejections"] == {}
    for entry in data.entries:
        t = data.read(entry)
        body = t.body
        assert t.meta["regime"] == entry.regime and t.meta["load"]["face"] in {"top", "bottom", "front", "back", "tip"}
        assert t.frames == (4 if entry.regime == "hand" else 7)
        assert body.frame_dt == pytest.approx(1 / 60 if entry.regime == "hand" else 0.005)
        shape = t.meta["shape"]
        volume = shape["length"] * shape["width"] * shape["depth"]
        assert body.mass.sum() == pytest.approx(body.material.density * volume)
        held = t.fields["position"][:, body.clamped]
        np.testing.assert_allclose(held, np.broadcast_to(body.points[body.clamped], held.shape), atol=1e-7)
        assert np.abs(t.fields["velocity"][0]).max() < 1e-5
        # Energy densities at the nodes add up to the solver's account.
        nodal_volume = body.mass / body.material.density
        for name in ("elastic", "dissipated"):
            total = (t.fields[f"{name}_energy"][..., 0] * nodal_volume).sum(axis=1)
            np.testing.assert_allclose(total, t.ledger[name], rtol=1e-5, atol=1e-12)
        ledger = t.ledger
        total = ledger["kinetic"] + ledger["elastic"] + ledger["dissipated"]
        work = ledger["work_load"] + ledger["work_gravity"]
        np.testing.assert_allclose(total - total[0] - work, ledger["residual"], atol=1e-12)
        assert np.abs(ledger["residual"]).max() < 1e-5 * total.max()


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


def test_rejected_draws_are_drawn_again_and_counted(tmp_path, monkeypatch):
    real, seen = dataset.simulate, []

    def sometimes(job, case, options):
        seen.append(case)
        if len(seen) in (1, 2, 4):
            raise RunRejected("collapse" if len(seen) < 3 else "ledger", "said for the test")
        return real(job, case, options)

    monkeypatch.setattr(dataset, "simulate", sometimes)
    info = dataset.generate(replace(TINY, train=2, test=0, beyond=0), tmp_path / "set")
    assert info["rejections"] == {"collapse": 2, "ledger": 1}
    with (tmp_path / "set" / "index.csv").open() as lines:
        files = [row["file"] for row in csv.DictReader(lines)]
    assert sorted(len(read_trajectory(tmp_path / "set" / f).meta["rejected"]) for f in files) == [1, 2]
    assert len({case.force for case in seen}) == len(seen)


def test_trajectory_that_is_always_rejected_says_why(monkeypatch):
    def never(job, case, options):
        raise RunRejected("collapse", "said for the test")

    monkeypatch.setattr(dataset, "simulate", never)
    with pytest.raises(RunRejected, match="20 collapse"):
        dataset.make_trajectory(plan(TINY)[0], TINY)


def test_hard_load_that_passes_the_sampler_is_rejected_by_the_solver():
    """No prediction of demand (limit off): a slender beam under 8 N collapses, and the run says so."""
    options = replace(TINY, loads=LoadOptions(force=[8.0, 9.0], demand_limit=1e9))
    job = Job("train", 0, (80, 10, 10), Regime.dynamic)
    causes = set()
    for attempt in range(6):
        try:
            dataset.simulate(job, draw_case(job, options, attempt), options)
        except RunRejected as error:
            causes.add(error.cause)
    assert causes and causes <= {"collapse", "inverted", "step", "ledger", "not_finite"}


def _generate_in(folder):
    return dataset.generate(TINY, folder, workers=2)["trajectories"]


def test_a_worker_of_a_launcher_makes_data_with_workers_of_its_own(tmp_path):
    """In a joblib (loky) worker the usual way to start processes is one that a spawned process does not know."""
    parallel = joblib.Parallel(n_jobs=2, backend="loky")
    made = parallel(joblib.delayed(_generate_in)(tmp_path / name) for name in "ab")
    assert made == [4, 4]
