"""The live run: processes, stages, stopping, recording and resuming of a print before real or pre-rendered cameras."""

__all__ = [
    "camera_recording", "checklist", "fault_injection", "frame_source", "ipc", "motion_process", "outcome",
    "prepared", "prerender", "recorded_run", "recorder_process", "records", "run", "settings", "state_machine",
    "trace", "tracking_process", "view",
]  # fmt: skip
