"""A report as one HTML file that opens from the disk: plots inside, no network, no scripts."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from typing import Any

CSS = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #1b1f24; background: #fff; max-width: 1320px;
       margin: 0 auto; padding: 28px 24px 80px; }
h1 { font-size: 26px; margin: 0 0 4px; }
h2 { font-size: 19px; margin: 40px 0 8px; padding-top: 14px; border-top: 1px solid #d8dee4; }
h3 { font-size: 16px; margin: 24px 0 6px; }
p { max-width: 80ch; margin: 6px 0 10px; }
.quiet { color: #57606a; }
nav a { margin-right: 14px; }
a { color: #0b5cad; text-decoration: none; } a:hover { text-decoration: underline; }
img { max-width: 100%; height: auto; display: block; margin: 10px 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; margin: 8px 0 14px; }
th, td { padding: 4px 10px; border-bottom: 1px solid #e4e8ec; text-align: left; vertical-align: top; }
th { border-bottom: 2px solid #8c959f; white-space: nowrap; }
td:first-child { white-space: nowrap; }
td.number { text-align: right; white-space: nowrap; }
tbody tr:hover { background: #f6f8fa; }
td.best { font-weight: 700; background: #e7f5ee; }
.failed { background: #fdeeea; border-left: 4px solid #d1480f; padding: 8px 14px; margin: 10px 0; }
.good { background: #e7f5ee; border-left: 4px solid #00805d; padding: 8px 14px; margin: 10px 0; }
pre { background: #f6f8fa; padding: 12px; overflow-x: auto; font-size: 12px; line-height: 1.4; }
details { margin: 6px 0; } summary { cursor: pointer; }
"""


class Page:
    """An HTML page that is filled from top to bottom; `html()` is the whole of it."""

    def __init__(self, title: str, subtitle: str):
        self.title = title
        self._sections: list[tuple[str, str]] = []
        self._parts: list[str] = [f"<h1>{escape(title)}</h1><p class='quiet'>{escape(subtitle)}</p>", ""]

    def section(self, title: str) -> None:
        """Begins a section that the line of links at the top leads to."""
        anchor = f"s{len(self._sections) + 1}"
        self._sections.append((anchor, title))
        self._parts.append(f"<h2 id='{anchor}'>{escape(title)}</h2>")

    def heading(self, text: str) -> None:
        """A smaller heading."""
        self._parts.append(f"<h3>{escape(text)}</h3>")

    def text(self, text: str, kind: str = "") -> None:
        """A paragraph; `kind` is one of quiet, failed, good."""
        tag = "div" if kind in ("failed", "good") else "p"
        self._parts.append(f"<{tag} class='{kind}'>{escape(text)}</{tag}>")

    def image(self, png: bytes, description: str) -> None:
        """A picture, stored in the page itself."""
        data = base64.b64encode(png).decode()
        self._parts.append(f"<img alt='{escape(description)}' src='data:image/png;base64,{data}'>")

    def table(self, rows: Sequence[Mapping[str, Any]], best: Mapping[str, str] | None = None, group: str = "") -> None:
        """A table of rows with the same keys.

        best: column -> ``least`` or ``most``; the best number of such a column (within rows that agree in `group`)
        is set in bold, among the rows with the most trajectories (column ``n``).
        """
        self._parts.append(table(rows, best or {}, group))

    def links(self, targets: Mapping[str, str]) -> None:
        """A list of links to files: text -> path relative to the page."""
        items = "".join(f"<li><a href='{escape(path)}'>{escape(text)}</a></li>" for text, path in targets.items())
        self._parts.append(f"<ul>{items}</ul>")

    def folded(self, title: str, text: str) -> None:
        """Preformatted text behind a line that opens it."""
        self._parts.append(f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>")

    def folded_table(self, title: str, rows: Sequence[Mapping[str, Any]]) -> None:
        """A table behind a line that opens it."""
        self._parts.append(f"<details><summary>{escape(title)}</summary>{table(rows, {}, '')}</details>")

    def html(self) -> str:
        """The page."""
        links = "".join(f"<a href='#{anchor}'>{escape(title)}</a>" for anchor, title in self._sections)
        self._parts[1] = f"<nav>{links}</nav>"
        head = f"<meta charset='utf-8'><title>{escape(self.title)}</title><style>{CSS}</style>"
        return f"<!doctype html><html lang='en'><head>{head}</head><body>{''.join(self._parts)}</body></html>\n"


def escape(text: Any) -> str:
    """Text as HTML can hold it."""
    return html.escape(str(text), quote=True)


def table(rows: Sequence[Mapping[str, Any]], best: Mapping[str, str], group: str) -> str:
    """HTML of a table; see `Page.table`."""
    if not rows:
        return "<p class='quiet'>Nothing to show.</p>"
    columns = list(dict.fromkeys(name for row in rows for name in row))
    chosen = {(k, name) for name, which in best.items() for k in _best_rows(rows, name, which, group)}
    head = "".join(f"<th>{escape(name)}</th>" for name in columns)
    lines = []
    for k, row in enumerate(rows):
        cells = "".join(_cell(row.get(name, ""), (k, name) in chosen) for name in columns)
        lines.append(f"<tr>{cells}</tr>")
    return f"<div class='wide'><table><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"


def _best_rows(rows: Sequence[Mapping[str, Any]], column: str, which: str, group: str) -> list[int]:
    found: dict[Any, tuple[float, int]] = {}
    most: dict[Any, int] = {}
    for row in rows:
        most[row.get(group, "")] = max(most.get(row.get(group, ""), 0), row.get("n", 0))
    for k, row in enumerate(rows):
        value = row.get(column)
        if not isinstance(value, int | float) or value != value or row.get("n", 0) < most[row.get(group, "")]:
            continue  # a mean over fewer trajectories than the others have is no rival
        cost = float(value) if which == "least" else -float(value)
        where = row.get(group, "")
        if where not in found or cost < found[where][0]:
            found[where] = (cost, k)
    return [k for _, k in found.values()]


def _cell(value: Any, is_best: bool) -> str:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    classes = " ".join(name for name, on in (("number", is_number), ("best", is_best)) if on)
    return f"<td class='{classes}'>{escape(number(value) if is_number else value)}</td>"


def number(value: int | float) -> str:
    """Three significant digits, without an exponent where that is readable; a dash for what is not a number."""
    if value != value:
        return "-"
    if isinstance(value, int) or (float(value).is_integer() and abs(value) < 1e6):
        return f"{int(value)}"
    if abs(value) >= 1e5 or 0 < abs(value) < 1e-3:
        return f"{value:.2e}"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
