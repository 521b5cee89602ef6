"""A run in one line, for the terminal."""

from __future__ import annotations

from hardware.live.state_machine import Conductor, Seen
from hardware.operator.view import Stage, Verdict


def status_line(conductor: Conductor, seen: Seen) -> str:
    """Stage, place, state of the surface and why the nozzle stands; in the check, what is waited for."""
    if conductor.stage is Stage.CHECK:
        waits = [c for c in conductor.checks if c.verdict in (Verdict.BUSY, Verdict.FAIL) and c.name != "reach"]
        return "check: " + "; ".join(f"{check.name}: {check.found}" for check in waits)
    pose = None if seen.tracking is None else seen.tracking.pose
    state = "no pose" if pose is None else pose.state.value
    if conductor.stage is Stage.FIND and conductor.laid is not None:
        return f"find: out of reach: {conductor.laid.unreachable}"
    if seen.motion is None or seen.motion.progress is None:
        return f"{conductor.stage.value}: {state}"
    progress, command = seen.motion.progress, seen.motion.tick.command
    held = f", holds: {command.reason}" if command.reason else ""
    if conductor.missed:
        held = f", {conductor.missed}"
    return f"{conductor.stage.value}: {progress.fraction:.1f} of {progress.total - 1} checkpoints, {state}{held}"


def stage_line(stage: Stage, reason: str) -> str:
    """The stage, and why; a reason that begins with the stage says both."""
    if not reason or reason.startswith(stage.value):
        return reason or stage.value
    return f"{stage.value}: {reason}"
