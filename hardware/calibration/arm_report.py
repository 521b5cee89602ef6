"""The report of an arm's calibration: the verdict, the numbers, the tips as they were found, and what is left over."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

import numpy as np

from estimation import se3
from estimation.calibration.arm_model import predict
from estimation.se3 import Array
from hardware.arm_calibration.verdict import seen_words
from hardware.calibration.arm_solve import ArmCalibration, kinematics_of
from hardware.calibration.verdict import Verdict
from hardware.files.images import encode
from hardware.page import document, figures_table, legend, line_key, row_of_tiles, section, tile

STRETCH = 100  # times, residuals are drawn
SCALED = 4  # times, pictures of tips are enlarged
QUALITY = 90  # of JPEG
PLOT = (900, 220)  # px of the chart of delays
SHOWN = 0.35  # of the plot's height that the largest excursion takes


def page(title: str, found: ArmCalibration, verdict: Verdict, against: Sequence[tuple[str, str, str]] = ()) -> str:
    """The page as HTML. against: rows of what is known exactly, if it is: what, error, and its stated sigma."""
    state, sigma = found.fit.state, found.fit.sigma
    latency = f"{1e3 * (state.dead_time + state.lag):.0f}"
    tiles = [
        tile(f"{np.percentile(found.error, 95):.3f}", "mm", "tip, 19 of 20 places"),
        tile(f"{np.nanmedian(found.held_mm):.3f}", "mm", "beside, pictures held out"),
        tile(latency, "ms", "late in all"),
        tile(str(int(found.fit.used.sum())), "", "tips used"),
    ]
    said = "".join(f"<li>{escape(words)}</li>" for words in (*verdict.lines, *verdict.hints))
    body = [row_of_tiles(tiles), section("Verdict", "What was found, and what to do next.", f"<ul>{said}</ul>")]
    body.append(section("Numbers", "One sigma behind each figure.", _numbers(found, sigma)))
    if against:
        rows = [list(row) for row in against]
        body.append(section("Beside the truth", "This arm is simulated.", figures_table(["", "off", "stated"], rows)))
    body.append(section("The tip as it was found", "A cross where its end is measured.", _crops(found)))
    text = f"From each tip to where the arm puts it, {STRETCH} times as long."
    body.append(section("Residuals", text, _residuals(found)))
    if found.asked.latency:
        text = "How far the tip lies behind where it was sent, over its speed; the line is what was found."
        body.append(section("Latency", text, _latency(found)))
    word = "passed" if verdict.passed else "failed"
    lead = f"Calibration of the arm {word}: {verdict.lines[0]}."
    return document("stillbed calibrate arm", title, lead, body, "Lengths in mm. Places: where the arm rested.")


def _numbers(found: ArmCalibration, sigma: Array) -> str:
    state = found.fit.state
    arm_from_base = se3.inverse(state.base_from_arm)
    turn = np.degrees(se3.angle_of(arm_from_base))
    dead, lag = (f"{1e3 * s:.2f}" if found.asked.latency else "kept" for s in sigma[9:11])
    rows = [
        ["place of the base in the arm's frame, mm", _three(arm_from_base[:3, 3]), f"{np.linalg.norm(sigma[3:6]):.3f}"],
        ["its turn, degrees", f"{turn:.3f}", f"{np.degrees(np.linalg.norm(sigma[:3])):.4f}"],
        ["tip in the tool, mm", _three(np.asarray(state.tool)), _three(sigma[6:9], 3) if found.asked.tool else "kept"],
        ["dead time, ms", f"{1e3 * state.dead_time:.2f}", dead],
        ["servo's lag, ms", f"{1e3 * state.lag:.2f}", lag],
        ["radius of the needle's end, mm", f"{state.blunt:.2f}", f"{sigma[11]:.2f}"],
        ["scatter, in the sigmas of single tips", f"{found.fit.scatter:.2f}", ""],
    ]
    for c, camera in enumerate(found.rig.cameras):
        place = (arm_from_base @ camera.base_from_camera)[:3, 3]
        rows.append([f"{camera.name} in the arm's frame, mm", _three(place), seen_words(found, c)])
    return figures_table(["", "found", "±, or the tip"], rows)


def _three(values: Array, digits: int = 2) -> str:
    return " ".join(f"{v:.{digits}f}" for v in values)


def _crops(found: ArmCalibration) -> str:
    figures = []
    for camera, (images, pixels) in zip(found.rig.cameras, found.look.crops, strict=True):
        for image, pixel in zip(images, pixels, strict=True):
            h, w = image.shape[:2]
            data = base64.b64encode(encode(np.ascontiguousarray(image), QUALITY)[1]).decode()
            x, y = pixel + 0.5
            cross = f'<path class="truth" stroke-width="0.4" d="M{x - 4:.2f} {y:.2f}h8M{x:.2f} {y - 4:.2f}v8"/>'
            place = f'width="{w}" height="{h}" style="image-rendering:pixelated"'
            picture = f'<image href="data:image/jpeg;base64,{data}" {place}/>'
            svg = f'<svg class="plot" viewBox="0 0 {w} {h}" role="img" aria-label="tip" style="width:{SCALED * w}px">'
            figures.append(
                f"<figure>{svg}{picture}{cross}</svg><figcaption>{escape(camera.name)}</figcaption></figure>"
            )
    return f'<div class="pictures">{"".join(figures)}</div>'


def _residuals(found: ArmCalibration) -> str:
    s, figures = found.look.sightings, []
    for c, camera in enumerate(found.rig.cameras):
        rows = (s.camera == c) & found.fit.used
        ends = s.pixels[rows] + STRETCH * found.fit.residuals[rows]
        w, h = camera.size
        lines = "".join(
            f'<path class="truth" stroke-width="3" d="M{a:.0f} {b:.0f}L{x:.0f} {y:.0f}"/>'
            f'<circle class="estimate" cx="{a:.0f}" cy="{b:.0f}" r="5"/>'
            for (a, b), (x, y) in zip(s.pixels[rows], ends, strict=True)
        )
        frame = f'<rect class="frame" width="{w}" height="{h}" fill="none" stroke="var(--faint)" stroke-width="4"/>'
        median = float(np.median(np.linalg.norm(found.fit.residuals[rows], axis=1))) if rows.any() else float("nan")
        words = f"{camera.name}: {int(rows.sum())} tips, median {median:.2f} px"
        svg = f'<svg class="plot" viewBox="0 0 {w} {h}" role="img" aria-label="residuals">{frame}{lines}</svg>'
        figures.append(f"<figure>{svg}<figcaption>{escape(words)}</figcaption></figure>")
    return f'<div class="pictures">{"".join(figures)}</div>'


def behind(found: ArmCalibration) -> tuple[Array, Array]:
    """Speed (M,), mm/s, of the set-point at sightings on the way, and by how much (M,), mm, the tip lies behind it.

    Seen by one camera: along its image of the way, in the tip's depth.
    """
    s, state = found.look.sightings, found.fit.state
    rows = (s.place < 0) & found.fit.used
    at = s.take(rows)
    kinematics = kinematics_of(found.profile.arm)
    now = predict(state, found.set_point, kinematics, found.rig, at.stamp, at.camera)
    step = 0.005
    axes = [kinematics(found.set_point.lagged(at.stamp + h, 0.0, step))[:, :3, 3] for h in (-step, step)]
    speed = np.linalg.norm(axes[1] - axes[0], axis=1) / (2 * step)
    along = -now.by_time[..., 0]  # px/s of the tip's picture
    rate = np.linalg.norm(along, axis=1)
    beside = np.einsum("ni,ni->n", at.pixels - now.pixels, along) / np.maximum(rate, 1e-9) ** 2  # s ahead
    late = state.dead_time + state.lag
    known = (speed > 5.0) & (rate > 5.0)
    return speed[known], ((late - beside) * speed)[known]


def _latency(found: ArmCalibration) -> str:
    speed, late = behind(found)
    if not len(speed):
        return '<p class="note">no pictures on the way</p>'
    width, height = PLOT
    most, top = float(speed.max()) * 1.05, max(float(np.percentile(np.abs(late), 98)) * 1.2, 0.1)
    x, y = speed / most * width, height * (1 - np.clip(late / top, -0.1, 1.0))
    dots = "".join(f'<circle class="estimate" cx="{a:.1f}" cy="{b:.1f}" r="3"/>' for a, b in zip(x, y, strict=True))
    total = found.fit.state.dead_time + found.fit.state.lag
    line = f'<path class="truth" stroke-width="2" d="M0 {height}L{width} {height * (1 - total * most / top):.1f}"/>'
    axis = f'<path stroke="var(--faint)" d="M0 {height}H{width}M0 0V{height}"/>'
    words = (
        f'<text x="{width - 8}" y="{height - 8}" text-anchor="end">{most:.0f} mm/s</text>'
        f'<text x="8" y="16">{top:.1f} mm behind</text>'
    )
    svg = f'<svg class="plot" viewBox="0 0 {width} {height + 2}" role="img" aria-label="latency">'
    keys = [line_key("truth", f"{1e3 * total:.1f} ms")]
    return f"{svg}{axis}{line}{dots}{words}</svg>{legend(keys)}"
