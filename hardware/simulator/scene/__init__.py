"""The simulated scene and its renderer: body, wound, drape, print head, light and sensor."""

__all__ = ["appearance", "fields", "rays", "render", "scene", "shape", "surface_picture", "textures"]
