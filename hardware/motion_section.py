"""The part of the tracking report that says when the surface moved."""

from __future__ import annotations

import numpy as np

from hardware.files.pose_file import PoseTable
from hardware.page import legend, line_key, section
from hardware.report.page import Plot, spanning


def motion_section(table: PoseTable, span: tuple[float, float], width: int) -> str:
    """How far the surface was from its last place of rest, and where its movements began; HTML, "" without poses.

    span: s, of the time axis. width: px.
    """
    if not len(table):
        return ""
    moved = np.where(table.measured, table.moved, np.nan)
    plot = Plot(width, 150, span, spanning([moved], 0.1, 0.3), label="away from the last place of rest, mm")
    plot.line(table.stamps, moved, "estimate")
    onsets = np.unique(table.onset[np.isfinite(table.onset)])
    if len(onsets):
        plot.dots(onsets, np.zeros(len(onsets)), "off", 3)
    share = float(np.mean(table.moving[table.measured])) if table.measured.any() else float("nan")
    still = "was never at rest" if share == 1 else f"moved in {100 * share:.0f} % of the measured frame sets"
    began = {0: "no movement was seen to begin", 1: "one movement was seen to begin"}
    text = (
        f"The surface {still}; {began.get(len(onsets), f'{len(onsets)} movements were seen to begin')}. A movement is "
        "0.3 mm or 0.1°, and a dot marks the first pose of each."
    )
    keys = [line_key("estimate", "middle of the surface since it was last at rest")]
    return section("Motion", text, legend(keys) + plot.svg())
