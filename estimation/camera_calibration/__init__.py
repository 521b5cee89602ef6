"""From corners of a printed board to a rig: lenses, places, clock offsets, and what each of them may be off by."""
