"""From a region of the plane to the ordered, extruded lines that fill it (thesis 5.2 and 5.3)."""
