"""Where the surface will be over the next half second: learned experts, stacked, with calibrated intervals."""

__all__ = ["experts", "predictor"]
