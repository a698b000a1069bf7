"""The sweep of stops: it covers what is advertised, and says so where a wall did not hold."""

import numpy as np

from zsdt.fluid import stop_sweep
from zsdt.fluid.sampler import draw_case, plan
from zsdt.scene import Liquid, VesselFamily, water
from zsdt.trajectory import Body, DatasetEntry, Trajectory, write_index, write_trajectory


def test_sweep_covers_the_advertised_range():
    for liquid, fastest in ((Liquid(), 1.0), (water(), 0.5)):
        options = stop_sweep.sweep_options(liquid, 100)
        jobs = plan(options)
        cards = [draw_case(job, options, 0).excitation.describe() for job in jobs]
        assert len(jobs) == 100 and {job.family for job in jobs} == set(VesselFamily)
        speed, ramp = np.array([c["speed"] for c in cards]), np.array([c["ramp"] for c in cards])
        assert speed.max() > 0.95 * fastest and speed.max() <= fastest
        assert ((ramp == 0) | (ramp >= 0.02)).all() and speed[ramp == 0].max() <= 0.5 and (ramp == 0).sum() > 10
        assert any("tilt" in c for c in cards) and any(c["kind"] == "pulses" for c in cards)


def _write(folder, names, **meta):
    (folder / "trajectories").mkdir(parents=True)
    zeros = np.zeros((2, 1, 3))
    body = Body(zeros[0], np.zeros((0, 2), np.int64), np.zeros(1, bool), np.ones(1), 0.004, 0.005)
    ledger = {"kinetic": np.array([1.0, 0.5]), "residual": np.array([0.0, -1e-3])}
    entries = []
    for name in names:
        card = {"leaks": 0, "guards": 0, "rejected": [], "watched": {"mach": 0.1, "density": 0.01}}
        card |= {"stop": {"ramp": 0.0, "speed": 0.5}, **meta}
        file = f"trajectories/{name}.h5"
        write_trajectory(folder / file, Trajectory(body, np.arange(2.0), {"position": zeros}, zeros, ledger, card))
        entries.append(DatasetEntry(file, name, "train", "glycerin", "jar"))
    write_index(folder, entries)


def test_census_counts_what_walls_did(tmp_path, monkeypatch, capsys):
    _write(tmp_path / "good", "ab", rejected=["spill"])
    found = stop_sweep.census(tmp_path / "good")
    assert (found.runs, found.leaks, found.guards, found.at_once) == (2, 0, 0, 2)
    assert found.rejected == {"spill": 2} and found.residual == 1e-3 and found.fastest == 0.5
    monkeypatch.setattr(stop_sweep, "generate", lambda *_: {"cpu_s": 1.0, "peak_worker_mb": 2.0})
    assert stop_sweep.main([str(tmp_path / "good")]) == 0
    assert "leaked particles: 0 (in 0 runs)" in capsys.readouterr().out
    _write(tmp_path / "leak", "a", leaks=3)
    assert stop_sweep.main([str(tmp_path / "leak")]) == 1
    _write(tmp_path / "guard", "a", guards=2)
    assert stop_sweep.main([str(tmp_path / "guard")]) == 1
    assert stop_sweep.main([str(tmp_path / "guard"), "--liquid", "water"]) == 0
    _write(tmp_path / "rejected", "a", rejected=["leak"])
    assert stop_sweep.main([str(tmp_path / "rejected")]) == 1
    assert stop_sweep.main([str(tmp_path / "none")]) == 2
    assert "index.csv is missing" in capsys.readouterr().err
