"""`python -m tests.campaigns outages`: cameras fail before a moving wound; is the tracker ever lost in silence?

Each outage is laid over the pictures of a surface with exact truth, with which the tracking step's poses are compared.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.pose import TrackState
from estimation.se3 import Array
from hardware.bench.figures import Figure, at_most, columns, with_progress, workers, write_page
from hardware.report.page import Plot, area_key, document, legend, line_key, ribbon, section
from tests.campaigns.estimator import make_pictures
from tests.campaigns.outage_run import OutageKind, WatchedOutage, run_stretch
from tests.campaigns.verdicts import kind_table

HARMFUL_ERROR = 0.5  # mm: an error below is of no harm to a print with a nozzle of 0.4 mm
RADIUS_FACTOR = 3.0  # times the 95 % radius: of normal errors not one in a million lies beyond
RECOVERED_ERROR = 0.2  # mm, within which a pose has recovered
MIN_TRACK_SHARE = 0.25  # of its tracks: a camera with more still sees the surface


@dataclass(frozen=True, slots=True)
class OutageVerdict:
    """How the tracker got through one outage."""

    silent: bool  # TRACKING while wrong
    beyond: bool  # off by more than its covariance allows in any state but LOST
    worst: float  # mm, the largest error while TRACKING or DEGRADED
    flagged: float  # s from the first affected frame set until state or reason show it; nan: nothing had to be flagged
    back: float  # s from the view's return to TRACKING without a reservation, inf if never
    after: float  # mm, the error then, or worse afterwards


def judge_outage(watched: WatchedOutage) -> OutageVerdict:
    """The verdict on one outage."""
    stamps, outage = watched.stamps, watched.outage
    during = stamps >= outage.start - 1e-9
    after = stamps >= outage.end - 1e-9
    wrong = (watched.error > np.maximum(HARMFUL_ERROR, RADIUS_FACTOR * watched.radius)) & during
    tracking = np.array([s is TrackState.TRACKING for s in watched.states])
    lost, measured = np.array([(s is TrackState.LOST, s.measured) for s in watched.states]).T
    plain = tracking & np.array([not r for r in watched.reasons])
    back = np.flatnonzero(after & plain)
    return OutageVerdict(
        silent=bool((wrong & tracking).any()),
        beyond=bool((wrong & ~lost).any()),
        worst=float(watched.error[during & measured].max(initial=0.0)),
        flagged=_flagged(watched, during & ~after, plain),
        back=float(stamps[back[0]] - outage.end) if len(back) else np.inf,
        after=float(watched.error[back[0] :][measured[back[0] :]].max()) if len(back) else np.inf,
    )


def _flagged(watched: WatchedOutage, during: NDArray[np.bool_], plain: NDArray[np.bool_]) -> float:
    """s from the first affected frame set to the first that is flagged; nan where the view is back before it must be.

    A frame set is affected if a struck camera is blind, has lost three quarters of its tracks, or the pose is off.
    """
    affected, stamps = during, watched.stamps
    if not watched.outage.kind.blinds:
        before: Array = np.median(watched.used[stamps < watched.outage.start], axis=0)
        struck = list(watched.outage.cameras)
        fewer = (watched.used[:, struck] < MIN_TRACK_SHARE * before[struck]).any(1)
        affected = during & (fewer | (watched.error > RECOVERED_ERROR))
    if not affected.any():
        return np.nan
    first, last = int(np.argmax(affected)), int(np.flatnonzero(during)[-1])
    flags = np.flatnonzero(~plain[first : last + 1])
    if len(flags):
        return float(stamps[first + flags[0]] - stamps[first])
    return np.nan if float(stamps[last] - stamps[first]) < 0.1 else np.inf


PLOT_WIDTH, MIN_DRAWN_MM = 900, 1e-3  # px; mm, where the logarithmic axis begins
MAX_REASONS = 3  # that are shown of each outage
WORST_SHOWN = 12  # that are shown after one of each kind


def outage_page(judged: Sequence[tuple[WatchedOutage, OutageVerdict]]) -> str:
    """One outage of each kind and the worst ones, as a page."""
    first = [next((p for p in judged if p[0].outage.kind is kind), None) for kind in OutageKind]
    rank = sorted(judged, key=lambda pair: (-pair[1].silent, -pair[1].beyond, -pair[1].worst))
    silent = sum(v.silent for _, v in judged)
    lead = f"{silent} of {len(judged)} outages were lost in silence."
    body = [_one(*pair) for pair in first if pair is not None]
    body += [_one(*pair) for pair in rank[:WORST_SHOWN] if all(pair is not p for p in first)]
    return document("bench", "outages", lead, body, "Error: the largest of five points of the wound.")


def _one(watched: WatchedOutage, verdict: OutageVerdict) -> str:
    outage, stamps = watched.outage, watched.stamps - watched.outage.start
    span = (float(stamps[0]), float(stamps[-1]))
    top = max(1.0, float(np.nanmax(watched.error)) * 1.5, min(100.0, float(np.nanmax(watched.radius)) * 1.2))
    plot = Plot(PLOT_WIDTH, 170, span, (MIN_DRAWN_MM, top), log_y=True, label="mm")
    plot.shade(np.array([0.0]), np.array([outage.end - outage.start]), "holding")
    plot.line(stamps, np.maximum(watched.radius, MIN_DRAWN_MM), "truth")
    plot.line(stamps, np.maximum(watched.error, MIN_DRAWN_MM), "estimate")
    edges = np.append(stamps, stamps[-1] + (stamps[-1] - stamps[-2]))
    titles = [f"{s.value} {r}" for s, r in zip(watched.states, watched.reasons, strict=True)]
    strip = ribbon(edges, [s.value for s in watched.states], titles, span, PLOT_WIDTH)
    lines = [line_key("estimate", "error, mm"), line_key("truth", "claimed for 95 %, mm")]
    areas = [area_key("holding", "the outage"), *(area_key(s.value, s.value) for s in dict.fromkeys(watched.states))]
    keys = legend([*lines, *areas])
    cameras = ", ".join(f"cam_{c}" for c in outage.cameras)
    text = (
        f"{cameras}, {outage.end - outage.start:.2f} s; flagged after {1000 * verdict.flagged:.0f} ms, back after "
        f"{1000 * verdict.back:.0f} ms at {verdict.after:.3f} mm; time in s from its beginning"
    )
    # of reasons that differ in their figures only, the first
    by_text = {re.sub(r"(?<!_)\d", "", reason): reason for reason in reversed(watched.reasons) if reason}
    reasons = " / ".join(list(reversed(by_text.values()))[:MAX_REASONS]) or "nothing"
    return section(outage.kind.value, f"{text}. Said: {reasons}", keys + strip + plot.svg())


OUTAGES_A_SCENE = 64  # outages before one scene, whose pictures take as long to render as ten of them to track
SILENT_LOSS_REFERENCE = "FoundationPose #136, #103: the target is lost and nothing says so"

Judged = tuple[WatchedOutage, OutageVerdict]


def run_outages(options: argparse.Namespace) -> list[Figure]:
    """Run the campaign, print the table of all kinds, and give the figures of all."""
    jobs, pairs = scene_jobs(options.count, options.processes, options.seed), list[Judged]()
    with workers(options.processes) as pool:
        for part in with_progress("outages", "scenes", pool.map(_scene, jobs), len(jobs)):
            pairs += part
    print(outage_table([(w.outage.kind, v) for w, v in pairs]) + "\n")
    write_page(options.out, "outages.html", lambda: outage_page(pairs), "pictures")
    return outage_figures([v for _, v in pairs])


def scene_jobs(count: int, processes: int, seed: int) -> list[tuple[int, list[OutageKind]]]:
    """Seeds and outages of each scene: kinds in turn, as many scenes as are needed and a multiple of the processes."""
    kinds = [list(OutageKind)[i % len(OutageKind)] for i in range(count)]
    scenes = processes * max(1, -(-count // (OUTAGES_A_SCENE * processes)))
    order = np.random.default_rng([seed, 71]).permutation(count)
    parts = [p for p in np.array_split(order, min(scenes, count)) if len(p)]
    return [(100 * seed + i, [kinds[k] for k in part]) for i, part in enumerate(parts)]


def _scene(job: tuple[int, list[OutageKind]]) -> list[Judged]:
    seed, kinds = job
    return [(w, judge_outage(w)) for w in run_stretch(make_pictures(seed), kinds, seed, RECOVERED_ERROR)]


OUTAGE_HEADER = (
    *("kind", "count", "silent", "beyond", "unflagged", "flag ms", "max"),
    *("back ms", "max", "back mm", "max", "worst"),
)


def outage_table(judged: Sequence[tuple[OutageKind, OutageVerdict]]) -> str:
    """A line for each kind and one for all; times are median and largest, `worst` the largest error while measured."""
    return kind_table(OUTAGE_HEADER, [(kind.value, v) for kind, v in judged], _row, [kind.value for kind in OutageKind])


def _row(verdicts: Sequence[OutageVerdict]) -> tuple[str, ...]:
    flagged, back, after, worst = columns(verdicts, "flagged", "back", "after", "worst")
    silent, beyond = (str(sum(getattr(v, field) for v in verdicts)) for field in ("silent", "beyond"))
    counts = (str(len(verdicts)), silent, beyond, str(int(np.isinf(flagged).sum())))
    errors = (f"{np.median(after):.3f}", f"{after.max():.3f}", f"{worst.max():.2f}")
    return (*counts, *_times(flagged), *_times(back), *errors)


def _times(seconds: Array) -> tuple[str, ...]:
    """Median and largest, ms, of what is finite."""
    known = seconds[np.isfinite(seconds)]
    return tuple(f"{1000 * f(known):.0f}" if len(known) else "-" for f in (np.median, np.max))


def outage_figures(verdicts: Sequence[OutageVerdict]) -> list[Figure]:
    """The campaign's figures beside their targets."""
    flagged, back, after = columns(verdicts, "flagged", "back", "after")
    needed, note, points = flagged[~np.isnan(flagged)], f"of {len(verdicts)} outages", "of five points of the wound"
    late, slow = int((needed > 0.1 + 1e-9).sum()), int((back > 0.2 + 1e-9).sum())
    return [
        Figure("silent losses", sum(v.silent for v in verdicts), "", at_most(0), SILENT_LOSS_REFERENCE, note),
        Figure("errors beyond the claim", sum(v.beyond for v in verdicts), "", at_most(0), "", "in any state but LOST"),
        Figure("flagged after more than 100 ms", late, "", at_most(0), "", f"of {len(needed)} that had to be"),
        Figure("time to the flag, median", 1000 * float(np.median(needed)) if len(needed) else np.nan, "ms"),
        Figure("time to the flag, largest", 1000 * float(needed.max(initial=0.0)), "ms", at_most(100)),
        Figure("back after more than 200 ms", slow, "", at_most(0), "", note),
        Figure("time back, median", 1000 * float(np.median(back)), "ms", None, "", "from the view's return"),
        Figure("time back, largest", 1000 * float(back.max()), "ms", at_most(200), "", "from the view's return"),
        Figure("error once back, median", float(np.median(after)), "mm"),
        Figure("error once back, largest", float(after.max()), "mm", at_most(RECOVERED_ERROR), "", points),
    ]
