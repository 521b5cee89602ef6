"""Where an arm stands, where its tip is and how late it is, from what the cameras see of its tip."""
