"""The estimator of the thesis this system starts from (4.2-4.6 and Appendix A): a baseline to be measured beside.

Each camera finds the surface's features again from image to image, takes the median of how far they moved and the
turn of a homography through them, scales pixels to mm by a factor of its own, and gives each axis of the world to the
one camera that sees it best. The moves are added up.

Written from the thesis's text. Where text, equations and Appendix A's program part, or are wrong, the sound reading is
taken and named in the docstring of what it concerns. What the thesis leaves to its segmentation network, where the
surface is in every image, is told for the first images only and carried along by the features.
"""

__all__ = ["camera", "step"]
