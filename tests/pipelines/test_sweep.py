"""A sweep goes on after a failing job, names it, and survives being killed."""

from __future__ import annotations

import csv
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from helpers import builds, run, start

from pipelines.collect import collect
from pipelines.jobs import record_loss

SIDE_BY_SIDE = ("hydra/launcher=side_by_side", "hydra.launcher.n_jobs=2")
LAUNCHERS = ("side_by_side", "submitit_local", "ray")


def needs(launcher: str) -> None:
    """Skips where the optional package of a launcher is not installed."""
    package = launcher.partition("_")[0]
    if package in ("submitit", "ray"):
        pytest.importorskip(package, reason=f"{package} is not installed.")


def wait_for(found: Callable[[], bool]) -> None:
    """Waits until something is there."""
    deadline = time.monotonic() + 120
    while not found():
        assert time.monotonic() < deadline, "nothing came"
        time.sleep(0.02)


def has_ended(pid: int) -> bool:
    """Whether a process is gone, or dead and not asked about yet."""
    try:
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


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


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_killed_worker_costs_one_job_which_is_named(tmp_path: Path, launcher: str) -> None:
    needs(launcher)
    arguments = ("-m", f"hydra/launcher={launcher}", "tignn.passes=2,3,4", "tignn.seconds=1")
    process = start(tmp_path, *arguments)
    wait_for(lambda: len(list(tmp_path.rglob("pid.txt"))) == 2)  # two jobs are in the middle of their training
    victim = min(tmp_path.rglob("pid.txt"))
    os.kill(int(victim.read_text()), signal.SIGKILL)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "2 of 3 jobs finished." in out and err.count("failed: ") == 1, err
    rows = newest_table(tmp_path)
    assert sorted(row["status"] for row in rows) == ["failed", "finished", "finished"]
    (lost,) = [row for row in rows if row["status"] == "failed"]
    assert lost["reason"].startswith("Lost: its process") and lost["tignn.passes"] in "234"
    if launcher == "side_by_side":
        assert "killed by SIGKILL" in lost["reason"]
    folder = max((tmp_path / "multirun").iterdir())
    assert "Lost:" in (folder / lost["job"] / "error.txt").read_text()
    assert victim.exists(), "what the lost job had of its training is kept"
    code, _, err = run(tmp_path, f"tignn.passes={lost['tignn.passes']}", "tignn.seconds=1")
    assert code == 0, err
    trainings = [line for line in builds(tmp_path) if line.startswith("train")]
    assert len(trainings) == 3 and not trainings[-1].endswith("from=0"), "it goes on where it was"


def test_a_job_that_dies_before_it_begins_is_named(tmp_path: Path) -> None:
    sentence = record_loss(tmp_path / "3", "fake", ["tignn.passes=2"], "its process was killed by SIGKILL")
    ((name, reason),) = collect(tmp_path).failed()
    assert (name, reason) == ("3", sentence)


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_workers_end_with_a_killed_launcher(tmp_path: Path, launcher: str) -> None:
    needs(launcher)
    process = start(tmp_path, "-m", f"hydra/launcher={launcher}", "tignn.passes=2,3", "tignn.seconds=60")
    wait_for(lambda: len(list(tmp_path.rglob("progress.txt"))) == 2)
    workers = [int(path.read_text()) for path in tmp_path.rglob("pid.txt")]
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()  # waits for the workers as well where they hold the pipe
    wait_for(lambda: all(map(has_ended, workers)))
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
