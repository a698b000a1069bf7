"""A sweep goes on after a failing job, names it, and survives being killed."""

from __future__ import annotations

import csv
import os
import signal
import time
from pathlib import Path

from helpers import builds, run, start

JOBLIB = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2")


def newest_table(outputs: Path) -> list[dict[str, str]]:
    """Rows of the table of the newest sweep."""
    with (max((outputs / "multirun").iterdir()) / "sweep.csv").open() as lines:
        return list(csv.DictReader(lines))


def test_a_failing_job_is_named_and_the_others_run(tmp_path: Path) -> None:
    code, out, err = run(tmp_path, "-m", *JOBLIB, "tignn.passes=2,3", "tignn.mood=bad,good")
    assert code == 1
    assert "2 of 4 jobs finished." in out
    assert err.count("failed:") == 2 and "failed: 0: The training went badly; choose mood=good." in err
    rows = newest_table(tmp_path)
    assert [row["status"] for row in rows] == ["failed", "finished", "failed", "finished"]
    assert [float(row["error"]) for row in rows if row["error"]] == [0.5, 1 / 3]
    folder = max((tmp_path / "multirun").iterdir())
    assert "The training went badly" in (folder / "0" / "error.txt").read_text()
    assert "counting" not in out
    assert sum("counting" in path.read_text() for path in folder.glob("*/log.txt")) == 1
    assert (folder / "sweep.md").read_text().count("\n") == 6
    assert sorted(builds(tmp_path)).count("numbers") == 1


def test_a_killed_sweep_loses_and_repeats_nothing(tmp_path: Path) -> None:
    arguments = ("-m", *JOBLIB, "tignn.passes=2,3,4,5", "tignn.seconds=1.5")
    process = start(tmp_path, *arguments)
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        finished = any(line.startswith("evaluate") for line in builds(tmp_path))
        if finished and list(tmp_path.rglob("progress.txt")):
            break  # one job is through, another one is training
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    under_way = len(list(tmp_path.rglob("progress.txt")))
    before = builds(tmp_path)
    assert 1 <= sum(line.startswith("evaluate") for line in before) < 4
    code, out, _ = run(tmp_path, *arguments)
    assert code == 0 and "4 of 4 jobs finished." in out
    after = builds(tmp_path)
    assert after[: len(before)] == before
    for work in ("numbers", *(f"train passes={p} lambda_d=5.0" for p in (2, 3, 4, 5))):
        assert sum(line.startswith(work) for line in after) == 1, work
    resumed = [line for line in after[len(before) :] if line.startswith("train") and not line.endswith("from=0")]
    assert len(resumed) == under_way >= 1, "a training that was killed goes on from its scratch folder"
    assert not list(tmp_path.rglob("*.part"))


def test_workers_end_with_a_killed_launcher(tmp_path: Path) -> None:
    process = start(tmp_path, "-m", *JOBLIB, "tignn.passes=2,3", "tignn.seconds=60")
    deadline = time.monotonic() + 120
    while len(list(tmp_path.rglob("progress.txt"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()  # waits for the workers as well: they hold the pipe
    assert len(list(tmp_path.rglob("progress.txt"))) == 2
    assert not any(line.startswith("train") for line in builds(tmp_path))


def test_optuna_searches_the_same_space(tmp_path: Path) -> None:
    code, out, err = run(
        tmp_path,
        "-m",
        "hydra/sweeper=optuna",
        "hydra.sweeper.n_trials=2",
        "hydra.sweeper.n_jobs=1",
        "tignn.passes=range(2,9)",
        "tignn.lambda_d=interval(5,50)",
    )
    assert code == 0, err
    assert "Best value" in out and "2 of 2 jobs finished." in out
