"""Long campaigns for developers: faults, fuzzing, the arm's link, outages."""

__all__ = ["faults", "fuzz", "fuzz_process", "guard", "link", "link_live", "outages"]
