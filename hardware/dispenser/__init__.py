"""What switches material on and off: contract, drivers, and the line to a device."""

__all__ = ["dispenser", "line_dispenser", "messages"]
