"""Synthetic worlds for tests and benches: how a surface moves, what cameras see of it, and all that goes wrong in it.

`synthetic_world("breathing", noise=0.25, seed=3)` of `estimation.synthetic.world` makes one in a line, as pytest's
fixture of the same name does. Nothing is drawn as a picture: a world gives what a matcher would make of the pictures.
"""

__all__ = ["follow", "movements", "plugin", "world"]
