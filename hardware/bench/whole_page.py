"""The table of all subjects as a page to look at, and as Markdown for the documents."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from hardware.bench.figures import Figure
from hardware.bench.machine import Machine
from hardware.page import document, row_of_tiles, section, tile
from hardware.report.summary import figure as digits

Parts = Mapping[str, Sequence[Figure]]  # by the name of the part
NAMED = 3  # figures of a part that are named where they miss their target; of more, the count is
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
    cards = [_card(name, parts[name], troubles, pages) for name in parts]
    return document(
        "Bench",
        "All that is measured",
        measured_on(machine),
        [row_of_tiles(tiles), _overview(parts, troubles), *cards],
        _made(machine),
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


def _overview(parts: Parts, troubles: Mapping[str, str]) -> str:
    """A line for each part: how its figures fare, and which of them miss their target; its name leads to its card."""
    rows = []
    for name, figures in parts.items():
        judged, missed, plain = counted({name: figures})
        what = [escape(figure.what) for figure in figures if figure.verdict == "MISSED"]
        told = "; ".join(what[:NAMED]) + (f"; and {len(what) - NAMED} more" if len(what) > NAMED else "")
        link = f'<td><a href="#{escape(_place(name))}">{escape(name)}</a></td>'
        alarm = f'<span class="missed">{missed}</span>' if missed else "0"
        counts = f"<td>{judged - missed}</td><td>{alarm}</td><td>{plain}</td>"
        rows.append(f'<tr>{link}{counts}<td class="words">{escape(troubles.get(name, "")) or told}</td></tr>')
    head = '<th>part</th><th>met</th><th>missed</th><th>without a target</th><th class="words">which miss it</th>'
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
    return section("Overview", "How many figures of each part meet their target.", table)


def _card(name: str, figures: Sequence[Figure], troubles: Mapping[str, str], pages: Mapping[str, str]) -> str:
    card = section(name, troubles.get(name, ""), _body(name, figures, pages))
    return f'<div id="{escape(_place(name))}">{card}</div>'


def _place(name: str) -> str:
    """What a part is found by in the page."""
    return f"part-{name.replace(' ', '-')}"


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
    numbers = "".join(f'<td class="whole">{cell}</td>' for cell in (value, target))
    said = "".join(f'<td class="words">{cell}</td>' for cell in words)
    return f"<td>{what}</td>{numbers}<td{colour}>{verdict}</td>{said}"


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
