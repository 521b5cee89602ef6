"""The part of the tracking report that says when the cameras expose."""

from __future__ import annotations

import numpy as np

from estimation.pose import TrackState
from hardware.files.pose_file import PoseTable
from hardware.page import legend, line_key, section
from hardware.report.page import Plot, spanning
from hardware.report.summary import clocks_learned


def clock_section(table: PoseTable, span: tuple[float, float], width: int) -> str:
    """How much later than stamped each camera exposes, as it was learned; HTML, "" where it was not.

    span: s, of the time axis. width: px.
    """
    if not clocks_learned(table):
        return ""
    shown = np.where(table.is_state(TrackState.INITIALISING), np.nan, 1.0)
    offsets, sigmas = 1000 * table.offsets * shown[:, None], 1000 * table.offset_sigmas
    plot, keys = Plot(width, 150, span, spanning([offsets], 0.15, 2.0), label="later than stamped, ms"), []
    for i, name in enumerate(table.cameras):
        plot.line(table.stamps, offsets[:, i], f"series c{i % 5}")
        at_end = f"{1000 * table.offsets[-1, i]:+.1f} ± {sigmas[-1, i]:.1f} ms"
        keys.append(line_key(f"series c{i % 5}", f"{name}, at the end {at_end}"))
    text = (
        "How much later than stamped each camera exposes, against the mean of all, and one standard deviation. It "
        "shows where the surface moves, and is corrected once it is clearly there."
    )
    if not np.nan_to_num(offsets).any():
        return section("Clocks", f"{text} Here chance explains what was seen, and nothing was corrected.", legend(keys))
    return section("Clocks", f"{text} Until then a line stays at zero.", legend(keys) + plot.svg())
