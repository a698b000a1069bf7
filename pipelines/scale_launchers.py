"""One small sweep through every launcher: with a worker killed in the middle, then again, then held against `basic`."""

from __future__ import annotations

import csv
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from pipelines.compare import compare_stores
from pipelines.jobs import LOG, say
from pipelines.provenance import THREAD_VARIABLES
from pipelines.sweep import parts_of
from zsdt.errors import ZsdtError

LAUNCHERS = ("basic", "side_by_side", "submitit_local", "ray")
KINDS = {"files bitwise": "bitwise", "but for times": "but for times", "summaries (not compared)": "illustration"}
VICTIM = 1  # number of the job whose worker is killed


@dataclass
class Run:
    """One run of the sweep: exit code, seconds, and per job status and reason."""

    code: int
    seconds: float
    rows: list[dict[str, str]]

    def jobs(self, status: str) -> list[str]:
        """Numbers of the jobs that ended so."""
        return [row["job"] for row in self.rows if row["status"] == status]


def through(launcher: str, outputs: Path, kill: bool) -> Run:
    """Runs the sweep through a launcher; with `kill`, the process of job `VICTIM` is killed as soon as it works.

    Raises: ZsdtError where the job to be killed never began to work.
    """
    folder = outputs / "multirun" / "tiny"
    shutil.rmtree(folder, ignore_errors=True)
    launch = [f"hydra/launcher={launcher}", f"hydra.sweep.dir={folder}", f"machine.outputs={outputs}"]
    command = [sys.executable, "-m", "pipelines", "-m", *launch, *parts_of("launchers")["tiny"]]
    outputs.mkdir(parents=True, exist_ok=True)
    environment = {**{name: "1" for name in THREAD_VARIABLES}, **os.environ}
    began = time.perf_counter()
    with (outputs / "terminal.txt").open("a") as terminal:
        process = subprocess.Popen(command, stdout=terminal, stderr=terminal, env=environment)
        try:
            if kill:
                _kill_worker(process, folder / str(VICTIM) / LOG)
            code = process.wait()
        finally:
            process.kill()
    table = folder / "sweep.csv"
    if not table.is_file():
        raise ZsdtError(f"The sweep through {launcher} made no table; see {outputs / 'terminal.txt'}.")
    with table.open(newline="") as lines:
        return Run(code, time.perf_counter() - began, list(csv.DictReader(lines)))


def _kill_worker(leader: subprocess.Popen[bytes], log: Path) -> None:
    """Kills the descendant of `leader` that writes `log`."""
    while leader.poll() is None:
        for worker in psutil.Process(leader.pid).children(recursive=True) if log.is_file() else ():
            try:
                if str(log) in (file.path for file in worker.open_files()):
                    worker.kill()
                    return
            except psutil.Error:
                continue  # it has just ended
        time.sleep(0.1)
    raise ZsdtError(f"No process has written {log}, so none could be killed.")


def compare_launchers(outputs: Path) -> list[dict[str, Any]]:
    """A row for each launcher: what the kill cost, what was said, and whether the artifacts are those of `basic`."""
    return [row_of(launcher, outputs) for launcher in LAUNCHERS]


def row_of(launcher: str, outputs: Path) -> dict[str, Any]:
    """The row of one launcher; the sweep through `basic` has to be there, below `outputs`, for the others."""
    own = outputs / launcher
    shutil.rmtree(own, ignore_errors=True)
    row: dict[str, Any] = {"launcher": launcher}
    seconds = 0.0
    if launcher != "basic":  # its only process is the sweep itself
        killed = through(launcher, own, kill=True)
        seconds = killed.seconds
        row |= {"killed: lost": len(killed.jobs("failed")), "killed: finished": len(killed.jobs("finished"))}
        reasons = [r["reason"].partition(". ")[0] for r in killed.rows if r["status"] == "failed"]
        row["what was said"] = "; ".join(reason.replace(str(own), "...") for reason in reasons)
    again = through(launcher, own, kill=False)
    row |= {"jobs": len(again.rows), "finished at last": len(again.jobs("finished"))}
    row["seconds, both"] = round(seconds + again.seconds, 1)
    if launcher != "basic":
        found = compare_stores(outputs / "basic" / "artifacts", own / "artifacts")
        row |= {name: found.counts[kind] for name, kind in KINDS.items()}
        row["files that differ"] = len(found.different)
        for name in found.different:
            say(f"{launcher}: {name} differs from basic's")
    say(f"{launcher}: {row}")
    return row
