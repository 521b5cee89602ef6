"""Measured figures of every part, each beside its target and its reference: `stillbed bench SUBJECT`."""
