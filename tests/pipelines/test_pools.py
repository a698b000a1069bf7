"""Every way of running jobs in processes of their own: results in order, and a killed process costs one job."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from pipelines import pools
from zsdt.errors import OptionError, ZsdtError

POOLS = ("side_by_side", "submitit_local", "submitit_slurm", "on_ray")


def run_pool(name: str, payloads: list[bytes], folder: Path) -> list[pools.Outcome]:
    """Runs packed calls, two at a time where that can be said."""
    if name == "side_by_side":
        return pools.side_by_side(payloads, 2)
    if name == "submitit_local":
        return pools.submitit_local(payloads, 2, folder / "%j", {"timeout_min": 5})
    if name == "submitit_slurm":
        return pools.submitit_slurm(payloads, folder / "%j", 0, {"timeout_min": 5, "slurm_array_parallelism": 2})
    return pools.on_ray(payloads, 2, None)


def needs(name: str) -> None:
    """Skips where the optional package is not installed."""
    if name != "side_by_side":
        package = "ray" if name == "on_ray" else "submitit"
        pytest.importorskip(package, reason=f"{package} is not installed.")


def work(folder: Path) -> Callable[[int], int]:
    """A job that says which process runs it; number 1 would not end by itself."""

    def job(number: int) -> int:
        (folder / f"{number}.part").write_text(str(os.getpid()))
        os.replace(folder / f"{number}.part", folder / f"{number}.pid")
        time.sleep(600 if number == 1 else 0.1)
        return number * number

    return job


def kill_when_it_runs(path: Path) -> None:
    """Kills the process whose number appears in a file."""
    deadline = time.monotonic() + 60
    while not path.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(int(path.read_text()), signal.SIGKILL)


@pytest.mark.parametrize("name", POOLS)
def test_a_killed_process_costs_one_job_and_says_so(name: str, tmp_path: Path, slurm: Path) -> None:
    needs(name)
    killer = threading.Thread(target=kill_when_it_runs, args=(tmp_path / "1.pid",), daemon=True)
    killer.start()
    outcomes = run_pool(name, [pools.packed(work(tmp_path), k) for k in range(4)], tmp_path / "logs")
    assert [outcomes[k] for k in (0, 2, 3)] == [0, 4, 9]
    assert isinstance(outcomes[1], pools.Lost) and outcomes[1].reason.startswith("its process")
    if name == "side_by_side":
        assert outcomes[1].reason == "its process was killed by SIGKILL"
    if name == "submitit_slurm":
        script = (slurm / "1000.sbatch").read_text()
        assert "#SBATCH --array=0-3%2" in script and "#SBATCH --time=5" in script


SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from pipelines import pools
from test_pools import run_pool, work
if __name__ == "__main__":
    folder = Path({folder!r})
    run_pool({name!r}, [pools.packed(work(folder), 1)] * 2, folder / "logs")
"""


@pytest.mark.parametrize("name", ["side_by_side", "submitit_local", "on_ray"])
def test_processes_end_with_who_started_them(name: str, tmp_path: Path) -> None:
    needs(name)
    script = tmp_path / "leader.py"
    script.write_text(SCRIPT.format(tests=str(Path(__file__).parent), folder=str(tmp_path), name=name))
    leader = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    kill = tmp_path / "1.pid"
    deadline = time.monotonic() + 60
    while not kill.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    worker = psutil.Process(int(kill.read_text()))
    leader.kill()
    leader.wait()
    assert psutil.wait_procs([worker], timeout=20)[1] == [], "a worker goes on computing for nobody"


def test_a_call_that_cannot_be_read_or_fails_is_told() -> None:
    def broken() -> None:
        raise ValueError("no such thing")

    (outcome,) = pools.side_by_side([pools.packed(broken)], 1)
    assert outcome == pools.Lost("it could not be run (ValueError: no such thing)")


def test_nothing_can_run_on_no_process_and_without_slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OptionError, match="at least one job must run at a time"):
        pools.side_by_side([], 0)
    pytest.importorskip("submitit", reason="submitit is not installed.")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ZsdtError, match="login node of the cluster"):
        pools.submitit_slurm([b""], tmp_path / "%j", 0, {})
