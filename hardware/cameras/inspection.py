"""Inspection of live cameras: what each delivers, how their stamps differ, as text, JSON and a sheet of pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from hardware.cameras.capture import Transport
from hardware.cameras.feed import CameraPhase, CameraState, LiveHealth
from hardware.cameras.live import LiveCameras
from hardware.process.clock import Clock
from perception.frames import FrameSet, Image

CELL_SIZE = (640, 360)  # px, width and height of a camera's picture on the sheet
LINE_HEIGHT = 26  # px, height of a line of words
SHEET_COLUMNS = 2
BLOWN_LEVEL = 250  # grey level from which a pixel is blown out
PAPER_COLOUR, INK_COLOUR, ALARM_COLOUR = (32, 32, 32), (235, 235, 235), (80, 80, 255)


def sharpness(image: Image) -> float:
    """Variance of the Laplacian (Pech-Pacheco 2000) of an (H, W) or (H, W, 3) BGR image; to be compared with itself."""
    return float(cv2.Laplacian(_grey(image), cv2.CV_32F).var())


def preview_sheet(cameras: Sequence[tuple[Image | None, Sequence[str], bool]]) -> Image:
    """(H, W, 3) BGR: one cell per camera with its picture, if any, and lines of text, alarming unless all is well."""
    lines = max(len(words) for _, words, _ in cameras)
    cells = [_cell(image, words, well, lines) for image, words, well in cameras]
    columns = min(SHEET_COLUMNS, len(cells))
    empty = np.full_like(cells[0], PAPER_COLOUR)
    rows = [cells[i : i + columns] for i in range(0, len(cells), columns)]
    return np.vstack([np.hstack([*row, *[empty] * (columns - len(row))]) for row in rows])


def _cell(image: Image | None, lines_of_text: Sequence[str], well: bool, lines: int) -> Image:
    cell = np.full((CELL_SIZE[1] + lines * LINE_HEIGHT + LINE_HEIGHT // 2, CELL_SIZE[0], 3), PAPER_COLOUR, np.uint8)
    if image is not None:
        scale = min(CELL_SIZE[0] / image.shape[1], CELL_SIZE[1] / image.shape[0])
        size = (max(1, round(scale * image.shape[1])), max(1, round(scale * image.shape[0])))
        coloured = image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
        small = cv2.resize(coloured, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        x, y = (CELL_SIZE[0] - size[0]) // 2, (CELL_SIZE[1] - size[1]) // 2
        cell[y : y + size[1], x : x + size[0]] = small
    colour = INK_COLOUR if well else ALARM_COLOUR
    for i, line in enumerate(lines_of_text):
        place = 8, CELL_SIZE[1] + LINE_HEIGHT * (i + 1) - LINE_HEIGHT // 4
        cv2.putText(cell, line, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)
    return cell


def _grey(image: Image) -> Image:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


STAMP_SOURCES = {"driver": "by its driver", "stream": "by its stream", "arrival": "by arrival", "": "not at all"}


@dataclass(frozen=True, slots=True, eq=False)
class Inspection:
    """What was seen.

    offsets, scatter: (C,) s, median and deviation of each camera's stamp from the first one's in the same set; nan
    where they never met.
    """

    health: LiveHealth
    offsets: tuple[float, ...]
    scatter: tuple[float, ...]

    @property
    def faulty(self) -> bool:
        """Whether a camera is in trouble; a file that has been played is not."""
        return any(camera.trouble and camera.phase is not CameraPhase.ENDED for camera in self.health.cameras)


def inspect(live: LiveCameras, seconds: float, clock: Clock) -> Inspection:
    """Watch cameras that have been started for so many seconds, or until they end."""
    end = clock.now() + seconds
    sets: list[FrameSet] = []
    while clock.now() < end and (one := live.next_set(end)) is not None:
        sets.append(one)
    health = live.health()
    lags = [_behind(sets, camera) for camera in range(len(health.cameras))]
    return Inspection(health, tuple(median for median, _ in lags), tuple(scatter for _, scatter in lags))


def _behind(sets: Sequence[FrameSet], camera: int) -> tuple[float, float]:
    stamps = [{frame.camera: frame.stamp for frame in one.frames} for one in sets]
    off = np.array([s[camera] - s[0] for s in stamps if camera in s and 0 in s])
    return (float(np.median(off)), float(off.std())) if len(off) else (math.nan, math.nan)


def inspection_table(inspection: Inspection) -> dict[str, Any]:
    """For JSON: plain numbers with their units in the keys, None for what is not known."""
    health = inspection.health
    rows = zip(health.cameras, inspection.offsets, inspection.scatter, strict=True)
    return {
        "cameras": [_camera_table(*row) for row in rows],
        "sets": health.sets,
        "complete_sets": health.complete,
        "late_frames": health.late,
        "trouble": health.trouble,
    }


def _camera_table(camera: CameraState, offset: float, scatter: float) -> dict[str, Any]:
    image = camera.newest
    grey = None if image is None else _grey(image)
    return {
        "name": camera.name,
        "source": camera.source,
        "size_px": None if image is None else list(image.shape[1::-1]),
        "rate_hz": _known(camera.rate),
        "jitter_ms": _known(1e3 * camera.jitter),
        "lag_ms": _known(1e3 * camera.lag),
        "stamped": camera.by or None,
        "offset_ms": _known(1e3 * offset),
        "offset_scatter_ms": _known(1e3 * scatter),
        "sharpness": None if grey is None else round(sharpness(grey), 1),
        "grey_level": None if grey is None else round(float(grey.mean()), 1),
        "blown_out": None if grey is None else round(float((grey >= BLOWN_LEVEL).mean()), 4),
        "frames": camera.given,
        "missed": camera.missed,
        "not_fetched": camera.overrun,
        "left_out": dict(sorted((fault.name.lower(), count) for fault, count in camera.faults.items())),
        "reopened": camera.reopened,
        "transport": _transport_table(camera.transport),
        "controls": [
            {"name": c.name, "asked": c.requested, "got": c.actual, "automatic": c.automatic, "taken": c.accepted}
            for c in camera.controls
        ],
        "trouble": camera.trouble,
    }


def _transport_table(transport: Transport | None) -> dict[str, Any] | None:
    if transport is None:
        return None
    counts = {f"{name}_packets": getattr(transport, name) for name in ("received", "lost", "resent")}
    clock = {"clock_drift_ppm": _known(-1e6 * transport.drift), "clock_doubt_ms": _known(1e3 * transport.doubt)}
    return counts | {"frames_without_packets": transport.frames_lost} | clock


def _transport_text(one: dict[str, Any]) -> str:
    drift, doubt = one["clock_drift_ppm"], one["clock_doubt_ms"]
    clock = "its clock is not known yet" if drift is None else f"its clock runs {drift:+.1f} ppm beside ours"
    known = "by arrivals, so that a constant delay stays" if doubt is None else f"known to {doubt:.2g} ms"
    return (
        f"packets: {one['received_packets']} came, {one['lost_packets']} lost, {one['resent_packets']} sent again; "
        f"{one['frames_without_packets']} frames lost; {clock}, {known}"
    )


def _known(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 3)


def inspection_text(inspection: Inspection) -> str:
    """A paragraph a camera, and one about their sets."""
    health, tables = inspection.health, inspection_table(inspection)["cameras"]
    paragraphs = ["\n  ".join([one["name"], *camera_lines(one)]) for one in tables]
    if len(health.cameras) > 1:
        share = f" ({100 * health.complete / health.sets:.1f} %)" if health.sets else ""
        sets = f"{health.sets} sets, {health.complete} with all cameras{share}"
        paragraphs.append(f"{sets}, {health.late} frames too late")
    return "\n\n".join(paragraphs)


def camera_lines(one: dict[str, Any]) -> list[str]:
    """What is known of one camera (as in `inspection_table`), a line each."""
    if one["size_px"] is None:
        return [one["source"], f"TROUBLE: {one['trouble'] or 'no picture came'}"]
    width, height = one["size_px"]
    left_out = ", ".join(f"{count} {name}" for name, count in one["left_out"].items())
    controls = ", ".join(_control_text(c) for c in one["controls"])
    lines = [
        one["source"],
        f"{width} x {height} px, {_number(one['rate_hz'])} Hz, jitter {_number(one['jitter_ms'])} ms, "
        f"lag {_number(one['lag_ms'])} ms, stamped {STAMP_SOURCES[one['stamped'] or '']}",
        _offset_text(one),
        f"sharpness {one['sharpness']:.0f}, grey level {one['grey_level']:.0f}, "
        f"{100 * one['blown_out']:.1f} % blown out",
        f"{one['frames']} frames; {one['missed']} missed; left out: {left_out or 'none'}",
    ]
    lines += [f"controls: {controls}"] if controls else []
    lines += [_transport_text(one["transport"])] if one["transport"] else []
    return lines + ([f"TROUBLE: {one['trouble']}"] if one["trouble"] else [])


def _offset_text(one: dict[str, Any]) -> str:
    if one["offset_ms"] is None:
        return "never in a set with the first camera"
    return f"{_number(one['offset_ms'])} ms after the first camera's stamp, +- {_number(one['offset_scatter_ms'])} ms"


def _control_text(control: dict[str, Any]) -> str:
    got = "not there" if control["got"] is None else _number(control["got"])
    if not control["taken"]:
        return f"{control['name']} {got} (asked for {_number(control['asked'])}: NOT TAKEN)"
    state = "automatic" if control["automatic"] else "locked" if control["asked"] is not None else "not asked"
    return f"{control['name']} {got} ({state})"


def _number(value: float | str | None) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def inspection_sheet(inspection: Inspection) -> Image:
    """(H, W, 3) BGR: each camera's last picture with what is known of it."""
    pairs = zip(inspection.health.cameras, inspection_table(inspection)["cameras"], strict=True)
    return preview_sheet([(c.newest, [one["name"], *camera_lines(one)[1:]], not one["trouble"]) for c, one in pairs])
