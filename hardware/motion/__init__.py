"""The motion of a run: MotionStep without a clock, and the 50 Hz loop that drives the arm with it."""

__all__ = ["loop", "step"]
