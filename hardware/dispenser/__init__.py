"""What switches material on and off: contract, drivers, and the line to a device."""

__all__ = ["dispenser", "http_port", "line_dispenser", "messages"]
