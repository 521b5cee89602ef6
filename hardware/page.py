"""The frame that all reports share: one HTML page that needs no network, and what stands on it."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib.resources import files


def document(kind: str, title: str, lead: str, body: Sequence[str], footer: str) -> str:
    """The whole page. kind: of report; lead: the verdict in words; body: parts as HTML; the rest is plain text."""
    style = (files("hardware") / "report" / "report.css").read_text(encoding="utf-8")
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(f"{title} · {kind}")}</title>'
        f'<meta name="viewport" content="width=device-width"><style>\n{style}</style></head><body><main>\n'
        f'<header><div class="kind">{escape(kind)}</div><h1>{escape(title)}</h1>'
        f'<p class="lead">{escape(lead)}</p></header>\n'
        f"{chr(10).join(body)}\n<footer>{escape(footer)}</footer></main></body></html>\n"
    )


def tile(value: str, unit: str, caption: str) -> str:
    """One figure, large."""
    return f'<div class="tile"><b>{escape(value)}<small>{escape(unit)}</small></b><span>{escape(caption)}</span></div>'


def row_of_tiles(tiles: Sequence[str]) -> str:
    """Tiles side by side."""
    return f'<div class="tiles">{"".join(tiles)}</div>'


def section(title: str, explanation: str, body: str) -> str:
    """A titled card; `body` is HTML."""
    return f"<section><h2>{escape(title)}</h2><p>{escape(explanation)}</p>{body}</section>"


def figures_table(head: Sequence[str], rows: Sequence[Sequence[str]], last_total: bool = False) -> str:
    """A table of plain text; last_total: whether its last row stands out."""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    lines = []
    for i, row in enumerate(rows):
        style = ' class="total"' if last_total and i == len(rows) - 1 else ""
        lines.append(f"<tr{style}>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>")
    return f"<table><thead><tr>{top}</tr></thead><tbody>{''.join(lines)}</tbody></table>"


def line_key(style: str, words: str) -> str:
    """An entry of a legend: a line in a CSS class, and what it is."""
    return f'<span><svg viewBox="0 0 18 10"><path class="{style}" d="M0 5H18"/></svg>{escape(words)}</span>'


def dot_key(style: str, words: str) -> str:
    """An entry of a legend: a dot in a CSS class, and what it is."""
    return f'<span><svg viewBox="0 0 18 10"><circle class="{style}" cx="9" cy="5" r="4"/></svg>{escape(words)}</span>'


def area_key(style: str, words: str) -> str:
    """An entry of a legend: a patch in a CSS class, and what it is."""
    patch = f'<svg viewBox="0 0 18 10"><rect class="{style}" width="18" height="10" rx="2"/></svg>'
    return f"<span>{patch}{escape(words)}</span>"


def legend(keys: Sequence[str]) -> str:
    """The entries of a legend in a row."""
    return f'<div class="legend">{"".join(keys)}</div>'
