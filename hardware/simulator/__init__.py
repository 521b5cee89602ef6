"""The simulated world: a moving wound, three cameras and a virtual arm, in virtual time and with exact truth."""
