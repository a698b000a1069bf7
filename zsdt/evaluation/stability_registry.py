"""All hard cases by their names, and how one of them is run: never longer than its limit, never without a row."""

from __future__ import annotations

import hashlib
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from zsdt.errors import OptionError, RunRejected, ZsdtError
from zsdt.evaluation.stability_beam_cases import BEAM_CASES
from zsdt.evaluation.stability_camera_cases import CAMERA_CASES
from zsdt.evaluation.stability_glass_cases import GLASS_CASES
from zsdt.evaluation.stability_row import Outcome, Party, Row, read_row, write_row
from zsdt.evaluation.stability_trust import flags_by
from zsdt.shipped import TwinWeights, shipped
from zsdt.twin.trust_limits import CARD

WAIT = 10.0  # wall time over processor time, from which a run hangs
VERSION = 2  # of what the rows mean: older ones are made again
CASES: dict[str, Any] = {case.name: case for case in (*BEAM_CASES, *GLASS_CASES, *CAMERA_CASES)}
CI = ("normal_release", "impulse", "nan_state")  # a few seconds


def case_named(name: str) -> Any:
    """The case of a name. Raises: OptionError with the names there are."""
    if name not in CASES:
        raise OptionError(f"There is no hard case '{name}'; there are {', '.join(CASES)}.")
    return CASES[name]


@dataclass
class StabilityOptions:
    """cases: names, all if empty. parties: who runs them. soft_beam, soft_glass: folders of trained networks of the
    seed's form (None: nobody runs as `soft`), which are trusted within the limits of the shipped ones. limit_s: seconds
    of processor time after which a run counts as a hang. again: runs cases of which there are rows, too."""

    cases: list[str] = field(default_factory=list)
    parties: list[Party] = field(default_factory=lambda: list(Party))
    soft_beam: str | None = None
    soft_glass: str | None = None
    limit_s: float = 600.0
    again: bool = False

    def __post_init__(self) -> None:
        for name in self.cases:
            case_named(name)
        if self.limit_s <= 0:
            raise OptionError("limit_s must be positive.")


@dataclass(frozen=True)
class Job:
    """One case by one party; `key` changes with whatever its row depends on."""

    case: Any
    party: Party
    soft: str | None
    limit_s: float

    @property
    def name(self) -> str:
        """Name of the job and of its row's file."""
        return f"{self.case.name}.{self.party.value}"

    @property
    def weights(self) -> TwinWeights:
        """What the network and the twin of this kind of body run with."""
        scene = "foam_beam" if self.case.kind in ("beam", "camera") else "glycerin_glass"
        return TwinWeights(shipped(scene, "tignn"), shipped(scene, "psi_ini"), shipped(scene, "vision"))

    @property
    def key(self) -> str:
        """Hash of the case, the party and the weights, but not of the limits of trust, which rows are read by anew."""
        text = hashlib.sha256(f"{VERSION} {self.case!r} {self.party.value}".encode())
        for folder in (self.weights.tignn, *([Path(self.soft)] if self.soft else [])):
            for file in sorted(p for p in folder.iterdir() if p.suffix in (".json", ".pt") and p.name != CARD):
                text.update(file.read_bytes())
        return text.hexdigest()[:12]


def jobs_of(options: StabilityOptions) -> list[Job]:
    """Every case by every party that takes part in it."""
    found = []
    for name in options.cases or list(CASES):
        case = CASES[name]
        soft = options.soft_glass if case.kind == "glass" else options.soft_beam
        for party in options.parties:
            if party in parties_of(case) and (party is not Party.soft or soft is not None):
                found.append(Job(case, party, soft if party is Party.soft else None, options.limit_s))
    return found


def parties_of(case: Any) -> tuple[Party, ...]:
    """Who can take part: cameras exist for twins alone."""
    return (Party.twin,) if case.kind == "camera" else tuple(Party)


def known_row(folder: Path, job: Job) -> Row | None:
    """The row of a job that an earlier run left, if it still holds, with the flags of today's limits."""
    path = row_path(folder, job)
    if not path.is_file():
        return None
    row = read_row(path)
    row.flags = flags_by(job.weights.tignn, row.flags, row.gauges, alone=job.party is not Party.twin)
    return row


def row_path(folder: Path, job: Job) -> Path:
    """File of the row of a job."""
    return folder / f"{job.name}.{job.key}.json"


class Hang(Exception):
    """A run took longer than it may."""


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raises Hang in the block after so many seconds of processor time, or WAIT times as many of wall time: a busy
    machine is no hang (main thread only, as workers are)."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise Hang(f"took longer than {seconds:g} s")

    clocks = ((signal.SIGPROF, signal.ITIMER_PROF, seconds), (signal.SIGALRM, signal.ITIMER_REAL, WAIT * seconds))
    before = [signal.signal(number, stop) for number, _, _ in clocks]
    for _, clock, limit in clocks:
        signal.setitimer(clock, limit)
    try:
        yield
    finally:
        for (number, clock, _), handler in zip(clocks, before, strict=True):
            signal.setitimer(clock, 0.0)
            signal.signal(number, handler)


def run_case(jobs: list[Job], folder: str) -> dict[str, Any]:
    """Runs jobs of one case one after the other, so that its truth is computed once; party -> outcome and reason."""
    return {job.party.value: run_job(job, folder) for job in jobs}


def run_job(job: Job, folder: str) -> dict[str, Any]:
    """Runs a job and writes its row; the row's outcome and reason. A crash is a row, too: the table must show it."""
    began = time.perf_counter()
    try:
        with limited(job.limit_s):
            row = _run(job, Path(folder))
    except ZsdtError as error:
        cause = error.cause if isinstance(error, RunRejected) else "refused"
        row = _row(job, Outcome.rejected, f"{cause}: {error}")
    except Hang as error:
        row = _row(job, Outcome.failed, f"hang: {error}")
    except Exception as error:  # whatever it is, it is what this table is made to find
        row = _row(job, Outcome.failed, f"crash: {type(error).__name__}: {error}")
    row.seconds = time.perf_counter() - began
    for old in Path(folder).glob(f"{job.name}.*.json"):
        old.unlink()
    write_row(row_path(Path(folder), job), row)
    return {"outcome": row.outcome, "reason": row.reason}


def _row(job: Job, outcome: Outcome, reason: str) -> Row:
    return Row(job.case.name, job.case.kind, job.party.value, outcome, reason, getattr(job.case, "frames", 0))


_KEPT: dict[str, Any] = {}  # the truth of the case that was run last in this process


def truth_of(job: Job) -> Any:
    """What the solver says of the job's case. Raises: RunRejected where it has no first frame."""
    if job.case.name not in _KEPT:
        from zsdt.evaluation.stability_beams import beam_truth
        from zsdt.evaluation.stability_glass_truth import glass_truth

        _KEPT.clear()
        _KEPT[job.case.name] = (beam_truth if job.case.kind == "beam" else glass_truth)(job.case)
    return _KEPT[job.case.name]


def _run(job: Job, folder: Path) -> Row:
    if job.case.kind == "camera":
        from zsdt.evaluation.stability_cameras import clip_in, run_camera

        return run_camera(job.case, clip_in(folder.parent / "clips"), job.weights)
    if job.case.kind == "beam":
        from zsdt.evaluation.stability_beams import run_beam

        return run_beam(job.case, job.party, truth_of(job), job.weights, job.soft)
    from zsdt.evaluation.stability_glasses import run_glass

    return run_glass(job.case, job.party, truth_of(job), job.weights, job.soft)
