"""What came of a campaign: a row a session, a table by kind, and contact sheets."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from perception.frames import Image
from tests.campaigns.deceit.judge import Verdict

COLUMNS = (
    *("index", "kind", "seed", "what", "decidable", "honest", "wrong", "worst_mm", "claim_mm", "tracking", "first"),
    *("again", "told", "states", "reasons"),
)
HEAD = (
    "| kind | sessions | silently wrong | worst | its claim | TRACKING | again after | told after |\n"
    + "|---" * 8
    + "|\n"
)
SHEET_WIDTH = 200  # px, of one picture


def row(verdict: Verdict) -> dict[str, object]:
    """A session's row of the CSV file."""
    worst = verdict.worst
    values = (
        *(verdict.index, verdict.kind, verdict.seed, verdict.what, int(verdict.decidable), int(verdict.honest)),
        *(verdict.wrong, _text(worst and worst.error, 2), _text(worst and worst.claim, 3), f"{verdict.tracking:.3f}"),
        *(verdict.first, verdict.again, verdict.told, verdict.states, verdict.reasons),
    )
    return dict(zip(COLUMNS, values, strict=True))


def write_rows(path: Path, verdicts: Sequence[Verdict]) -> None:
    """Write a CSV file, sessions in order."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(row(v) for v in sorted(verdicts, key=lambda v: v.index))


def table(verdicts: Sequence[Verdict]) -> str:
    """The sessions by kind, in Markdown; below it the sums."""
    names = list(dict.fromkeys(v.kind for v in sorted(verdicts, key=lambda v: v.index)))
    lines = [HEAD]
    for name in names:
        of = [v for v in verdicts if v.kind == name]
        wrong, open_ = [v for v in of if v.wrong], sum(v.wrong > 0 and not v.decidable for v in of)
        worst = max((v.worst for v in wrong if v.worst), key=lambda s: s.error, default=None)
        share = np.mean([v.tracking for v in of])
        count = f"{len(wrong)}" + (f" ({open_} of them cannot be decided)" if open_ else "")
        figures = f"{_text(worst and worst.error, 1)} | {_text(worst and worst.claim, 2)} | {100 * share:.0f} %"
        title = name.replace("_", " ") + (" (honest)" if of[0].honest else "")
        again, told = _range([v.again for v in of]), _range([v.told for v in of])
        lines.append(f"| {title} | {len(of)} | {count} | {figures} | {again} | {told} |\n")
    can = [v for v in verdicts if v.decidable]
    honest = [v for v in verdicts if v.honest]
    lines.append(f"\nSilently wrong: {sum(v.wrong > 0 for v in can)} of {len(can)} sessions that can be decided, ")
    lines.append(f"{sum(v.wrong > 0 for v in verdicts if not v.decidable)} of {len(verdicts) - len(can)} others. ")
    if honest:
        lines.append(f"TRACKING in {100 * np.mean([v.tracking for v in honest]):.1f} % of the honest ones' sets.")
    return "".join(lines).rstrip() + "\n"


def _range(counts: Sequence[int]) -> str:
    """Frame sets, from the least to the most, and how many sessions never came to it; -2 does not count."""
    counts = [c for c in counts if c != -2]
    ended = [c for c in counts if c >= 0]
    parts = [f"{min(ended)} to {max(ended)}"] if ended else []
    never = len(counts) - len(ended)
    return ", ".join(parts + ([f"never in {never}"] if never else [])) or "-"


def _text(value: float | None, digits: int) -> str:
    return "-" if value is None or np.isnan(value) else f"{value:.{digits}f}"


def contact_strip(verdict: Verdict, cameras: slice = slice(None)) -> Image:
    """The session's kept pictures side by side, each with its state; wrong ones in red."""
    shown = []
    for number, images in sorted(verdict.pictures.items()):
        judged = verdict.sets[number]
        for image in images[cameras]:
            height = round(image.shape[0] * SHEET_WIDTH / image.shape[1])
            small = cv2.resize(image, (SHEET_WIDTH, height), interpolation=cv2.INTER_AREA)
            text = f"{number} {judged.state}" + ("" if np.isnan(judged.error) else f" {judged.error:.1f}")
            _write(small, text, height - 6, (40, 40, 255) if judged.wrong else (255, 255, 255))
            shown.append(small)
    strip = np.concatenate(shown, axis=1)
    _write(strip, f"{verdict.kind.replace('_', ' ')}: {verdict.what}", 12, (255, 255, 255))
    return strip


def _write(image: Image, text: str, y: int, colour: tuple[int, int, int]) -> None:
    for ink, width in (((0, 0, 0), 3), (colour, 1)):
        cv2.putText(image, text, (4, y), cv2.FONT_HERSHEY_SIMPLEX, 0.36, ink, width, cv2.LINE_AA)


OVERVIEW_COLUMNS = 4  # kinds side by side


def write_sheets(folder: Path, verdicts: Sequence[Verdict]) -> None:
    """A contact sheet a kind, its sessions below each other; and one of all kinds, the middle camera only."""
    folder.mkdir(parents=True, exist_ok=True)
    tiles = []
    for name in dict.fromkeys(v.kind for v in sorted(verdicts, key=lambda v: v.index)):
        of = sorted((v for v in verdicts if v.kind == name and v.pictures), key=lambda v: v.index)
        cv2.imwrite(str(folder / f"{name}.png"), np.concatenate([contact_strip(v) for v in of]))
        tiles.append(contact_strip(of[0], slice(1, 2)))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % OVERVIEW_COLUMNS)
    rows = [np.concatenate(tiles[i : i + OVERVIEW_COLUMNS], axis=1) for i in range(0, len(tiles), OVERVIEW_COLUMNS)]
    cv2.imwrite(str(folder / "all.jpg"), np.concatenate(rows), [cv2.IMWRITE_JPEG_QUALITY, 80])
