"""The world: sessions, recorder, arm, clock, loops and the command line (floor 2, the only one that knows files)."""
