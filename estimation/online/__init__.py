"""Frame set by frame set: a pose fitted to the map, GTSAM's sliding window, the reported covariance, the state."""
