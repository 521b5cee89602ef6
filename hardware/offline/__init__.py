"""Work on recorded sessions: track, replay, smooth, compare, segment, convert and view them."""
