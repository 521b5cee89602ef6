"""The arm: the link that any arm has above the seam, and the drivers below it, one for each make."""

__all__ = [
    "console", "device", "driver", "feedback", "franka", "gcode", "jog", "link", "port", "profile", "protocol", "queue",
    "s6h4d",
]  # fmt: skip
