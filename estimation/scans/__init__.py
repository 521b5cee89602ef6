"""A scanned mesh: rays and nearest points on it, its registration, and what its shape leaves undetermined."""

__all__ = ["registration", "scan"]
