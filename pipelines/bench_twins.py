"""`python -m pipelines.bench_twins`: frame times of both twins by part, side by side, over clips of the virtual lab.

Takes the newest clips of each kind below the outputs folder (`make sweep` and `make demo` film some), or those named.
Threads are those of OpenCV, torch and OpenVINO; BLAS has one. CSV and Markdown go into outputs/reports/bench_twins,
with `--publish` into docs/results/bench_twins as well. Needs a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from pipelines.provenance import commit_words, set_thread_environment
from pipelines.publish import copy_report
from zsdt.errors import DataError, ZsdtError

ROOT = Path(__file__).resolve().parents[1]
SCHEMAS = {"zsdt.glass_clip": "glass", "zsdt.clip": "beam"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Times, writes and prints the page; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m pipelines.bench_twins", description=__doc__)
    parser.add_argument("--outputs", type=Path, default=Path("outputs"), help="folder of all runs")
    parser.add_argument("--beam", type=Path, help="folder of clips of beams (the newest if not given)")
    parser.add_argument("--glass", type=Path, help="folder of clips of glasses (the newest if not given)")
    parser.add_argument("--clips", type=int, default=4, help="how many of each")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="of OpenCV, torch and OpenVINO")
    parser.add_argument("--particles", type=int, default=700, help="of the glass twin")
    parser.add_argument("--publish", action="store_true", help="also into docs/results/bench_twins")
    chosen = parser.parse_args(arguments)
    set_thread_environment(1)
    try:
        return _time(chosen)
    except ZsdtError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def clips_of(folder: Path) -> dict[str, list[Path]]:
    """Clips in a folder by the twin that they are for."""
    found: dict[str, list[Path]] = {}
    for card in sorted(folder.glob("*/scene.json")):
        twin = SCHEMAS.get(json.loads(card.read_text()).get("schema", ""))
        if twin is not None:
            found.setdefault(twin, []).append(card.parent)
    return found


def newest_clips(outputs: Path) -> dict[str, list[Path]]:
    """The newest artifact of clips for each twin."""
    found: dict[str, list[Path]] = {}
    artifacts = [m.parent for m in (outputs / "artifacts" / "film").glob("*/manifest.json")]
    for folder in sorted(artifacts, key=lambda p: p.stat().st_mtime):
        found |= clips_of(folder)
    return found


def _time(chosen: argparse.Namespace) -> int:
    from zsdt.evaluation.bench import machine
    from zsdt.evaluation.bench_twins import beam_cases, glass_cases, time_twins, write_twin_report

    clips = newest_clips(chosen.outputs)
    for folder in (chosen.beam, chosen.glass):
        clips |= clips_of(folder) if folder is not None else {}
    clips = {twin: some[: chosen.clips] for twin, some in clips.items()}
    if not clips:
        raise DataError(f"There are no clips below {chosen.outputs}; run `make demo` first, or name folders of clips.")
    cases = beam_cases(chosen.threads) if "beam" in clips else []
    cases += glass_cases(chosen.threads, chosen.particles) if "glass" in clips else []
    turns = sum(len(clips[case.twin]) + 1 for case in cases)
    with tqdm(total=turns, desc="twins", unit="clip") as bar:

        def tick(what: str) -> None:
            bar.set_postfix_str(what, refresh=False)
            bar.update()

        rows, begun = time_twins(cases, clips, progress=tick)
    counts = ", ".join(f"{len(some)} of {twin}" for twin, some in clips.items())
    origin = (
        f"Made by `python -m pipelines.bench_twins` at commit {commit_words()} on {machine()} by BLAS; clips: "
        f"{counts}. Threads are those of OpenCV, torch and OpenVINO; a glass twin predicts on one more where it says "
        "beside. `total` is from the picture to the decoded fields, what runs side by side counted once."
    )
    page = write_twin_report(chosen.outputs / "reports" / "bench_twins", rows, begun, origin)
    print(page.read_text())
    print(f"Written to {page.parent}")
    if chosen.publish:
        print(f"Published: {copy_report(page.parent, 'bench_twins*', ROOT / 'docs' / 'results' / 'bench_twins')}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
