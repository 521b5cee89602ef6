"""From checkpoints on the surface to motion that arm and tissue can bear (floor 1; knows nothing of images)."""

__all__ = ["command", "fill", "kinematics", "laid_beads", "layers", "material", "motion", "path", "placement", "urdf"]
