"""What a case of the liquid's validation leaves behind: a table, a page, a picture and verdicts."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from zsdt.errors import DataError
from zsdt.evaluation.plots import png_of
from zsdt.files import atomic_path


@dataclass(frozen=True)
class Verdict:
    """One figure that is asked for: what it is, what was found, what is required, and whether that is met."""

    what: str
    found: str
    required: str
    passed: bool

    def line(self) -> str:
        """The verdict in a line."""
        return f"{'PASS' if self.passed else 'FAIL'}: {self.what}: {self.found} (required: {self.required})"


@dataclass
class CaseResult:
    """Result of a case: rows of a table, verdicts, remarks for the reader, a figure.

    shown: columns of the page's table, all where empty; the CSV file has all.
    """

    title: str
    rows: list[dict[str, Any]]
    verdicts: list[Verdict]
    remarks: list[str]
    figure: Figure
    shown: tuple[str, ...] = ()


def write_case(out: Path, name: str, command: str, result: CaseResult) -> list[Path]:
    """Writes NAME.csv, NAME.md and NAME.png below `out`; the paths.

    Raises: DataError where nothing was computed or nothing can be written.
    """
    if not result.rows:
        raise DataError(f"The case {name} has no rows; run it for at least one setting.")
    paths = [out / f"{name}.{ending}" for ending in ("csv", "md", "png")]
    with atomic_path(paths[0]) as part, part.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(result.rows[0]))
        writer.writeheader()
        writer.writerows(result.rows)
    with atomic_path(paths[1]) as part:
        part.write_text(_page(name, command, result))
    with atomic_path(paths[2]) as part:
        part.write_bytes(png_of(result.figure))
    return paths


def markdown_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as a Markdown table; numbers with four significant digits."""
    heads = list(rows[0])
    lines = ["| " + " | ".join(heads) + " |", "|" + " --- |" * len(heads)]
    lines += ["| " + " | ".join(_cell(row.get(head)) for head in heads) + " |" for row in rows]
    return "\n".join(lines)


def _cell(value: Any) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _page(name: str, command: str, result: CaseResult) -> str:
    return "\n".join(
        [
            f"# {result.title}",
            "",
            f"Made by `{command}`.",
            "",
            *[f"- {verdict.line()}" for verdict in result.verdicts],
            "",
            markdown_table([{k: row[k] for k in result.shown or row} for row in result.rows]),
            "",
            *[f"{remark}\n" for remark in result.remarks],
            f"![{result.title}]({name}.png)",
            "",
        ]
    )
