"""`stillbed compare` from the words of the command line to the report."""

from __future__ import annotations

import json
from pathlib import Path

from estimation.errors import InputError
from hardware.comparing.metrics import compare
from hardware.comparing.posed import read_posed, read_truth
from hardware.offline.compare import as_dict, page, text
from hardware.out_folder import prepare_out
from hardware.report.summary import finite


def run_compare(estimated: str, reference: str | None, delta: int, out: Path | None) -> str:
    """Judge `estimated` by `reference`, without one by the truth beside it; the figures as text."""
    if delta < 1:
        raise InputError("command line", "--delta", delta, "1 or more poses")
    ours = read_posed(estimated)
    theirs = read_truth(estimated) if reference is None else read_posed(reference)
    if theirs.name == ours.name:
        raise InputError(ours.name, "poses", "the very ones they are judged by", "two different trajectories")
    compared = compare(ours, theirs, delta)
    told = text(compared)
    if out is None:
        return told
    prepare_out(out, force=True)
    (out / "compare.json").write_text(json.dumps(finite(as_dict(compared)), indent=2) + "\n", encoding="utf-8")
    (out / "report.html").write_text(page(compared), encoding="utf-8")
    return f"{told}\nreport: {out / 'report.html'}"
