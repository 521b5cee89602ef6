"""The arm: the link that any arm has above the seam, and the drivers below it, one for each make."""
