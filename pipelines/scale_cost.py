"""What a sweep of many jobs costs, reckoned from the pieces of a finished one: core-hours, hours, disk, files.

An artifact that all jobs of a part use is made once however many jobs there are; the others are counted per job. One
that some jobs share is counted in parts: a larger sweep, whose factors have more values, costs rather less than this.
"""

from __future__ import annotations

import json
import math
import resource
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.gather import JobRecord, read_jobs
from pipelines.store import MANIFEST
from zsdt.errors import DataError

CORES = (2, 16, 64, 256, 1024)
HOUR, GB = 3600.0, 1e9


@dataclass(frozen=True)
class Piece:
    """An artifact, or a share of some: core-seconds, wall seconds of making it, bytes, files."""

    core_s: float = 0.0
    wall_s: float = 0.0
    bytes: float = 0.0
    files: float = 0.0

    def __add__(self, other: Piece) -> Piece:
        return Piece(
            self.core_s + other.core_s,
            self.wall_s + other.wall_s,
            self.bytes + other.bytes,
            self.files + other.files,
        )

    def times(self, factor: float) -> Piece:
        """So many of it."""
        return Piece(self.core_s * factor, self.wall_s * factor, self.bytes * factor, self.files * factor)


@dataclass(frozen=True)
class Part:
    """A part of a sweep: what all its jobs share, and what each adds.

    stages: core-seconds that each stage adds to a job. took_s: what its jobs took together, by their own clocks;
    built_s: what the artifacts took that they built. start_s: core-seconds of a process until its job begins.
    """

    name: str
    jobs: int
    shared: Piece
    own: Piece
    stages: dict[str, float]
    took_s: float
    built_s: float
    start_s: float

    def row(self) -> dict[str, Any]:
        """The pieces."""
        row: dict[str, Any] = {"part": self.name, "jobs": self.jobs}
        for name, piece in (("shared", self.shared), ("a job's own", self.own)):
            row |= {
                f"{name}: core-s": round(piece.core_s, 1),
                f"{name}: MB": round(piece.bytes / 1e6, 2),
                f"{name}: files": round(piece.files, 1),
            }
        own = ", ".join(f"{name} {seconds:.3g}" for name, seconds in self.stages.items())
        row |= {"core-s of a job's own stages": own, "start of a process, core-s": round(self.start_s, 1)}
        return row | {"these jobs took, s": round(self.took_s, 1), "of it building, s": round(self.built_s, 1)}

    def reckoning(self, jobs: int) -> dict[str, Any]:
        """What `jobs` such jobs cost. Each core runs one job at a time; the shared pieces come first."""
        each = self.own.core_s + self.start_s
        all_of_it = self.shared + self.own.times(jobs)
        row: dict[str, Any] = {
            "part": self.name,
            "jobs": jobs,
            "core-h": (all_of_it.core_s + jobs * self.start_s) / HOUR,
            "core-h if nothing were shared": jobs * (self.shared.core_s + each) / HOUR,
            "GB": all_of_it.bytes / GB,
            "GB if nothing were shared": jobs * (self.shared.bytes + self.own.bytes) / GB,
            "files": round(all_of_it.files),
        }
        for cores in CORES:
            seconds = self.shared.wall_s + math.ceil(jobs / cores) * (self.own.wall_s + self.start_s)
            row[f"h on {cores:,} cores"] = seconds / HOUR
        return row


def parts_below(sweep: Path) -> list[list[JobRecord]]:
    """The parts of a sweep whose jobs are all of one experiment, at least two of them, and all finished.

    Raises: DataError where there is none.
    """
    parts: dict[Path, list[JobRecord]] = {}
    for job in read_jobs(sweep):
        parts.setdefault(job.folder.parent, []).append(job)
    found = [
        jobs
        for jobs in parts.values()
        if len(jobs) > 1 and len({job.experiment for job in jobs}) == 1 and all(job.finished for job in jobs)
    ]
    if not found:
        raise DataError(f"No part of {sweep} has two finished jobs of one experiment; name another one with --sweep.")
    return found


def pieces_of(jobs: list[JobRecord], start_s: float | None = None) -> Part:
    """The pieces of one part. start_s: core-seconds of a process until its job begins (measured if not given).

    Raises: DataError where an artifact of a job is not there any more.
    """
    labels: dict[Path, set[str]] = {}
    uses: Counter[Path] = Counter()
    built: set[Path] = set()
    for job in jobs:
        places = {label: (job.folder / stage["artifact"]).resolve() for label, stage in job.summary["stages"].items()}
        uses.update(set(places.values()))
        built |= {places[label] for label, stage in job.summary["stages"].items() if not stage["reused"]}
        for label, folder in places.items():
            labels.setdefault(folder, set()).add(label)
    pieces = {folder: piece_of(folder) for folder in uses}
    shared = sum((piece for folder, piece in pieces.items() if uses[folder] == len(jobs)), Piece())
    own, stages = Piece(), dict[str, float]()
    for folder, piece in pieces.items():
        if uses[folder] < len(jobs):
            own += piece.times(1.0 / len(jobs))
            label = min(labels[folder])
            stages[label] = stages.get(label, 0.0) + piece.core_s / len(jobs)
    for job in jobs:
        own += _folder(job.folder).times(1.0 / len(jobs))
    return Part(
        name=jobs[0].folder.parent.name,
        jobs=len(jobs),
        shared=shared,
        own=own,
        stages=stages,
        took_s=sum(float(job.summary["seconds"]) for job in jobs),
        built_s=sum(pieces[folder].wall_s for folder in built),
        start_s=start_seconds() if start_s is None else start_s,
    )


def piece_of(folder: Path) -> Piece:
    """Cost of an artifact as its manifest tells it: data count the processor time of all their workers, everything
    else ran on one thread."""
    if not (folder / MANIFEST).is_file():
        raise DataError(f"{folder} is gone, so what it cost is not known; run the sweep again.")
    manifest = json.loads((folder / MANIFEST).read_text())
    wall = float(manifest["wall_seconds"])
    core = float(manifest["figures"].get("cpu_s", wall))
    return _folder(folder) + Piece(core_s=core, wall_s=wall)


def _folder(folder: Path) -> Piece:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return Piece(bytes=float(sum(path.stat().st_size for path in files)), files=float(len(files)))


def start_seconds() -> float:
    """Processor seconds of a fresh process until it knows the stages of this program."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", "import pipelines.registry, torch, lightning"], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def commits_of(sweep: Path) -> str:
    """At which commits the artifacts of a sweep were made."""
    found = set()
    for job in read_jobs(sweep):
        for label in job.summary["stages"]:
            found.add(str(job.manifest(label).get("git_commit", "unknown"))[:12])
    return "commit " + ", ".join(sorted(found))
