"""A sweep goes on after a failing job, names it, and survives being killed."""

from __future__ import annotations

import csv
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers import builds, run, start

from pipelines.collect import collect
from pipelines.jobs import record_loss

SIDE_BY_SIDE = ("hydra/launcher=side_by_side", "hydra.launcher.n_jobs=2")


def wait_for(found: Callable[[], bool]) -> None:
    """Waits until something is there."""
    deadline = time.monotonic() + 120
    while not found():
        assert time.monotonic() < deadline, "nothing came"
        time.sleep(0.02)


def newest_table(outputs: Path) -> list[dict[str, str]]:
    """Rows of the table of the newest sweep."""
    with (max((outputs / "multirun").iterdir()) / "sweep.csv").open() as lines:
        return list(csv.DictReader(lines))


def test_a_failing_job_is_named_and_the_others_run(tmp_path: Path) -> None:
    code, out, err = run(tmp_path, "-m", *SIDE_BY_SIDE, "tignn.passes=2,3", "tignn.mood=bad,good")
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
    arguments = ("-m", *SIDE_BY_SIDE, "tignn.passes=2,3,4,5", "tignn.seconds=1.5")
    process = start(tmp_path, *arguments)
    wait_for(lambda: any(line.startswith("evaluate") for line in builds(tmp_path)))  # one job is through,
    wait_for(lambda: bool(list(tmp_path.rglob("progress.txt"))))  # another one is training
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


def test_a_killed_worker_costs_one_job_which_is_named(tmp_path: Path) -> None:
    """The other launchers go through the same lines but for their pool, see test_pools.py."""
    process = start(tmp_path, "-m", *SIDE_BY_SIDE, "tignn.passes=2,3,4", "tignn.seconds=3")
    wait_for(lambda: bool(list(tmp_path.rglob("progress.txt"))))  # a job is in the middle of its training
    os.kill(int(min(tmp_path.rglob("pid.txt")).read_text()), signal.SIGKILL)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "2 of 3 jobs finished." in out and err.count("failed: ") == 1, err
    rows = newest_table(tmp_path)
    assert sorted(row["status"] for row in rows) == ["failed", "finished", "finished"]
    (lost,) = [row for row in rows if row["status"] == "failed"]
    assert lost["reason"].startswith("Lost: its process was killed by SIGKILL")
    folder = max((tmp_path / "multirun").iterdir())
    assert "Lost:" in (folder / lost["job"] / "error.txt").read_text()
    code, _, err = run(tmp_path, f"tignn.passes={lost['tignn.passes']}", "tignn.seconds=3")
    assert code == 0, err
    trainings = [line for line in builds(tmp_path) if line.startswith("train")]
    assert len(trainings) == 3 and not trainings[-1].endswith("from=0"), "it goes on where it was"


def test_a_job_that_dies_before_it_begins_is_named(tmp_path: Path) -> None:
    sentence = record_loss(tmp_path / "3", "fake", ["tignn.passes=2"], "its process was killed by SIGKILL")
    ((name, reason),) = collect(tmp_path).failed()
    assert (name, reason) == ("3", sentence)


def test_workers_end_with_a_killed_launcher(tmp_path: Path) -> None:
    process = start(tmp_path, "-m", *SIDE_BY_SIDE, "tignn.passes=2,3", "tignn.seconds=60")
    wait_for(lambda: len(list(tmp_path.rglob("progress.txt"))) == 2)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()  # waits for the workers as well: they hold the pipe
    assert len(list(tmp_path.rglob("progress.txt"))) == 2
    assert not any(line.startswith("train") for line in builds(tmp_path))


def test_a_sweep_on_slurm_asks_for_what_the_config_says(tmp_path: Path, slurm: Path) -> None:
    pytest.importorskip("submitit", reason="submitit is not installed.")
    settings = ("slurm.partition=cpu", "slurm.account=lab", "slurm.array_parallelism=7", "mem_gb=2", "cpus_per_task=1")
    extra = ("slurm.setup=[module load python]", "slurm.additional_parameters={mail-type: FAIL}", "timeout_min=90")
    options = [f"hydra.launcher.{word}" for word in (*settings, *extra)]
    code, out, err = run(tmp_path, "-m", "hydra/launcher=slurm", *options, "tignn.passes=2,3")
    assert code == 0 and "2 of 2 jobs finished." in out, err
    script = (slurm / "1000.sbatch").read_text()
    for line in (
        "partition=cpu",
        "account=lab",
        "array=0-1%2",
        "mem=2GB",
        "cpus-per-task=1",
        "time=90",
        "job-name=zsdt",
    ):
        assert f"#SBATCH --{line}\n" in script, script
    assert "#SBATCH --mail-type=FAIL\n" in script and "\nmodule load python\n" in script
    assert "srun" in script and "submitit.core._submit" in script
    assert sorted(builds(tmp_path)).count("numbers") == 1


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
