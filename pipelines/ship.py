"""`python -m pipelines.ship SCENE JOB ... [--part NAME FOLDER]`: trained weights into the package, with a model card.

JOB is the folder of a finished job (below outputs/runs or outputs/multirun); each part is taken from the first job that
has it. `--part vision FOLDER` takes a part from a folder of weights that the library trained outside of a job. The card
is written from the manifests, or from the card beside the weights: data, options, figures, commit; nothing by hand.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipelines.collect import flat
from pipelines.gather import JobRecord, read_jobs
from pipelines.store import MANIFEST
from zsdt.errors import DataError, ZsdtError
from zsdt.files import atomic_path
from zsdt.shipped import LARGEST, PARTS, WEIGHTS
from zsdt.twin.trust_limits import CARD, digest, load_limits

STAGES = {part: f"train_{part}" for part in PARTS}
LEFT = (MANIFEST, "training.csv", "stages")  # what a run needs and a user of the weights does not
NOTE = "## Limits of trust"
JUDGES = ("evaluate", "evaluate_twin")


def ship(
    scene: str, job_folders: Sequence[Path], weights: Path = WEIGHTS, parts: Mapping[str, Path] | None = None
) -> Path:
    """Copies the weights of the jobs below `weights`/`scene` and writes the card; returns the folder.

    parts: name -> folder of weights that come from no job.

    Raises: DataError where a job did not finish, no job has a part, or a part is larger than `LARGEST`.
    """
    jobs = [_job_in(folder) for folder in job_folders]
    makers: dict[str, JobRecord | Path] = {**(parts or {})}
    for part, stage in STAGES.items():
        if part in makers:
            continue
        able = [job for job in jobs if job.artifact(stage) is not None]
        if not able:
            raise DataError(f"None of the jobs has run {stage}; name one that has.")
        makers[part] = able[0]
    old = weights / f".{scene}.old"
    with atomic_path(weights / f".{scene}.new") as beside:
        for part, maker in makers.items():
            folder = maker if isinstance(maker, Path) else maker.artifact(STAGES[part])
            shutil.copytree(str(folder), beside / part, ignore=shutil.ignore_patterns(*LEFT))
            size = sum(path.stat().st_size for path in (beside / part).rglob("*") if path.is_file())
            if size > LARGEST:
                raise DataError(f"{STAGES[part]} is {size / 1e6:.1f} MB; at most {LARGEST / 1e6:g} MB are shipped.")
        keep_limits(weights / scene / "tignn", beside / "tignn")
        (beside / "MODEL_CARD.md").write_text(card(scene, makers))
        note_limits(beside)
    # A folder cannot be moved onto one that is there, so the old one steps aside first.
    shutil.rmtree(old, ignore_errors=True)
    if (weights / scene).exists():
        os.replace(weights / scene, old)
    os.replace(weights / f".{scene}.new", weights / scene)
    shutil.rmtree(old, ignore_errors=True)
    return weights / scene


def keep_limits(old: Path, new: Path) -> None:
    """Copies the limits of trust of an engine to where the same engine is shipped anew; another one has none yet."""
    if (old / CARD).is_file() and not (new / CARD).exists() and digest(old) == digest(new):
        shutil.copy(old / CARD, new / CARD)


def note_limits(folder: Path) -> None:
    """Says in the model card of `folder` where the training's range of the engine is, if it is there."""
    page, limits = folder / "MODEL_CARD.md", load_limits(folder / "tignn")
    if limits is None or not page.is_file():
        return
    text = page.read_text().partition(NOTE)[0].rstrip("\n")
    about = [f"- {name}: {json.dumps(value)}" for name, value in limits.about.items() if name != "normal_runs"]
    lines = [
        text, "", NOTE, "",
        f"`tignn/{CARD}`: range of the training data of {len(limits.training)} values (sizes, material, strains, "
        "rates, speeds, loads, distances), that of normal runs, and the limits of both (`zsdt.twin.trust_limits`).",
        "", *about,
    ]  # fmt: skip
    with atomic_path(page) as beside:
        beside.write_text("\n".join(lines) + "\n")


def _job_in(folder: Path) -> JobRecord:
    jobs = read_jobs(folder)
    if len(jobs) != 1 or not jobs[0].finished:
        raise DataError(f"{folder} is not the folder of one finished job; name one below outputs/runs or multirun.")
    return jobs[0]


def card(scene: str, makers: Mapping[str, JobRecord | Path]) -> str:
    """The model card of the weights: part -> the job that made it, or the folder that they come from."""
    lines = [f"# Weights of {scene}", "", "Virtual lab and simulations only; no real pictures were used."]
    for part, job in makers.items():
        stage = STAGES[part]
        if isinstance(job, Path):
            lines += ["", f"## {part}", "", f"What the library's stage `{stage}` calls, called without a job.", ""]
            for path in sorted(job.glob("*.json")):
                lines += _options(json.loads(path.read_text()))
            continue
        manifest = job.manifest(stage)
        lines += [
            "",
            f"## {part}",
            "",
            f"`python -m pipelines experiment={job.experiment}`, stage `{stage}`, artifact {manifest['key']}, commit "
            f"{manifest['git_commit'][:12]}, {manifest['wall_seconds'] / 60:.1f} minutes on {manifest['machine']}.",
            "",
            *_options(manifest["config"]),
            "",
            *_figures(manifest["figures"]),
        ]
    for job in {job.folder: job for job in makers.values() if isinstance(job, JobRecord)}.values():
        if data := job.manifest("synthesize"):
            lines += ["", f"## Data of {job.experiment} (`synthesize`, {data['key']})", "", *_options(data["config"])]
        for stage in JUDGES:
            if figures := job.summary["figures"].get(stage):
                lines += ["", f"## Judged by `{stage}` of {job.experiment}", "", *_figures(figures)]
    return "\n".join(lines) + "\n"


def _options(config: dict[str, Any]) -> list[str]:
    return [f"- {name}: {json.dumps(value)}" for name, value in flat_options(config).items()]


def flat_options(config: dict[str, Any], before: str = "") -> dict[str, Any]:
    """Options as dotted names."""
    found: dict[str, Any] = {}
    for name, value in config.items():
        found |= flat_options(value, f"{before}{name}.") if isinstance(value, dict) else {f"{before}{name}": value}
    return found


def _figures(figures: dict[str, Any]) -> list[str]:
    rows = [f"| {n} | {v:.5g} |" if isinstance(v, float) else f"| {n} | {v} |" for n, v in flat(figures).items()]
    return ["| figure | value |", "|---|---|", *rows]


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; one clear sentence where something is missing."""
    parser = argparse.ArgumentParser(prog="python -m pipelines.ship", description=__doc__)
    parser.add_argument("scene", help="name of the scene, such as foam_beam")
    parser.add_argument("jobs", type=Path, nargs="+", help="folders of finished jobs")
    parser.add_argument("--part", nargs=2, action="append", default=[], metavar=("NAME", "FOLDER"))
    words = parser.parse_args(arguments)
    parts = {name: Path(folder) for name, folder in words.part}
    try:
        if unknown := sorted(set(parts) - set(PARTS)):
            raise DataError(f"There is no part '{unknown[0]}'; parts are {', '.join(PARTS)}.")
        folder = ship(words.scene, words.jobs, parts=parts)
    except ZsdtError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            print(f"{path.stat().st_size:9d} {path.relative_to(folder.parent)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
