"""The world: sessions, recorder, arm, clock, loops and the command line (floor 2, the only one that knows files)."""

__all__ = [
    "arm", "bench", "calibration", "cameras", "cli", "dispenser", "files", "live", "motion", "offline",
    "operator", "plan", "process", "recording", "report", "simulator",
]  # fmt: skip
