"""Show a recording in Rerun: python docs/examples/show_in_rerun.py sessions/monday/run.mcap

Writes run.rrd and run.rbl beside it: pictures in their frusta, surface, nozzle and path in 3D, errors over time, the
log. Needs `pip install rerun-sdk`. The conversion is Rerun's own; what is written here is only which views are shown.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from hardware.cli.parser import run_script
from hardware.recording.session_reader import open_session

ERRORS = {"/error/claimed": "claimed", "/error/tracking": "tracking", "/error/nozzle": "nozzle"}  # m


def main(file: str) -> None:
    """Convert the recording, and say what shows it."""
    recording = Path(file)
    names = [camera.name for camera in open_session(recording).rig.cameras]
    data, views = recording.with_suffix(".rrd"), recording.with_suffix(".rbl")
    command = [sys.executable, "-m", "rerun", "mcap", "convert", recording, "-o", data, "--application-id", "stillbed"]
    subprocess.run(list(map(str, command)), check=True, stderr=subprocess.DEVNULL)
    number = VisualizerComponentMapping(
        "Scalars:scalars",
        ComponentSourceKind.SourceComponent,
        source_component="std_msgs.msg.Float64:message",
        selector=".data",
    )
    lines = {entity: rr.SeriesLines(names=name).visualizer(mappings=[number]) for entity, name in ERRORS.items()}
    pictures = [rrb.Spatial2DView(origin=f"/camera/{name}/image", name=name) for name in names]
    world = rrb.Spatial3DView(origin="/", contents=["$origin/**"], name="surface, nozzle, path")
    errors = rrb.TimeSeriesView(origin="/error", overrides=lines, name="error, m")
    log = rrb.TextLogView(origin="/events", name="events")
    shown = rrb.Vertical(rrb.Horizontal(*pictures), rrb.Horizontal(world, rrb.Vertical(errors, log)))
    rrb.Blueprint(shown).save("stillbed", str(views))
    print(f"rerun {data} {views}")


if __name__ == "__main__":
    run_script(main, __doc__)
