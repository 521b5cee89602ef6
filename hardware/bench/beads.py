"""Beads that begin and end before a late dispenser, as part of the subject `loop`.

The scenario's print, as the others of `loop`; the dispenser is told over a line in virtual time, and material lies
where its true flow left the true nozzle. Once the motion knows the dispenser's delays, and once it takes them for none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from hardware.bench.fault_run import FaultRun, prepare_scenario
from hardware.bench.figures import Figure, at_most
from hardware.report.page import section
from hardware.report.report import HALF_CHART_WIDTH
from hardware.simulator.bead_ends import EndsOfBeads, MaterialFigures, material_figures
from hardware.simulator.deposit import planned_line
from hardware.simulator.nozzle_error import nozzle_errors
from hardware.simulator.nozzle_report import ends_chart
from perception.package_data import shipped_file

LATE_DISPENSER = "dispenser_late"  # a scenario
LED, NOT_LED = "delays known", "delays taken for 0"
MAX_END_ERROR = 0.5  # mm along the path, 95 %


@dataclass(frozen=True, slots=True, eq=False)
class BeadsPrint:
    """What came of a print."""

    material: MaterialFigures
    delay: float  # s, from a switch to half the flow


def print_beads(seed: int, way: str) -> BeadsPrint:
    """Print the scenario once; way: LED or NOT_LED."""
    on = prepare_scenario(shipped_file("scenarios", f"{LATE_DISPENSER}.toml"))
    dispenser = on.scenario.dispenser
    assert dispenser is not None
    run = FaultRun(on, (), seed, replace(dispenser, led=way == LED))()
    assert run.log is not None
    line, truth = planned_line(on.path), dispenser.truth
    errors = nozzle_errors(run.log, line)
    material = material_figures(run.log, line, errors, on.scenario.bead, run.told_outside)
    return BeadsPrint(material, truth.on_dead_time + float(np.log(2)) * truth.on_lag)


def bead_figures(prints: Mapping[str, BeadsPrint]) -> list[Figure]:
    """The figures of both prints, by LED and NOT_LED."""
    led, not_led, figures = prints[LED].material, prints[NOT_LED].material, list[Figure]()
    for what, ours, without in (("begin", led.begins, not_led.begins), ("end", led.stops, not_led.stops)):
        other, note = f"{NOT_LED}: {without.size.p95:.2f}", f"of {len(ours.error)}, by speed {_by_speed(ours)}"
        name = f"{LATE_DISPENSER}: beads {what} off the plan, 95 %"
        figures.append(Figure(name, ours.size.p95, "mm", at_most(MAX_END_ERROR), other, note))
        unled = f"{without.median:.2f} mm at the median; by speed {_by_speed(without)}"
        figures.append(Figure(f"{name}, {NOT_LED}", without.size.p95, "mm", None, "", unled))
    told = 1000 * max(led.told, not_led.told)
    figures.append(Figure(f"{LATE_DISPENSER}: told to flow while not printing", told, "ms", at_most(0)))
    return figures


def _by_speed(ends: EndsOfBeads) -> str:
    """The mean error at each speed, in whole mm/s."""
    there = np.isfinite(ends.error)
    speeds, error = np.round(ends.speed[there]), ends.error[there]
    each = (f"{speed:g} mm/s {error[speeds == speed].mean():+.2f}" for speed in np.unique(speeds))
    return ", ".join(each)


def beads_section(prints: Mapping[str, BeadsPrint]) -> str:
    """Both prints' beads about where they are to begin and end."""
    charts = [
        f"<div>{ends_chart(ends, f'{way}: about where beads {what}', HALF_CHART_WIDTH)}</div>"
        for way, one in prints.items()
        for what, ends in (("begin", one.material.begins), ("end", one.material.stops))
    ]
    late = 1000 * prints[LED].delay
    text = f"Half of the dispenser's flow comes {late:.0f} ms after it is told. Laid of the planned, by mm of the path."
    return section(LATE_DISPENSER, text, f'<div class="two">{"".join(charts)}</div>')
