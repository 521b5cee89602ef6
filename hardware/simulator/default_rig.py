"""The simulator's own names for the rig of thesis Fig. 4.3 and the wound's rest before it."""

from estimation.synthetic.arc_rig import REST, TARGET, TILT, arc_rig

__all__ = ["REST", "TARGET", "TILT", "arc_rig"]
