"""`stillbed smooth`: recorded sessions smoothed after the fact, and what is written of them."""
