"""The command line: one module a group of commands; the only room that knows all the others."""

__all__ = ["calibrate", "dispenser", "doctor", "live", "main", "parser", "plan", "sessions"]
