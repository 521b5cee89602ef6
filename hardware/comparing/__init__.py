"""`stillbed compare`: one trajectory judged by another, in the numbers that evo would give."""
