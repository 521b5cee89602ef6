"""A live run that looks at what it laid: between layers and when the operator asks; the pictures show nothing laid."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from hardware.files.path_file import write_path
from hardware.live.prerender import prerender
from hardware.live.recorded_run import replay_run
from hardware.offline.looks import read_looks
from tests.live_runs import Running, closed
from tests.test_live_scan import SCENARIO
from tests.test_looks import layers

pytestmark = pytest.mark.slow


def test_it_looks_after_each_layer_and_when_somebody_asks_and_goes_on(tmp_path: Path) -> None:
    write_path(tmp_path / "path.csv", layers(2, 4))
    scenario = tmp_path / "gel.toml"
    dry = SCENARIO.replace('"chest"', '"chest"\nwetness = 0.0')
    scenario.write_text(dry.replace("focal_px = 1100", "focal_px = 2200").replace("15.0", "8.0"))
    prerender(scenario, tmp_path / "stillbed", threads=2)
    record = tmp_path / "run.mcap"
    given = "--simulated", scenario, "--yes", "--look", "layer", "--adapt", "--record", record, "--no-page"
    run = Running(*map(str, given), cache=tmp_path)
    try:
        run.wait_for(r"\nprint\n")
        run.press("p")
        run.wait_for(r"\npaused: by the operator")
        run.press("o")
        run.wait_for(r"\npaused: looked at: ")
        run.press("r")
        run.wait_for(r"\nprint: looked at: .*; the next layer flows at \d+ % to 150 % of the planned")
        run.wait_for(r"\nthe path is printed")
        run.end()
    finally:
        run.close()
    closed(record)
    looks = read_looks(record)
    # the operator's look saw what there was of the first layer, the others the rest: all was laid in the air
    assert len(looks) >= 2 and looks[0].first == 0.0 and looks[-1].last > looks[0].last
    assert all(a.last == b.first for a, b in pairwise(looks))
    assert all(look.laid.total[0] < 0.3 * look.laid.total[1] for look in looks if look.laid.total[2] > 0.3)
    assert any(look.laid.clogs for look in looks) and max(look.seconds for look in looks) < 6.0
    assert "Looks at what was laid" in record.with_suffix(".report.html").read_text(encoding="utf-8")
    ticks = list(replay_run(record))
    assert [max(look.flow.share) for look in looks if look.flow] == [1.5]
    assert len(ticks) > 500 and all(tick.frame == tick.recorded for tick in ticks)
