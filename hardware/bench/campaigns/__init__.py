"""Long campaigns for developers: faults, fuzzing, the arm's link, outages."""
