"""What every process needs and what knows nothing of the rest: clock, progress, checks, shared memory, named faults."""

__all__ = ["checks", "clock", "faults", "progress", "system"]
