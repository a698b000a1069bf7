"""Whether two stores hold the same: file by file, bit by bit, but for what says how long something took."""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipelines.store import MANIFEST

TIMES = re.compile(r"(^|[._])(ms|seconds|minutes|mb|cpu_s|wall_s)([._]|$)")
MADE_OF = (
    "stage",
    "version",
    "key",
    "config",
    "inputs",
    "seed",
    "figures",
)  # of a manifest; the rest is where and when
ILLUSTRATIONS = (".png", ".md", ".rrd", ".webm")  # show times among other things


@dataclass
class Comparison:
    """How many files are bitwise the same, the same but for times, not compared; and names of those that differ."""

    counts: Counter[str] = field(default_factory=Counter)
    different: list[str] = field(default_factory=list)

    @property
    def same(self) -> bool:
        """Whether nothing differs (and there was something to compare)."""
        return not self.different and bool(self.counts)


def compare_stores(one: Path, other: Path) -> Comparison:
    """Compares all finished artifacts below two `artifacts` folders."""
    found = Comparison()
    files = [_files(root) for root in (one, other)]
    for name in sorted(files[0] ^ files[1]):
        found.different.append(f"{name} (only in one)")
    for name in sorted(files[0] & files[1]):
        verdict = same_content(one / name, other / name)
        if verdict is None:
            found.different.append(name)
        else:
            found.counts[verdict] += 1
    return found


def _files(root: Path) -> set[str]:
    """Files of finished artifacts, ``<stage>/<key>/...``; a folder that begins with a dot is none."""
    manifests = [path for path in root.glob(f"*/*/{MANIFEST}") if not path.parent.name.startswith(".")]
    return {str(file.relative_to(root)) for path in manifests for file in path.parent.rglob("*") if file.is_file()}


def same_content(one: Path, other: Path) -> str | None:
    """``bitwise``, ``but for times`` or ``illustration`` (not compared); None where two files differ."""
    if one.read_bytes() == other.read_bytes():
        return "bitwise"
    if one.suffix in ILLUSTRATIONS:
        return "illustration"
    if one.suffix == ".pt":
        return "bitwise" if _same_weights(one, other) else None
    if one.suffix in (".csv", ".json"):
        read = _cells if one.suffix == ".csv" else _leaves
        return "but for times" if dict(read(one)) == dict(read(other)) else None
    return None


def _cells(path: Path) -> Iterator[tuple[Any, str]]:
    with path.open(newline="") as lines:
        for number, row in enumerate(csv.DictReader(lines)):
            yield from (((number, name), value) for name, value in row.items() if not TIMES.search(name))


def _leaves(path: Path) -> Iterator[tuple[Any, str]]:
    value = json.loads(path.read_text())
    if path.name == MANIFEST:
        value = {name: value[name] for name in MADE_OF}
    yield from _walk(value, "")


def _walk(value: Any, name: str) -> Iterator[tuple[str, str]]:
    """Dotted names and texts of the values (NaN is equal to NaN as text)."""
    if isinstance(value, dict | list):
        for key, child in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _walk(child, f"{name}.{key}")
    elif not TIMES.search(name):
        yield name, repr(value)


def _same_weights(one: Path, other: Path) -> bool:
    """Tensor by tensor: the archive itself holds the name of the file that it was written to."""
    import torch

    a, b = (torch.load(path, weights_only=True, map_location="cpu") for path in (one, other))
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
