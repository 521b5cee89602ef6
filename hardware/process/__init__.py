"""What every process needs and what knows nothing of the rest: clock, progress, checks, shared memory, named faults."""
