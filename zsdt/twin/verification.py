"""Proves that a recording holds what a viewer needs: entities, timelines, frames, layout."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

from zsdt.errors import DataError


def verify_recording(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Reads a recording with the viewer's own reader and counts what is in it.

    Returns: {"application", "entities": {entity: rows on timelines}, "static": [entities], "timelines": [names],
    "blueprints": n, "bytes": n}.
    Raises: DataError where the file is missing, cannot be decoded to its end (`rerun rrd verify`), or is empty.
    """
    if not Path(path).is_file():
        raise DataError(f"There is no recording {path}; evaluate with recordings first.")
    check = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", str(path)], capture_output=True, text=True, check=False
    )
    if check.returncode != 0:
        reason = (check.stderr.strip() or check.stdout.strip()).splitlines()
        raise DataError(
            f"The recording {path} is broken ({reason[-1] if reason else 'no reason given'}); make it again."
        )
    reader = RrdReader(str(path))
    entities: dict[str, int] = {}
    static: set[str] = set()
    timelines: set[str] = set()
    for chunk in reader.stream():
        if chunk.is_static:
            static.add(chunk.entity_path)
        else:
            entities[chunk.entity_path] = entities.get(chunk.entity_path, 0) + chunk.num_rows
            timelines.update(chunk.timeline_names)
    if not entities:
        raise DataError(f"The recording {path} holds no frames; make it again.")
    stores = reader.recordings()
    return {
        "application": stores[0].application_id,
        "entities": entities,
        "static": sorted(static),
        "timelines": sorted(timelines),
        "blueprints": len(reader.blueprints()),
        "bytes": Path(path).stat().st_size,
    }
