"""The table of all subjects as a page to look at, and as Markdown for the documents."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from hardware.bench.figure import Figure
from hardware.bench.machine import Machine
from hardware.page import document, row_of_tiles, section, tile
from hardware.summary import figure as digits

Parts = Mapping[str, Sequence[Figure]]  # by the name of the part
HEADER = ("figure", "value", "target", "", "reference", "note")


def whole_page(parts: Parts, troubles: Mapping[str, str], pages: Mapping[str, str], machine: Machine) -> str:
    """An HTML page with a card for each part. troubles: why a part has no figures. pages: of parts that drew one."""
    judged, missed, plain = counted(parts)
    tiles = [
        tile(str(judged - missed), f"of {judged}", "targets met"),
        tile(str(missed), "", "missed"),
        tile(str(plain), "", "figures without a target"),
        tile(str(len(troubles)), "", "parts that could not be measured"),
    ]
    cards = [section(name, troubles.get(name, ""), _body(name, parts[name], pages)) for name in parts]
    return document(
        "Bench", "All that is measured", measured_on(machine), [row_of_tiles(tiles), *cards], _made(machine)
    )


def counted(parts: Parts) -> tuple[int, int, int]:
    """Figures with a target, those of them that miss it, and figures without one."""
    figures = [figure for part in parts.values() for figure in part]
    verdicts = [figure.verdict for figure in figures]
    return len(figures) - verdicts.count(""), verdicts.count("MISSED"), verdicts.count("")


def measured_on(machine: Machine) -> str:
    """The machine and the commit in words."""
    code = f"commit {machine.commit}" if machine.commit else "an unknown commit"
    return f"{machine.cpu}, {machine.cores} cores, {code}, Python {machine.versions['python']}."


def _made(machine: Machine) -> str:
    versions = ", ".join(f"{name} {number}" for name, number in machine.versions.items() if number)
    return f"Made by stillbed bench --all with {versions}."


def _body(name: str, figures: Sequence[Figure], pages: Mapping[str, str]) -> str:
    if not figures:
        return ""
    link = f'<p class="note"><a href="{escape(pages[name])}">the pictures</a></p>' if name in pages else ""
    head = "".join(f'<th class="words">{cell}</th>' if i > 3 else f"<th>{cell}</th>" for i, cell in enumerate(HEADER))
    rows = "".join(f"<tr>{_cells(figure)}</tr>" for figure in figures)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>{link}"


def _cells(figure: Figure) -> str:
    what, value, target, verdict, *words = map(escape, _row(figure))
    colour = {"met": ' class="met"', "MISSED": ' class="missed"'}.get(verdict, "")
    plain = "".join(f"<td>{cell}</td>" for cell in (what, value, target))
    return f"{plain}<td{colour}>{verdict}</td>" + "".join(f'<td class="words">{cell}</td>' for cell in words)


def _row(figure: Figure) -> tuple[str, ...]:
    target = "" if figure.target is None else str(figure.target)
    value = f"{digits(figure.value)} {figure.unit}".rstrip()
    return figure.what, value, target, figure.verdict, figure.reference, figure.note


def whole_markdown(parts: Parts, machine: Machine) -> str:
    """The same as Markdown: what was measured on what, and a table for each part."""
    judged, missed, plain = counted(parts)
    lines = [
        "# All that is measured",
        "",
        f"`stillbed bench --all` (`make bench`) on {measured_on(machine)}",
        f"{judged - missed} of {judged} targets are met; {plain} figures have none.",
    ]
    for name, figures in parts.items():
        lines += ["", f"## {name}", "", _line(HEADER), "|---|---|---|---|---|---|"]
        lines += [_line(_row(figure)) for figure in figures]
    return "\n".join(lines) + "\n"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
