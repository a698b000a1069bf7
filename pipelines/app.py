"""The command line: `python -m pipelines` for one job, `python -m pipelines -m` for a sweep of jobs."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from pipelines.collect import LastSweep, collect
from pipelines.compose import CONFIG_NAME, Application
from pipelines.jobs import run_job, say, sentence_of
from pipelines.provenance import set_thread_environment
from zsdt.errors import ZsdtError
from zsdt.lifeline import adopt_children, follow_parent

QUESTIONS = {
    "--help",
    "-h",
    "--hydra-help",
    "--cfg",
    "-c",
    "--info",
    "-i",
    "--resolve",
    "--version",
    "--shell-completion",
}


def main(application: Application, arguments: Sequence[str] | None = None) -> int:
    """Runs a command line; returns the exit code (0: all went well, 1: something failed and was named)."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    follow_parent()
    adopt_children()
    for flag in {"-m", "--multirun"} & set(arguments):
        arguments.remove(flag)  # argparse wants it before the overrides
        arguments.insert(0, flag)
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors come back here and are told in one sentence
    try:
        if not QUESTIONS & {argument.split("=")[0] for argument in arguments}:
            multirun = bool({"-m", "--multirun"} & set(arguments))
            config = application.check([a for a in arguments if not a.startswith("-")], multirun)
            set_thread_environment(config.machine.threads)
        return _run(application, arguments)
    except (ZsdtError, KeyboardInterrupt) as error:
        return _complain(sentence_of(error))
    except (HydraException, OmegaConfBaseException) as error:
        return _complain(application.explain(error, [a for a in arguments if not a.startswith("-")]))
    except Exception as error:  # a bug: name it, the trace is in error.txt
        return _complain(f"{sentence_of(error)} (the trace is in error.txt of the run's folder)")


def _complain(sentence: str) -> int:
    print(f"error: {sentence}", file=sys.stderr, flush=True)
    return 1


def _run(application: Application, arguments: Sequence[str]) -> int:
    application.register()
    LastSweep.folder = None
    failures: list[Exception] = []

    @hydra.main(version_base="1.3", config_path=str(application.conf.resolve()), config_name=CONFIG_NAME)
    def entry(config: DictConfig) -> float | None:
        try:
            return _one_job(application, config)
        except Exception as error:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                raise
            failures.append(error)  # Hydra would talk about it; it is told once, by main
            return None

    before, sys.argv = sys.argv, ["python -m pipelines", *arguments]
    try:
        entry()
    finally:
        sys.argv = before
    if failures:
        raise failures[0]
    if LastSweep.folder is None:
        return 0
    return _end_of_sweep(LastSweep.folder)


def _one_job(application: Application, config: DictConfig) -> float | None:
    """The job of one config; in a sweep a failure is recorded and told, and the others go on."""
    follow_parent()
    application.register()  # a worker of a launcher starts with an empty store of schemas
    hydra_config = HydraConfig.get()
    folder = Path(hydra_config.runtime.output_dir)
    overrides = list(hydra_config.overrides.task)
    in_sweep = hydra_config.mode == RunMode.MULTIRUN
    tag = f"[{hydra_config.job.num}] " if in_sweep else ""
    say(f"{tag}{config.name}: {' '.join(overrides)} -> {os.path.relpath(folder)}")
    try:
        summary = run_job(config, application.planner(), folder, overrides, tag)
    except Exception as error:
        if not in_sweep:
            raise
        say(f"{tag}failed: {sentence_of(error)}")
        return float("nan")
    return objective_of(summary, config.objective)


def objective_of(summary: dict, path: str) -> float | None:
    """The figure that a search minimises: a dotted path into the figures of the summary."""
    value = summary["figures"]
    for name in path.split("."):
        if not isinstance(value, dict) or name not in value:
            return None
        value = value[name]
    return float(value)  # type: ignore[arg-type]


def _end_of_sweep(folder: Path) -> int:
    table = collect(folder)
    say(table.text())
    failed = table.failed()
    for name, reason in failed:
        print(f"failed: {name}: {reason}", file=sys.stderr, flush=True)
    return 1 if failed else 0
