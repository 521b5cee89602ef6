"""The simulated world: a moving wound, three cameras and a virtual arm, in virtual time and with exact truth."""

__all__ = [
    "arm", "camera_pipeline", "cameras", "deposit", "dispenser", "material", "motion_table", "nozzle_error",
    "nozzle_report", "nozzle_summary", "run_folder", "scenario", "scenario_tables", "scene", "simulate",
    "trace_file", "truth", "watched_arm", "world",
]  # fmt: skip
