"""Frame set by frame set: a pose fitted to the map, GTSAM's sliding window, the reported covariance, the state."""

__all__ = [
    "bump_detector", "camera_errors", "camera_health", "deformation", "estimator", "fit", "local_motion",
    "parted_texture", "reported_covariance", "surface_state", "window",
]  # fmt: skip
