"""A stand-in for the commands of Slurm that a launcher needs, on one machine: `install(folder)` puts them there.

`sbatch FILE` keeps the script and starts each task of its array as a process at once; `sacct` tells their states from
the files `<job>_<task>.pid` and `<job>_<task>.code`; `srun` runs the command of a task. Resources are not read.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path

COMMANDS = ("sbatch", "srun", "sacct", "scancel")


def install(folder: Path) -> None:
    """Writes the commands into `folder`, which has to stand in PATH."""
    folder.mkdir(parents=True)
    for name in COMMANDS:
        path = folder / name
        path.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} {shlex.quote(__file__)} {name} "$@"\n')
        path.chmod(0o755)


def tasks_of(script: Path) -> list[str]:
    """Numbers of the tasks of a job: ``1000_0``, ``1000_1``, ... of an array, else ``1000``."""
    last = re.search(r"#SBATCH --array=0-(\d+)", script.read_text())
    return [f"{script.stem}_{k}" for k in range(int(last.group(1)) + 1)] if last else [script.stem]


def sbatch(home: Path, script: Path) -> None:
    """Starts all tasks of a job, as if there were a core for each."""
    job = str(1000 + len(list(home.glob("*.sbatch"))))
    kept = home / f"{job}.sbatch"
    kept.write_text(script.read_text())
    for number in tasks_of(kept):
        variables = {"SLURM_JOB_ID": job, "SLURM_PROCID": "0", "SLURM_JOB_NODELIST": "node1", "FAKE_TASK": number}
        variables |= {"SLURM_NTASKS": "1", "SLURM_JOB_NUM_NODES": "1", "SLURM_NODEID": "0", "SLURM_LOCALID": "0"}
        if "_" in number:
            variables |= {"SLURM_ARRAY_JOB_ID": job, "SLURM_ARRAY_TASK_ID": number.partition("_")[2]}
        command = [sys.executable, __file__, "task", str(kept)]
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "stdin": subprocess.DEVNULL}
        subprocess.Popen(command, env=os.environ | variables, start_new_session=True, **silent)
    print(f"Submitted batch job {job}")


def task(home: Path, script: Path) -> None:
    """One task of an array, to its end."""
    code = subprocess.run(["bash", str(script)]).returncode
    beside = home / f"{os.environ['FAKE_TASK']}.writing"
    beside.write_text(str(code))
    beside.rename(home / f"{os.environ['FAKE_TASK']}.code")  # sacct never reads half of it


def srun(home: Path, words: list[str]) -> int:
    """Runs what follows the options of srun, with its output in the files that they name."""
    at = next(k for k, word in enumerate(words) if word.endswith("python") or Path(word).name.startswith("python"))
    job, _, number = os.environ["FAKE_TASK"].partition("_")
    names = {"%A": job, "%a": number, "%j": job, "%t": "0"}
    files = {}
    for option in ("--output", "--error"):
        path = words[words.index(option) + 1]
        for mark, value in names.items():
            path = path.replace(mark, value)
        _appear(Path(path).parent)
        files[option] = open(path, "a")  # noqa: SIM115  (open until this process ends)
    done = subprocess.Popen(words[at:], stdout=files["--output"], stderr=files["--error"])
    (home / f"{os.environ['FAKE_TASK']}.pid").write_text(str(done.pid))
    return done.wait()


def _appear(folder: Path, patience_s: float = 60.0) -> None:
    """Waits for a folder that submitit makes only after sbatch has returned; a queue gives it the time."""
    until = time.monotonic() + patience_s
    while not folder.is_dir() and time.monotonic() < until:
        time.sleep(0.05)


def sacct(home: Path) -> None:
    """States of all tasks."""
    print("JobID|State|NodeList")
    for number in [number for script in home.glob("*.sbatch") for number in tasks_of(script)]:
        code = home / f"{number}.code"
        state = "RUNNING" if not code.exists() else "COMPLETED" if code.read_text() == "0" else "FAILED"
        print(f"{number}|{state}|node1")


if __name__ == "__main__":
    name, arguments = sys.argv[1], sys.argv[2:]
    place = Path(os.environ["FAKE_SLURM"])
    if name == "sbatch":
        sbatch(place, Path(arguments[-1]))
    elif name == "task":
        task(place, Path(arguments[0]))
    elif name == "srun":
        sys.exit(srun(place, arguments))
    elif name == "sacct":
        sacct(place)
