"""Campaigns: many seeded sessions against the whole tracker, each a package that is run by `python -m`."""
