"""What came of a campaign: a row a session, a table by kind, and contact sheets."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from perception.frames import Image
from tests.campaigns.deceit.judge import Verdict
from tests.campaigns.deceit.scenes import Session

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
        again, told = _range([v.again for v in of]), _range([v.told for v in of if v.told != -2])
        lines.append(f"| {title} | {len(of)} | {count} | {figures} | {again} | {told} |\n")
    can = [v for v in verdicts if v.decidable]
    honest = [v for v in verdicts if v.honest]
    lines.append(f"\nSilently wrong: {sum(v.wrong > 0 for v in can)} of {len(can)} sessions that can be decided, ")
    lines.append(f"{sum(v.wrong > 0 for v in verdicts if not v.decidable)} of {len(verdicts) - len(can)} others. ")
    if honest:
        lines.append(f"TRACKING in {100 * np.mean([v.tracking for v in honest]):.1f} % of the honest ones' sets.")
    return "".join(lines).rstrip() + "\n"


def _range(counts: Sequence[int]) -> str:
    """Frame sets, from the least to the most; "never" where one of them has none."""
    ended = [c for c in counts if c >= 0]
    parts = [f"{min(ended)} to {max(ended)}"] if ended else []
    never = len(counts) - len(ended)
    return ", ".join(parts + ([f"never in {never}"] if never else [])) or "-"


def _text(value: float | None, digits: int) -> str:
    return "-" if value is None or np.isnan(value) else f"{value:.{digits}f}"


def shown_sets(session: Session) -> tuple[int, ...]:
    """Numbers of the sets on a contact sheet: before the trick, within it, at the end."""
    last = len(session.stamps) - 1
    return max(session.trick - 1, 0), min(session.trick + max(4, (last - session.trick) // 4), last - 1), last


def contact_strip(verdict: Verdict) -> Image:
    """The session's kept pictures side by side, each with its state; wrong ones in red."""
    shown = []
    for number, images in sorted(verdict.pictures.items()):
        judged = verdict.sets[number]
        for image in images:
            height = round(image.shape[0] * SHEET_WIDTH / image.shape[1])
            small = cv2.resize(image, (SHEET_WIDTH, height), interpolation=cv2.INTER_AREA)
            text = f"{number} {judged.state}" + ("" if np.isnan(judged.error) else f" {judged.error:.1f}")
            colour = (40, 40, 255) if judged.wrong else (255, 255, 255)
            cv2.putText(small, text, (4, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0), 3, cv2.LINE_AA)
            cv2.putText(small, text, (4, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.36, colour, 1, cv2.LINE_AA)
            shown.append(small)
    return np.concatenate(shown, axis=1)


def write_sheets(folder: Path, verdicts: Sequence[Verdict]) -> None:
    """A contact sheet a kind, its sessions below each other."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in dict.fromkeys(v.kind for v in verdicts):
        of = sorted((v for v in verdicts if v.kind == name and v.pictures), key=lambda v: v.index)
        cv2.imwrite(str(folder / f"{name}.png"), np.concatenate([contact_strip(v) for v in of]))
