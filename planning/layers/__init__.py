"""From a scan to checkpoints: repair, wound volume, layers, and the tool's way over them (thesis 5.2).

Frames: the scan's own coordinates are the `surface` frame. `plane` has its origin over the middle of the wound, z along
the mean normal of the skin there, and x as near to the scan's x as that allows; heights are z over it. `chart` is the
plane stretched so that lengths along the skin are true: beads are laid in it, mm.
"""

__all__ = ["checkpoints", "grid", "outline", "plan", "repair", "skin", "slicing", "wound"]
