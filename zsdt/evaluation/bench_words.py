"""How the pages of the benchmark write a number, and a table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any


def known(value: Any) -> bool:
    """Whether it is a finite number."""
    return isinstance(value, int | float) and math.isfinite(value)


def three(value: Any) -> str:
    """Three significant digits without an exponent, `-` where there is no number."""
    if not known(value):
        return "-"
    if abs(value) >= 9999.5:
        return "> 9999"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def percent(fraction: Any) -> str:
    """A fraction in percent."""
    return three(100.0 * fraction) if known(fraction) else "-"


def cell(row: Mapping[str, Any], name: str) -> str:
    """Mean (worst) of an error in percent."""
    return f"{percent(row.get(name))} ({percent(row.get(name + '_worst'))})"


def plain(value: Any) -> str:
    """A count with thousands marked, a word, or `-`."""
    if value is None or value == "" or (isinstance(value, float) and math.isnan(value)):
        return "-"
    return f"{value:,}" if isinstance(value, int) else str(value)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    if not rows:
        return "(nothing was measured)"
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *rows))
