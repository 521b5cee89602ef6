"""What switches material on and off: contract, drivers, and the line to a device."""
