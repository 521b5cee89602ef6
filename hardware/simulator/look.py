"""How a scene looks: skin, wetness, drape, lamps."""

from __future__ import annotations

from dataclasses import dataclass

from perception.frames import Image


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """How a scene looks.

    texel: mm of the texture. tone: 0 fair to 1 dark skin. wetness: 0 dry to 1 dripping. hair: 0 none, 1 an arm's.
    drape: whether a surgical drape with an opening lies round the skin and moves with it; without one the shape is a
    patch before a cloth at rest. texture: (H, W, 3) BGR over the whole shape (row 0 at the least y) instead of skin.
    lit: whether light falls on it; else a texture is imaged as it is. ambient, key, fill: what a white surface that
    faces them gets of the room, of the lamp and of the one opposite.
    """

    texel: float = 0.1
    tone: float = 0.2
    wetness: float = 0.6
    hair: float = 0.5
    drape: bool = True
    texture: Image | None = None
    lit: bool = True
    ambient: float = 0.3
    key: float = 0.62
    fill: float = 0.2


def plain(texture: Image, texel: float = 0.15) -> Look:
    """The look of a picture (H, W, 3) BGR that is imaged as it is: no drape, no lamps, no gloss."""
    return Look(texel=texel, drape=False, texture=texture, lit=False)
