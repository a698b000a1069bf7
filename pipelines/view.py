"""`python -m pipelines.view`: the newest recording in the Rerun viewer, or served to a browser with `--web`."""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from zsdt.errors import DataError, ZsdtError


def newest_recording(outputs: Path) -> Path:
    """Newest `.rrd` below the folder of all runs: of a twin, or of an evaluation that of the first engine.

    Raises: DataError where there is none.
    """
    shelves = (outputs / "artifacts").glob("*/*/")
    found = [path for folder in shelves if not folder.name.startswith(".") for path in folder.rglob("*.rrd")]
    if not found:
        raise DataError(f"There is no recording below {outputs} yet; make one with `make demo` or `make sweep`.")
    newest = max(found, key=lambda path: path.stat().st_mtime)
    evaluation = next((folder for folder in newest.parents if folder.name == "recordings"), None)
    if evaluation is None:
        return newest
    learned = [path for path in evaluation.rglob("*.rrd") if path.parent.name.startswith("tignn")]
    return min(learned) if learned else newest


def main(arguments: Sequence[str] | None = None) -> int:
    """Opens the recording; returns the exit code of the viewer."""
    parser = argparse.ArgumentParser(prog="python -m pipelines.view", description=__doc__)
    parser.add_argument("--outputs", type=Path, default=Path("outputs"), help="folder of all runs")
    parser.add_argument("--file", type=Path, help="this recording instead of the newest")
    parser.add_argument("--web", action="store_true", help="serve it to a browser on this machine")
    chosen = parser.parse_args(arguments)
    try:
        recording = chosen.file or newest_recording(chosen.outputs)
        if not recording.is_file():
            raise DataError(f"There is no recording {recording}; `make view` without FILE opens the newest.")
    except ZsdtError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"Opening {recording}", flush=True)
    rerun = Path(sys.executable).with_name("rerun")
    serve = ["--serve-web", "--bind", "127.0.0.1"] if chosen.web else []
    return subprocess.run([rerun, *serve, recording]).returncode


if __name__ == "__main__":
    sys.exit(main())
