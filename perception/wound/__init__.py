"""Where the wound is in a picture: the network, shape matching, and both filtered over time."""

__all__ = ["network", "segmentation", "shape_matching"]
