"""Patches of the surface and the same patches found again: features, optical flow, alignment, masks."""
