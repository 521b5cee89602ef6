"""A page of outages: error and claim over time, and what the state was."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from hardware.bench.campaigns.outages import Verdict
from hardware.bench.outage_run import Watched
from hardware.page import area_key, document, legend, line_key, section
from hardware.report.page import Plot, ribbon
from hardware.simulator.outage import Kind

WIDTH, LEAST = 900, 1e-3  # px; mm, where the logarithmic axis begins
MOST = 3  # reasons that are shown of each
WORST = 12  # outages that went worst are shown after one of each kind


def outage_page(judged: Sequence[tuple[Watched, Verdict]]) -> str:
    """One outage of each kind and the worst ones, as a page."""
    first = [next((p for p in judged if p[0].outage.kind is kind), None) for kind in Kind]
    rank = sorted(judged, key=lambda pair: (-pair[1].silent, -pair[1].beyond, -pair[1].worst))
    silent = sum(v.silent for _, v in judged)
    lead = f"{silent} of {len(judged)} outages were lost in silence."
    body = [_one(*pair) for pair in first if pair is not None]
    body += [_one(*pair) for pair in rank[:WORST] if all(pair is not p for p in first)]
    return document("bench", "outages", lead, body, "Error: the largest of five points of the wound.")


def _one(watched: Watched, verdict: Verdict) -> str:
    outage, stamps = watched.outage, watched.stamps - watched.outage.start
    span = (float(stamps[0]), float(stamps[-1]))
    top = max(1.0, float(np.nanmax(watched.error)) * 1.5, min(100.0, float(np.nanmax(watched.radius)) * 1.2))
    plot = Plot(WIDTH, 170, span, (LEAST, top), log_y=True, label="mm")
    plot.shade(np.array([0.0]), np.array([outage.end - outage.start]), "holding")
    plot.line(stamps, np.maximum(watched.radius, LEAST), "truth")
    plot.line(stamps, np.maximum(watched.error, LEAST), "estimate")
    edges = np.append(stamps, stamps[-1] + (stamps[-1] - stamps[-2]))
    titles = [f"{s.value} {r}" for s, r in zip(watched.states, watched.reasons, strict=True)]
    strip = ribbon(edges, [s.value for s in watched.states], titles, span, WIDTH)
    lines = [line_key("estimate", "error, mm"), line_key("truth", "claimed for 95 %, mm")]
    areas = [area_key("holding", "the outage"), *(area_key(s.value, s.value) for s in dict.fromkeys(watched.states))]
    keys = legend([*lines, *areas])
    cameras = ", ".join(f"cam_{c}" for c in outage.cameras)
    text = (
        f"{cameras}, {outage.end - outage.start:.2f} s; flagged after {1000 * verdict.flagged:.0f} ms, back after "
        f"{1000 * verdict.back:.0f} ms at {verdict.after:.3f} mm; time in s from its beginning"
    )
    # of reasons that differ in their figures only, the first
    reasons = {re.sub(r"(?<!_)\d", "", reason): reason for reason in reversed(watched.reasons) if reason}
    said = " / ".join(list(reversed(reasons.values()))[:MOST]) or "nothing"
    return section(outage.kind.value, f"{text}. Said: {said}", keys + strip + plot.svg())
