"""`python -m pipelines.sweep [NAME] [KEY=VALUE ...]`: the multiruns of conf/sweep/NAME.yaml, then table and report.

Every part is a plain `python -m pipelines -m hydra/launcher=side_by_side ...`, so that what `make sweep` does can be
typed by hand. Further overrides go to every part. Exits with 1 if a job failed.
"""

from __future__ import annotations

import datetime
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import yaml

from pipelines.collect import Table, collect
from pipelines.jobs import say
from pipelines.provenance import THREAD_VARIABLES
from pipelines.report import write_report
from pipelines.stages import suggestion
from zsdt.errors import OptionError, ZsdtError
from zsdt.lifeline import adopt_children

SWEEPS = Path(__file__).resolve().parents[1] / "conf" / "sweep"
LAUNCHER = "hydra/launcher=side_by_side"


def parts_of(name: str) -> dict[str, list[str]]:
    """Parts of a sweep: name -> overrides. Under `borrowed` a sweep names parts of others, as SWEEP.PART.

    Raises: OptionError where there is no such sweep.
    """
    path = SWEEPS / f"{name}.yaml"
    if not path.is_file():
        raise OptionError(f"There is no sweep '{name}'{suggestion(name, [p.stem for p in SWEEPS.glob('*.yaml')])}")
    content = yaml.safe_load(path.read_text())
    parts = {part: list(overrides) for part, overrides in content.get("parts", {}).items()}
    for other in content.get("borrowed", []):
        sweep, _, part = other.partition(".")
        parts[f"{sweep}_{part}"] = parts_of(sweep)[part]
    return parts


def command_of(overrides: Sequence[str], folder: Path, extra: Sequence[str]) -> list[str]:
    """The command line of one part."""
    launcher = [] if any(word.startswith("hydra/launcher=") for word in extra) else [LAUNCHER]
    return [sys.executable, "-m", "pipelines", "-m", *launcher, f"hydra.sweep.dir={folder}", *overrides, *extra]


def outputs_of(extra: Sequence[str]) -> Path:
    """Folder of all runs, as the command line names it."""
    named = [word.partition("=")[2] for word in extra if word.startswith("machine.outputs=")]
    return Path(named[-1] if named else "outputs")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs all parts, collects, reports; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    name = words.pop(0) if words and "=" not in words[0] else "all"
    try:
        parts = parts_of(name)
        began = time.perf_counter()
        root = outputs_of(words) / "multirun" / f"{datetime.datetime.now():%Y-%m-%d_%H-%M-%S}_{name}"
        broken = [part for part, overrides in parts.items() if not run_part(part, overrides, root, words)]
        if not root.is_dir():
            return 1
        table = collect(root)
        tell(table, root)
        say(f"Report: {write_report(root, outputs_of(words) / 'reports')}")
        say(f"The sweep took {(time.perf_counter() - began) / 60:.1f} minutes.")
    except ZsdtError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 1 if broken or table.failed() else 0


def run_part(part: str, overrides: Sequence[str], root: Path, extra: Sequence[str]) -> bool:
    """Runs one part; whether it ended well."""
    adopt_children()
    environment = {**{name: "1" for name in THREAD_VARIABLES}, **os.environ}
    command = command_of(overrides, root / part, extra)
    say(f"\n{part}: {' '.join(['python', *command[1:]])}")
    return subprocess.run(command, env=environment).returncode == 0


def tell(table: Table, root: Path) -> None:
    """The table of all parts, and the names of failed jobs."""
    say(table.text())
    for job, reason in table.failed():
        print(f"failed: {job}: {reason}", file=sys.stderr)
    say(f"Tables: {root}/sweep.csv, {root}/sweep.md")


if __name__ == "__main__":
    sys.exit(main())
