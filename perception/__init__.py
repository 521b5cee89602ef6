"""From images to observations, and the step that turns a frame set into a pose (floor 1)."""
