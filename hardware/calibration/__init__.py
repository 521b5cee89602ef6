"""Calibrating cameras and arm: recordings in, rig files, reports and verdicts out."""
