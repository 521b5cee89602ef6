"""Live cameras: which one is meant, what it was told, when it exposed, and the sets of frames that belong together."""

__all__ = ["aravis_process", "capture", "feed", "genicam", "inspection", "live", "sources", "stamping"]
