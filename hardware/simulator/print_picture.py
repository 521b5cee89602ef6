"""Pictures of a print from above, as SVG: the deposited beads against the planned ones, and the error along the way."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from html import escape
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array
from hardware.report.page import round_step, stretches
from hardware.simulator.deposit import HALF, DepositMap, gaps_and_overlaps
from hardware.simulator.nozzle_run import NozzleResult

KINDS = ("as planned", "missing", "double", "outside")  # of cells, in this order; report.css has them as classes
COLOURS = ((0x5C, 0x97, 0xBD), (0xD0, 0x56, 0x3E), (0xE3, 0xA5, 0x3C), (0x84, 0x66, 0xB8))  # red, green, blue: the same
SHARP = 1000  # px across a picture's longer side, at least: cells are drawn with smooth edges
STEPS = (0.1, 0.25, 0.5, 1.0)  # mm: the error's colours change here
PIECES = 4000  # of the way drawn: more are no longer seen
FOOT = 34  # px below a picture for its scale
NARROW = 40.0  # px, the least height of a picture


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A window onto the surface from above, y up. low, high: (2,) mm, its corners. width: px."""

    low: Array
    high: Array
    width: float

    @property
    def scale(self) -> float:
        """px per mm."""
        return float(self.width / (self.high[0] - self.low[0]))

    @property
    def height(self) -> float:
        """px."""
        return max(float(self.scale * (self.high[1] - self.low[1])), NARROW)

    def pixels(self, points: Array) -> Array:
        """(N, 2) px of points (N, 2) or (N, 3) in the surface frame, mm; x right, y down."""
        return np.stack([points[:, 0] - self.low[0], self.high[1] - points[:, 1]], axis=1) * self.scale

    def svg(self, body: str, name: str) -> str:
        """The picture with its scale below."""
        length = round_step((self.high[0] - self.low[0]) / 6)
        bar = (
            f'<path class="scale" d="M2 {self.height + 10:.1f}v6h{length * self.scale:.1f}v-6"/>'
            f'<text x="2" y="{self.height + 29:.1f}">{length:g} mm</text>'
        )
        box = f'viewBox="0 0 {self.width:g} {self.height + FOOT:.1f}"'
        return f'<svg class="plot" {box} role="img" aria-label="{escape(name)}">{body}{bar}</svg>'


def view_of(deposit: DepositMap, width: float) -> View:
    """The whole map."""
    shape = np.array(deposit.planned.shape[:0:-1])  # (W, H)
    return View(deposit.low, deposit.low + deposit.cell * shape, width)


def bead_picture(result: NozzleResult, layer: int, width: float) -> str:
    """One layer's beads, planned and laid, by KINDS, with the planned path. layer: its index in the map."""
    deposit, line = result.deposit, result.line
    view = view_of(deposit, width)
    planned, laid = deposit.planned[layer], deposit.deposited[layer]
    times = max(1, -(-SHARP // max(planned.shape)))
    size = (planned.shape[1] * times, planned.shape[0] * times)
    planned, laid = (cv2.resize(m, size, interpolation=cv2.INTER_LINEAR) for m in (planned, laid))
    encoded = base64.b64encode(_png(kinds(planned, laid), np.maximum(planned, laid))).decode()
    box = f'width="{view.width:g}" height="{view.scale * (view.high[1] - view.low[1]):.1f}"'
    image = f'<image {box} preserveAspectRatio="none" href="data:image/png;base64,{encoded}"/>'
    plan = view.pixels(line.points)
    pieces = np.flatnonzero(line.printed & (line.layer == deposit.layers[layer]))
    seams = "".join(_polyline("seam", plan[i : i + 2]) for i in pieces)
    return view.svg(image + seams, f"beads of layer {deposit.layers[layer]}")


def kinds(planned: Array, laid: Array) -> NDArray[np.uint8]:
    """Index in KINDS (H, W) of what became of each cell, by the bounds of DepositFigures; empty cells count as 0."""
    kind = np.zeros(planned.shape, np.uint8)
    for number, cells in enumerate(gaps_and_overlaps(planned, laid), 1):
        kind[cells] = number
    kind[(planned < HALF) & (laid >= HALF)] = 3
    return kind


def _png(kind: NDArray[np.uint8], thickness: Array) -> bytes:
    """A PNG (H, W) that is coloured by kind and clear where nothing is; the first row of the map is at its bottom."""
    picture = np.empty((*kind.shape, 4), np.uint8)
    picture[..., :3] = np.array(COLOURS, np.uint8)[kind][..., ::-1]
    picture[..., 3] = np.round(255 * np.clip(4 * thickness - 1.5, 0, 1)).astype(np.uint8)  # half a bead is its edge
    done, data = cv2.imencode(".png", picture[::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert done
    return data.tobytes()


def way_picture(result: NozzleResult, width: float) -> str:
    """The planned path, dashed, and the way of the tip while it printed, coloured by the error."""
    view = view_of(result.deposit, width)
    plan = view.pixels(result.line.points)
    lines = [_polyline("plan", plan[i : i + 2]) for i in np.flatnonzero(result.line.printed)]
    log, distance = result.run.log, result.errors.distance
    tip = view.pixels(log.surface_from_tip)
    stride = max(1, int(np.ceil(log.extrude.sum() / PIECES)))
    for part in stretches(log.extrude & np.isfinite(tip[:, 0])):
        rows = np.append(np.arange(part.start, part.stop - 1, stride), part.stop - 1)
        worst = np.fmax.reduceat(distance, rows)[:-1] if len(rows) > 1 else np.empty(0)
        colour = np.searchsorted(STEPS, np.nan_to_num(worst, nan=np.inf))
        for piece in _equal(colour):
            lines.append(_polyline(f"e{colour[piece.start]}", tip[rows[piece.start : piece.stop + 1]]))
    return view.svg("".join(lines), "the way of the nozzle by its error")


def way_keys() -> list[tuple[str, str]]:
    """Class and words of each colour in `way_picture`."""
    lows = ("", *(f"{step:g}" for step in STEPS))
    words = [f"under {STEPS[0]:g} mm", *(f"{a} to {b:g} mm" for a, b in zip(lows[1:], STEPS[1:], strict=False))]
    return [(f"e{i}", text) for i, text in enumerate([*words, f"over {STEPS[-1]:g} mm"])]


def _equal(values: NDArray[np.int64]) -> list[slice]:
    """Runs of equal neighbours in values (N,)."""
    edges = np.append(np.flatnonzero(np.diff(values, prepend=-1)), len(values))
    return [slice(int(a), int(b)) for a, b in pairwise(edges)]


def _polyline(style: str, points: Array) -> str:
    return f'<path class="{style}" d="M{"L".join(f"{x:.1f} {y:.1f}" for x, y in points)}"/>'
