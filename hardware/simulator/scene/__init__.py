"""The simulated scene and its renderer: body, wound, drape, print head, light and sensor."""
