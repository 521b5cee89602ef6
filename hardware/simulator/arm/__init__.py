"""The virtual SEED S6H4D: controller, servos, and the serial line or pseudo-terminal that leads to it."""

__all__ = ["controller", "ports", "settings"]
