"""The tracking step: one frame set in, one surface pose out; and tracks found anew once a motion is known."""

__all__ = [
    "MAP_METHOD", "THESIS_FLOW_METHOD", "THESIS_METHOD", "TRACKING_METHODS",
    "reobservation", "step", "wound_area", "wound_step",
]  # fmt: skip

MAP_METHOD, THESIS_METHOD, THESIS_FLOW_METHOD = "map", "thesis", "thesis-flow"
TRACKING_METHODS = {
    MAP_METHOD: "the pose from all cameras against a map of the surface",
    THESIS_METHOD: "the thesis's estimator: SIFT and FLANN, median displacement, an axis a camera",
    THESIS_FLOW_METHOD: "the same with Shi-Tomasi corners and optical flow",
}
