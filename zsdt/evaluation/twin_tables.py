"""Tables that the reports of all twins share: errors by case and kind of clip, and milliseconds by part of the loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

Figure = tuple[str, str, float]  # name in the rows, head of its column, factor from SI to the head's unit
PERCENTILES = ("p50", "p95", "p99")


def summary_of(table: pd.DataFrame, figures: Sequence[Figure], kind: str) -> pd.DataFrame:
    """Mean and worst of each figure over the clips, a row per case and `kind` of clip (a column of `table`), and per
    case over all kinds together. The worst is the largest in size and keeps its sign."""
    parts = []
    for value, part in [("all", table), *table.groupby(kind, sort=True)]:
        for case, rows in part.groupby("case", sort=False):
            line: dict[str, Any] = {"case": case, kind: value, "clips": len(rows)}
            line["survived"] = int(rows["survived"].sum())
            for name, head, factor in figures:
                if name in rows:
                    values = factor * rows[name].astype(float)
                    worst = values.loc[values.abs().idxmax()] if values.notna().any() else np.nan
                    line[head], line[f"{head} worst"] = values.mean(), worst
            parts.append(line)
    return pd.DataFrame(parts)


def latency_of(table: pd.DataFrame, case: str, loop_parts: Sequence[str]) -> pd.DataFrame:
    """Milliseconds of each part of the loop in the runs of a case: median, p95 and p99 over frames, mean over clips."""
    runs = table[table["case"] == case]
    lines = []
    for part in loop_parts:
        columns = {name: f"{part}_{name}_ms" for name in PERCENTILES}
        if columns["p50"] in runs and runs[columns["p50"]].notna().any():
            means = {name: runs[column].mean() for name, column in columns.items()}
            lines.append({"part": part, **means, "worst p99": runs[columns["p99"]].max()})
    return pd.DataFrame(lines)


def figures_of(
    table: pd.DataFrame,
    summary: pd.DataFrame,
    figures: Sequence[Figure],
    kind: str,
    gains: dict[str, dict[str, float]],
    speeds: pd.DataFrame,
) -> dict[str, Any]:
    """What the table of a sweep shows: figures by case in SI, gains, p50 and p99 [ms] by part of the loop."""
    found: dict[str, Any] = {"clips": int(table["clip"].nunique())}
    for case, row in summary[summary[kind] == "all"].set_index("case").iterrows():
        errors = {name: float(row[head]) / factor for name, head, factor in figures if head in row}
        found[str(case)] = {"survived": int(row["survived"]), **errors}
    found["gains"] = gains
    found["latency"] = {row["part"]: {"p50": row["p50"], "p99": row["p99"]} for _, row in speeds.iterrows()}
    return found


def table_lines(summary: pd.DataFrame, figures: Sequence[Figure], kind: str) -> list[str]:
    """`summary_of` as a table in Markdown: mean (worst)."""
    heads = [head for _, head, _ in figures if head in summary]
    lines = [markdown_row(["case", kind, "survived", *heads]), markdown_row(["---"] * (3 + len(heads)))]
    for _, row in summary.iterrows():
        cells = ["-" if np.isnan(row[h]) else f"{row[h]:.3g} ({row[f'{h} worst']:.3g})" for h in heads]
        lines.append(markdown_row([row["case"], row[kind], f"{row['survived']}/{row['clips']}", *cells]))
    return lines


def latency_lines(speeds: pd.DataFrame) -> list[str]:
    """`latency_of` as a table in Markdown."""
    names = (*PERCENTILES, "worst p99")
    rows = [markdown_row([row["part"], *(f"{row[n]:.2f}" for n in names)]) for _, row in speeds.iterrows()]
    return [markdown_row(["part", *names]), markdown_row(["---"] * 5), *rows]


def failed_lines(table: pd.DataFrame) -> list[str]:
    """Runs that did not survive, and why."""
    failed = table[~table["survived"].astype(bool)]
    return [f"- {row['clip']} {row['case']}: {row['reason']}" for _, row in failed.iterrows()]


def markdown_row(cells: Sequence[Any]) -> str:
    """A row of a table in Markdown."""
    return "| " + " | ".join(map(str, cells)) + " |"
