"""Names of the motion's stages, as they stand in reports and recordings."""

FRAMES_TO_WIRE = "frames handed over to move on the wire"
EXPOSURE_TO_WIRE = "exposure to move on the wire"
LATE = "tick late"
