"""One job: the stages of one config, run through the store, and the folder that says what came out.

The folder of a job (below outputs/runs or outputs/multirun) holds `config.yaml` (resolved), `summary.json` (status,
stages with keys and places of their artifacts, figures), `error.txt` of a failed job, `log.txt` of a job in a sweep.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from pipelines.provenance import make_deterministic, provenance
from pipelines.stages import Planner, Task
from pipelines.store import Artifact, Store, disk_error, plain, write_json
from zsdt.errors import ZsdtError

SUMMARY = "summary.json"
ERROR = "error.txt"
LOG = "log.txt"


def run_job(
    config: DictConfig, planner: Planner, folder: Path, overrides: Sequence[str], tag: str = ""
) -> dict[str, Any]:
    """Runs the wanted stages and keeps the summary of the job in `folder`; returns the summary.

    tag: how the lines of this job begin, where it is one of several; what its stages print goes to `log.txt` then.

    Raises: whatever a stage raises, after it was recorded.
    """
    machine = config.machine
    store = Store(Path(machine.outputs).resolve() / "artifacts")
    summary: dict[str, Any] = {
        "status": "running",
        "experiment": config.name,
        "overrides": list(overrides),
        "stages": {},
        "figures": {},
    }
    began = time.perf_counter()
    try:
        write_json(folder / SUMMARY, summary)
        (folder / "config.yaml").write_text(OmegaConf.to_yaml(config, resolve=True))
        done: dict[str, Artifact] = {}
        for task in without_spare_pieces(planner.plan(config), store):
            artifact = run_task(task, store, done, machine.threads, tag, folder / LOG if tag else None)
            done[task.key] = artifact
            place = os.path.relpath(artifact.path, folder)
            summary["stages"][task.label] = {
                "key": artifact.key,
                "artifact": place,
                "reused": artifact.reused,
                "seconds": round(artifact.seconds, 3),
            }
            summary["figures"][task.label] = artifact.manifest["figures"]
        summary["status"] = "finished"
    except BaseException as error:
        summary["status"] = "failed"
        summary["error"] = sentence_of(error)
        record_error(folder, error)
        if isinstance(error, OSError):
            raise disk_error(folder, error) from error
        raise
    finally:
        summary["seconds"] = round(time.perf_counter() - began, 3)
        keep_summary(folder, summary)
    return summary


def without_spare_pieces(tasks: list[Task], store: Store) -> list[Task]:
    """The tasks without the pieces of what is there as a whole."""
    whole = [task for task in tasks if task.pieces and store.find(task.shelf, task.key)]
    spare = {piece.label for task in whole for piece in task.pieces.values()}
    return [task for task in tasks if task.label not in spare]


def run_task(
    task: Task, store: Store, done: dict[str, Artifact], threads: int, tag: str = "", log: Path | None = None
) -> Artifact:
    """The artifact of one task, with one line on the terminal that says what, key, reused or built, seconds.

    What the stage prints goes to the file `log` if there is one.
    """
    settings = task.settings()
    before = task.inputs | {role: piece for role, piece in task.pieces.items() if piece.key in done}
    inputs = {role: done[other.key].path for role, other in before.items()} | task.folders
    head = f"{tag}{task.label:<16} {task.key}"

    def build(out: Path, scratch: Path) -> dict[str, Any]:
        say(f"{head} is being built ...")
        make_deterministic(int(task.key, 16) % 2**32, threads)
        with into_log(log):
            return plain(task.stage.run(settings, inputs, out, scratch))

    def manifest() -> dict[str, Any]:
        return {
            "stage": task.stage.name,
            "version": task.stage.version,
            "key": task.key,
            "config": task.read,
            "inputs": {role: other.key for role, other in before.items()},
            "seed": int(task.key, 16) % 2**32,
            **provenance(),
        }

    artifact = store.obtain(task.shelf, task.key, build, manifest, lambda: say(f"{head} waits: another job builds it"))
    place = os.path.relpath(artifact.path)
    say(f"{head} {'reused' if artifact.reused else 'built'} in {artifact.seconds:.1f} s, in {place}")
    return artifact


@contextmanager
def into_log(path: Path | None) -> Iterator[None]:
    """Sends what is printed and logged to the end of a file, so that jobs side by side do not talk at once."""
    if path is None:
        yield
        return
    with path.open("a") as file, redirect_stdout(file), redirect_stderr(file):
        handlers = [h for h in logging.getLogger().handlers if type(h) is logging.StreamHandler]
        before = [handler.setStream(file) for handler in handlers]
        try:
            yield
        finally:
            for handler, stream in zip(handlers, before, strict=True):
                handler.setStream(stream)


def say(line: str) -> None:
    """One line for the person at the terminal, at once."""
    sys.stdout.write(line + "\n")  # one write, so that lines of jobs side by side do not mix
    sys.stdout.flush()


def sentence_of(error: BaseException) -> str:
    """What a person reads of an error: its own sentence if it was raised on purpose."""
    if isinstance(error, ZsdtError):
        return str(error)
    if isinstance(error, KeyboardInterrupt):
        return "Interrupted; run the same command again to go on."
    return f"Unexpected {type(error).__name__}: {error}".strip()


def record_loss(folder: Path, experiment: str, overrides: Sequence[str], reason: str) -> str:
    """Keeps in the summary of a job that it was lost (half a sentence says how); returns the sentence for a person.

    What the job had noted before is kept; where it never began, a summary is made.
    """
    sentence = f"Lost: {reason}. The others went on; run the same sweep again, what is finished is reused."
    path = folder / SUMMARY
    summary: dict[str, Any] = {"experiment": experiment, "overrides": list(overrides), "stages": {}, "figures": {}}
    if path.is_file():
        summary |= json.loads(path.read_text())
    keep_summary(folder, summary | {"status": "failed", "error": sentence})
    _try(lambda: (folder / ERROR).write_text(sentence + "\n"), folder / ERROR)
    return sentence


def record_error(folder: Path, error: BaseException) -> None:
    """Keeps the sentence and, below it, the trace in `error.txt`."""
    trace = "".join(traceback.format_exception(error))
    _try(lambda: (folder / ERROR).write_text(f"{sentence_of(error)}\n\n{trace}"), folder / ERROR)


def keep_summary(folder: Path, summary: dict[str, Any]) -> None:
    """Writes the summary; on a disk that takes nothing any more it says so and goes on to the error itself."""
    _try(lambda: write_json(folder / SUMMARY, summary), folder / SUMMARY)


def _try(write: Callable[[], Any], path: Path) -> None:
    try:
        write()
    except (OSError, ZsdtError):
        say(f"{path} could not be written.")
