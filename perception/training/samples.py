"""Samples to train on: views of labelled pictures as the two looks take them, with something in front and other light.

All numbers that chance decides come from one NumPy generator; pixels are computed by torch, on a CPU or a GPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from perception.training.dataset import Labelled
from perception.wound.network import box_round

LONGEST_SIDE_PX = 640  # of a picture that samples are drawn from: larger ones are made smaller first
LEVELS = 3  # sizes kept of a picture, each half of the last: shrinking by more in one warp would alias


@dataclass(frozen=True, slots=True)
class Augmentation:
    """What is varied, and how often."""

    side: int = 256  # px of a sample: the second look's window
    long_side: float = 320.0  # px of a whole picture: the first look
    whole: float = 0.42  # share of samples seen as the first look sees them
    away: float = 0.13  # share seen at any place and scale; the rest is seen as by the second look
    shares: tuple[float, float] = (0.2, 0.85)  # of the window that a wound takes in the second look
    scales: tuple[float, float] = (0.3, 3.0)  # px of a sample per px of the picture
    stretch: float = 0.1  # deviation of the logarithm of height over width
    cover: float = 0.4  # share of samples with something in front


class Pictures:
    """Labelled pictures in three sizes, on the device that samples are made on; the wound is their fourth channel."""

    def __init__(self, labelled: Sequence[Labelled], weights: NDArray[np.float64], device: str) -> None:
        """weights: (N,) how often each is drawn relative to the others."""
        planes = [_reduced(each) for each in labelled]
        self.sizes = np.array([each.shape[:2] for each in planes])  # (N, 2) height, width in px
        self.boxes = [box_round(each[..., 3] > 127) for each in planes]  # of the wound; None: there is none
        self.shares = weights / weights.sum()
        full = int(np.ceil(self.sizes.max() / 2 ** (LEVELS - 1))) * 2 ** (LEVELS - 1)
        self.levels = []
        for level in range(LEVELS):
            side = full >> level
            stack = np.zeros((len(planes), side, side, 4), np.uint8)
            for number, each in enumerate(planes):
                height, width = (max(1, length >> level) for length in self.sizes[number].tolist())
                stack[number, :height, :width] = cv2.resize(each, (width, height), interpolation=cv2.INTER_AREA)
            self.levels.append(torch.from_numpy(stack).to(device))


def _reduced(labelled: Labelled) -> NDArray[np.uint8]:
    wound = labelled.wound.astype(np.uint8) * np.uint8(255)
    planes = np.dstack([labelled.picture, wound])
    scale = LONGEST_SIDE_PX / max(wound.shape)
    if scale < 1:
        planes = cv2.resize(planes, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(planes, np.uint8)


def draw_samples(source: Pictures, count: int, how: Augmentation, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Pictures (N, 3, side, side) RGB and wounds (N, 1, side, side), both 0..1, on the source's device."""
    chosen = rng.choice(len(source.sizes), count, p=source.shares)
    seen = _views(source, chosen, how, rng)
    pictures, wounds = _covered(seen[:, :3], seen[:, 3:], how.cover, rng)
    return _relit(pictures, rng), wounds


def _views(source: Pictures, chosen: NDArray[np.int64], how: Augmentation, rng: np.random.Generator) -> Tensor:
    """(N, 4, side, side) looks at pictures, turned by any angle, mirrored half the time, stretched and sheared."""
    drawn = [_view(source, number, how, rng) for number in chosen.tolist()]
    level = np.array([level for level, _ in drawn])
    matrices = np.stack([matrix for _, matrix in drawn])
    folded = rng.random(len(chosen)) < 0.5  # the picture's edge as a mirror; as black otherwise
    device = source.levels[0].device
    at = torch.arange(how.side, device=device, dtype=torch.float32) - (how.side - 1) / 2
    seen = torch.empty((len(chosen), 4, how.side, how.side), device=device)
    for each in np.unique(level).tolist():
        of = np.flatnonzero(level == each)
        planes = source.levels[each][torch.from_numpy(chosen[of]).to(device)].permute(0, 3, 1, 2).float() / 255
        sizes = np.maximum(1, source.sizes[chosen[of]] >> each)
        places = []
        for axis, lengths in ((0, sizes[:, 1]), (1, sizes[:, 0])):  # columns, rows
            slopes = matrices[of, axis]
            place = (
                _column(slopes[:, 0], planes)[:, 0] * at[None, None] + _column(slopes[:, 1], planes)[:, 0] * at[:, None]
            )
            place = place + _column(slopes[:, 2], planes)[:, 0]
            last = _column(lengths - 1, planes)[:, 0]
            place = torch.where(_column(folded[of], planes)[:, 0] > 0, _mirrored(place, last), place)
            places.append((place, last))
        inside = torch.stack([(place > -0.5) & (place < last + 0.5) for place, last in places]).all(0)
        far = planes.shape[-1] - 1
        grid = torch.stack([2 * place.clamp(min=0).minimum(last) / far - 1 for place, last in places], -1)
        looks = functional.grid_sample(planes, grid, align_corners=True) * inside[:, None]
        seen[torch.from_numpy(of).to(device)] = looks
    return seen


def _mirrored(places: Tensor, last: Tensor) -> Tensor:
    return last - (places % (2 * last).clamp(min=1) - last).abs()


def _view(
    source: Pictures, number: int, how: Augmentation, rng: np.random.Generator
) -> tuple[int, NDArray[np.float64]]:
    """The level that one look takes, and (2, 3): column and row there from those of the sample about its middle."""
    scale, centre = _scale_and_centre(source, number, how, rng)
    level = int(np.clip(np.floor(-np.log2(scale)), 0, LEVELS - 1))
    angle = rng.normal(0, 0.35) + rng.integers(4) * np.pi / 2
    stretch, shear = np.exp(rng.normal(0, how.stretch / 2)), rng.normal(0, 0.06)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shape = np.array([[stretch, shear], [0, 1 / stretch]]) @ np.diag([rng.choice((-1.0, 1.0)), 1.0])
    return level, np.column_stack([turn @ shape / scale, centre[::-1]]) / 2**level


def _scale_and_centre(
    source: Pictures, number: int, how: Augmentation, rng: np.random.Generator
) -> tuple[float, NDArray[np.float64]]:
    """Px of the sample per px of the picture, and the place (row, column) at its middle."""
    size, box = source.sizes[number].astype(np.float64), source.boxes[number]
    kind = rng.random()
    anywhere = rng.uniform(0.2, 0.8, 2) * size
    if kind < how.away:
        return float(np.exp(rng.uniform(np.log(0.4), np.log(3.0)))), anywhere
    if kind < how.away + how.whole or box is None:
        scale = how.long_side / size.max() * float(np.exp(rng.uniform(-0.3, 0.3)))
        target = (box[:2] + box[2:]) / 2 if box is not None and rng.random() < 0.6 else anywhere
        return scale, target + rng.uniform(-0.35, 0.35, 2) * how.side / scale
    extent = float(np.max(box[2:] - box[:2]))
    share = float(np.exp(rng.uniform(*np.log(how.shares))))
    scale = float(np.clip(how.side * share / extent, *how.scales))
    return scale, (box[:2] + box[2:]) / 2 + rng.normal(0, 0.12, 2) * how.side / scale


MOST_COVERS = 3
POOLED = 16  # places a side among which a cover's is drawn


def _covered(pictures: Tensor, wounds: Tensor, share: float, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """One to three shapes drawn over a share of the pictures: plain things, which hide the wound, or what another
    picture shows there, wound and all."""
    count, side = len(pictures), pictures.shape[-1]
    number = np.where(rng.random(count) < share, np.where(rng.random(count) < 0.4, rng.integers(1, 4, count), 1), 0)
    places = _places(wounds, rng)
    for layer in range(MOST_COVERS):
        shapes = _shapes(side, places[layer], rng, pictures) * _column(number > layer, pictures)
        lent = torch.from_numpy(rng.permutation(count)).to(pictures.device)
        pieces = _column(rng.random(count) < 0.3, pictures) * shapes
        plain = shapes - pieces
        others = pieces * (pictures[lent] - pictures)
        pictures = pictures + plain * (_plain(count, side, rng, pictures) - pictures) + others
        wounds = wounds * (plain < 0.5) + (pieces > 0.5) * (wounds[lent] - wounds)
    return pictures, wounds


def _column(values: NDArray[np.generic], like: Tensor) -> Tensor:
    """(N, 1, 1, 1) of N values, beside pictures."""
    return torch.from_numpy(np.asarray(values, np.float32)).to(like.device).reshape(-1, 1, 1, 1)


def _places(wounds: Tensor, rng: np.random.Generator) -> NDArray[np.float64]:
    """(MOST_COVERS, N, 2) column and row, 0..1: on the wound four times of five, anywhere where there is none."""
    pooled = functional.adaptive_avg_pool2d(wounds, POOLED).flatten(1).cpu().numpy().astype(np.float64)
    drawn = rng.random((MOST_COVERS, len(pooled), 4))
    likely = np.where(drawn[..., :1] < 0.8, pooled, 0) + 1e-9
    steps = np.cumsum(likely, -1) / likely.sum(-1, keepdims=True)
    cell = np.minimum((steps < drawn[..., 1:2]).sum(-1), POOLED**2 - 1)
    return (np.stack([cell % POOLED, cell // POOLED], -1) + drawn[..., 2:]) / POOLED


def _shapes(side: int, places: NDArray[np.float64], rng: np.random.Generator, like: Tensor) -> Tensor:
    """(N, 1, side, side) 0..1: bars, everything beyond a line, or lobed blobs."""
    count = len(places)

    def each(low: float, high: float) -> Tensor:
        return _column(rng.uniform(low, high, count), like)

    axis = (torch.arange(side, device=like.device) + 0.5) / side
    right, down = axis - _column(places[:, 0], like), axis[:, None] - _column(places[:, 1], like)
    angle, kind = each(0, 2 * np.pi), each(0, 1)
    along = torch.cos(angle) * right + torch.sin(angle) * down
    across = torch.cos(angle) * down - torch.sin(angle) * right
    bars = torch.where(kind < 0.25, 1.0, 0.0)
    length = bars * each(0.15, 0.8) + (1 - bars) * each(0.05, 0.5)
    width = bars * each(0.015, 0.1) + (1 - bars) * each(0.15, 1.0)
    boxes = torch.maximum((along - length).abs() - length, across.abs() - width)
    turned = torch.atan2(across, along * torch.exp(_column(rng.normal(0, 0.4, count), like)))
    radius = each(0.06, 0.3)
    for lobes in range(2, 6):
        lobe = torch.cos(lobes * turned + each(0, 2 * np.pi))
        radius = radius * (1 + _column(rng.normal(0, 0.25 / lobes**0.5, count), like) * lobe)
    beyond = torch.where(kind < 0.5, boxes, torch.hypot(across, along) - radius)
    return torch.sigmoid(-beyond * side / each(0.3, 1.0))


def _plain(count: int, side: int, rng: np.random.Generator, like: Tensor) -> Tensor:
    """(N, 3, side, side) gloves, drapes, gauze, tools: one colour that slopes, with grain, a third of them woven."""
    at = torch.linspace(-1, 1, side, device=like.device)
    colour = np.where(rng.random((count, 1)) < 0.5, rng.uniform(0, 1, (count, 1)), rng.uniform(0, 1, (count, 3)))
    plain = torch.from_numpy(colour.astype(np.float32)).to(like.device)[:, :, None, None]
    across, down = (_column(rng.normal(0, 0.1, count), like) for _ in range(2))
    grain = _column(rng.uniform(0, 0.03, count), like) * _noise((count, 1, side, side), rng, like)
    strength, angle = np.where(rng.random(count) < 0.33, rng.uniform(0.03, 0.3, count), 0), rng.uniform(0, np.pi, count)
    threads = rng.uniform(15, 120, count)  # radians from the middle to the edge
    one, other = (_column(threads * part, like) for part in (np.cos(angle), np.sin(angle)))
    woven = torch.sin(one * at + other * at[:, None]) * torch.sin(one * at[:, None] - other * at)
    return (plain + across * at + down * at[:, None] + grain + _column(strength, like) * woven).clamp(0, 1)


def _noise(shape: tuple[int, ...], rng: np.random.Generator, like: Tensor) -> Tensor:
    generator = torch.Generator(like.device).manual_seed(int(rng.integers(2**62)))
    return torch.randn(shape, generator=generator, device=like.device)


GREY = (0.299, 0.587, 0.114)  # ITU-R BT.601
BLUR_REACH = 4  # px to each side


def _relit(pictures: Tensor, rng: np.random.Generator) -> Tensor:
    """The pictures as other cameras might have taken them under other light, in 256 steps."""
    count, side = len(pictures), pictures.shape[-1]
    gamma = _column(np.exp(rng.normal(0, 0.25, count)), pictures)
    balance = np.exp(rng.normal(0, 0.15, (count, 1)) + rng.normal(0, 0.08, (count, 3))).astype(np.float32)
    seen = pictures.clamp(1e-4, 1) ** gamma * torch.from_numpy(balance).to(pictures.device)[:, :, None, None]
    weights = torch.tensor(GREY, device=pictures.device)[None, :, None, None]
    grey = (seen * weights).sum(1, keepdim=True)
    saturation = np.where(rng.random(count) < 0.04, 0.0, rng.uniform(0.5, 1.4, count))
    seen = grey + _column(saturation, pictures) * _hue_turned(seen - grey, rng)
    tilt = np.where(rng.random(count) < 0.33, 1, 0)
    slope = torch.linspace(-1, 1, side, device=pictures.device)
    across, down = (_column(tilt * rng.normal(0, 0.25, count), pictures) for _ in range(2))
    seen = seen * (1 + across * slope + down * slope[:, None]).clamp(0.2, 2)
    seen = _blurred(seen, np.where(rng.random(count) < 0.25, rng.uniform(0.4, 1.8, count), 0.05))
    loud = np.where(rng.random(count) < 0.3, rng.uniform(0.008, 0.04, count), 0)
    seen = seen + _column(loud, pictures) * _noise(tuple(seen.shape), rng, pictures)
    return (seen.clamp(0, 1) * 255).round() / 255


def _hue_turned(colours: Tensor, rng: np.random.Generator) -> Tensor:
    """Differences to grey turned about the grey axis by a small angle, a third of the time."""
    angle = np.where(rng.random(len(colours)) < 0.3, rng.normal(0, 0.15, len(colours)), 0)
    cosine, sine = _column(np.cos(angle), colours), _column(np.sin(angle), colours)
    crossed = torch.stack(
        [colours[:, 2] - colours[:, 1], colours[:, 0] - colours[:, 2], colours[:, 1] - colours[:, 0]], 1
    )
    along = colours.mean(1, keepdim=True)  # Rodrigues about (1, 1, 1) / sqrt(3)
    return cosine * colours + sine * crossed / 3**0.5 + (1 - cosine) * along


def _blurred(pictures: Tensor, sigma: NDArray[np.float64]) -> Tensor:
    """Each blurred by a Gaussian of its own deviation in px."""
    reach = np.arange(-BLUR_REACH, BLUR_REACH + 1)
    kernels = np.exp(-0.5 * (reach[None] / sigma[:, None]) ** 2)
    kernels = np.repeat(kernels / kernels.sum(1, keepdims=True), 3, 0).astype(np.float32)
    kernel = torch.from_numpy(kernels).to(pictures.device)
    planes = pictures.flatten(0, 1)[None]
    for each in (kernel[:, None, None, :], kernel[:, None, :, None]):
        room = (BLUR_REACH, BLUR_REACH, 0, 0) if each.shape[-1] > 1 else (0, 0, BLUR_REACH, BLUR_REACH)
        planes = functional.conv2d(functional.pad(planes, room, mode="replicate"), each, groups=planes.shape[1])
    return planes.reshape(pictures.shape)
