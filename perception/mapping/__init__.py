"""The map made from pictures: first map, matching of its patches in new pictures, growth, a scan's landmarks."""

__all__ = [
    "aliases", "alignment_kernels", "features", "first_map", "growth", "mapping", "masks", "matcher", "patches",
    "scan_map", "surface_heights", "verification",
]  # fmt: skip
