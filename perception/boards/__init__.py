"""Printed calibration boards: what is drawn on them, and their corners in a picture."""

__all__ = ["board", "needle_tip"]
