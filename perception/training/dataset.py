"""Labelled pictures: a folder with `images/` and `labels/`, one mask of the same name and size for each picture."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from perception.padding import picture_box

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")


@dataclass(frozen=True, slots=True)
class Labelled:
    """One picture and the wounds in it: name "folder/file", picture (H, W, 3) uint8 RGB, wound (H, W) bool; the
    black padding that some sets carry is cut off both."""

    name: str
    picture: NDArray[np.uint8]
    wound: NDArray[np.bool_]


def read_dataset(folder: Path, seen: Callable[[int, int], None] = lambda done, of: None) -> list[Labelled]:
    """All pictures of one folder in the order of their names; `seen(done, of)` is called after each.

    InputError: no such folder, no picture in it, a picture without its mask, one that cannot be read, another size.
    """
    files = [file for file in _listed(folder / "images") if file.suffix.lower() in SUFFIXES]
    if not files:
        raise InputError(str(folder / "images"), "pictures", "none", f"one at least, ending in {', '.join(SUFFIXES)}")
    masks = {file.stem: file for file in _listed(folder / "labels")}
    labelled = []
    for file in files:
        if file.stem not in masks:
            raise InputError(str(file), "mask", "none", f"a picture named {file.stem} in {folder / 'labels'}")
        labelled.append(_labelled(folder.name, file, masks[file.stem]))
        seen(len(labelled), len(files))
    return labelled


def _listed(folder: Path) -> Sequence[Path]:
    if not folder.is_dir():
        raise InputError(str(folder), "data set", "no such folder", "a folder that holds images/ and labels/")
    return sorted(folder.iterdir())


def _labelled(place: str, file: Path, mask_file: Path) -> Labelled:
    picture = np.asarray(cv2.cvtColor(_read(file, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB), np.uint8)
    mask = _read(mask_file, cv2.IMREAD_GRAYSCALE)
    if mask.shape != picture.shape[:2]:
        raise InputError(str(mask_file), "size (H, W)", mask.shape, f"that of its picture, {picture.shape[:2]}")
    box = picture_box(picture)
    # Masks come as 0/255 and as 0/1; either way the wound is what lies above half of the format's own maximum.
    wound = mask > (127 if mask.max(initial=0) > 1 else 0)
    return Labelled(f"{place}/{file.name}", np.ascontiguousarray(picture[box]), np.ascontiguousarray(wound[box]))


def _read(file: Path, mode: int) -> NDArray[np.uint8]:
    picture = cv2.imread(str(file), mode)
    if picture is None:
        raise InputError(str(file), "picture", "unreadable", f"a whole file of one of {', '.join(SUFFIXES)}")
    return np.asarray(picture, np.uint8)
