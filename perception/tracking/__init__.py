"""The tracking step: one frame set in, one surface pose out; and tracks found anew once a motion is known."""

__all__ = ["reobservation", "step", "wound_area", "wound_step"]
