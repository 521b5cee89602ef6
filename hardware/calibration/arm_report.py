"""Verdict and report of an arm's calibration: parameters, detected tips, residuals and latency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.calibration.arm_model import predict
from estimation.se3 import Array
from hardware.calibration.arm_solve import ArmCalibration, kinematics_of
from hardware.calibration.report import CalibrationVerdict, bullets, picture_frame
from hardware.files.images import encode
from hardware.report.page import (
    captioned,
    chart,
    data_url,
    document,
    figure_row,
    figures_table,
    legend,
    line_key,
    row_of_tiles,
    section,
    tile,
)

MAX_HELD_OUT_ERROR = 0.3  # mm, median of held-out pictures: outliers and a bent arm are beyond it
MAX_LAG_SIGMA = 0.005  # s, one sigma of the arm's lag: at 20 mm/s a tenth of a millimetre
MIN_TIP_SHARE = 0.3  # of a camera's pictures in which the tip is found
RESIDUAL_SCALE = 100  # enlargement of the residuals drawn
CROP_SCALE = 4  # enlargement of the pictures of tips
CROP_QUALITY = 90  # of JPEG
PLOT_SIZE = (900, 220)  # px of the chart of delays


def judge_arm(result: ArmCalibration, limit: float) -> CalibrationVerdict:
    """The verdict. limit: mm, one sigma of the tip in 19 of 20 places."""
    typical, worst = float(np.sqrt(np.mean(result.error**2))), float(np.percentile(result.error, 95))
    median_error, px = float(np.nanmedian(result.held_mm)), float(np.nanmedian(result.held_px))
    sigma, state = result.fit.sigma, result.fit.state
    lag_sigma = float(np.sqrt(max(result.fit.covariance[9:11, 9:11].sum(), 0.0)))
    good = [worst <= limit, median_error <= MAX_HELD_OUT_ERROR, lag_sigma <= MAX_LAG_SIGMA]
    word = "good enough" if good[0] else "NOT good enough"
    lines = [
        f"{word} to print: the tip is where it is thought to be within {typical:.3f} mm (one sigma), in 19 of 20 "
        f"places within {worst:.3f} mm; {limit:g} mm is allowed",
        f"pictures that took no part lie {median_error:.3f} mm ({px:.2f} px) beside where the arm should be (median); "
        f"{MAX_HELD_OUT_ERROR:g} mm is allowed",
    ]
    if result.unknowns.tool:
        x, y, z = state.tool
        lines.append(
            f"the tip is at X{x:+.2f} Y{y:+.2f} Z{z:+.2f} mm in the tool, beside where the arm takes it to be, "
            f"± {np.linalg.norm(sigma[6:9]):.2f} mm"
        )
    if result.unknowns.latency:
        lines.append(
            f"the arm begins {1e3 * state.dead_time:.1f} ± {1e3 * sigma[9]:.1f} ms late and follows with a lag of "
            f"{1e3 * state.lag:.1f} ± {1e3 * sigma[10]:.1f} ms; both together are known to ± {1e3 * lag_sigma:.1f} ms, "
            f"± {1e3 * MAX_LAG_SIGMA:g} ms is allowed"
        )
    out = 1 - result.fit.used.mean()
    if out > 0.05:
        lines.append(f"{100 * out:.0f} % of what was taken for the tip was something else, and is left out")
    return CalibrationVerdict(all(good), tuple(lines), () if all(good) else tuple(_hints(result, good)))


def detection_text(result: ArmCalibration, camera: int) -> str:
    """In how many of a camera's pictures the tip was found, and in how many the tool hides it."""
    tips, hidden = result.tips, int(result.hidden[camera])
    text = f"found in {tips.detections[camera]} of {tips.looked[camera]} pictures"
    return f"{text}, hidden by the tool itself in {hidden}" if hidden else text


def _hints(result: ArmCalibration, good: list[bool]) -> list[str]:
    tips, hints = result.tips, []
    rows = zip(result.rig.cameras, tips.looked, tips.detections, result.hidden, strict=True)
    for camera, looked, count, hidden in rows:
        if hidden > looked / 2:
            hints.append(f"{camera.name} looks along the tool, which hides its own tip: a larger --turn-deg")
        elif count < MIN_TIP_SHARE * (looked - hidden):
            hints.append(
                f"{camera.name} found the tip in {count} of {looked} pictures: is the needle in view, lit, and of "
                "another colour than what is behind it?"
            )
    if not good[0]:
        hints.append("more places, farther apart: --places 40 --reach-mm 70")
    if not good[1]:
        hints.append("calibrate the cameras anew, and see that nothing but the arm moves: stillbed calibrate cameras")
    if not good[2]:
        hints.append("a longer swing: --swing-s 20; and cameras that take more pictures a second")
    return hints


@dataclass(frozen=True, slots=True, eq=False)
class ArmTruth:
    """The truth of a simulated arm."""

    base_from_arm: Array
    tool: Array
    late: float  # s of dead time as executed
    lag: float  # s of its servos

    def rows(self, result: ArmCalibration) -> tuple[tuple[str, str, str], ...]:
        """Rows of the report: what, error, stated sigma."""
        state, sigma = result.fit.state, result.fit.sigma
        off = se3.log(se3.inverse(self.base_from_arm) @ state.base_from_arm)
        middle = result.places.mean(0)
        gap = se3.transform_points(state.base_from_arm @ se3.inverse(self.base_from_arm), middle[None])[0] - middle
        rows = [
            ("base_from_arm, in the middle of the places, mm", np.linalg.norm(gap), np.nan, 3),
            ("base_from_arm, at the arm's origin, mm", np.linalg.norm(off[3:]), np.linalg.norm(sigma[3:6]), 3),
            ("base_from_arm, degrees", np.degrees(np.linalg.norm(off[:3])), np.degrees(np.linalg.norm(sigma[:3])), 4),
        ]
        if result.unknowns.tool:
            tool = np.linalg.norm(np.asarray(state.tool) - self.tool)
            rows.append(("tip in the tool, mm", tool, np.linalg.norm(sigma[6:9]), 3))
        if result.unknowns.latency:
            rows.append(("dead time, ms", 1e3 * (state.dead_time - self.late), 1e3 * sigma[9], 2))
            rows.append(("servo's lag, ms", 1e3 * (state.lag - self.lag), 1e3 * sigma[10], 2))
        return tuple((w, f"{v:.{d}f}", "" if np.isnan(s) else f"{s:.{d}f}") for w, v, s, d in rows)


def arm_page(
    title: str, result: ArmCalibration, verdict: CalibrationVerdict, against: Sequence[tuple[str, str, str]] = ()
) -> str:
    """The page as HTML. against: rows beside the truth, if it is known: what, error, stated sigma."""
    state, sigma = result.fit.state, result.fit.sigma
    latency = f"{1e3 * (state.dead_time + state.lag):.0f}"
    tiles = [
        tile(f"{np.percentile(result.error, 95):.3f}", "mm", "tip, 19 of 20 places"),
        tile(f"{np.nanmedian(result.held_mm):.3f}", "mm", "beside, pictures held out"),
        tile(latency, "ms", "late in all"),
        tile(str(int(result.fit.used.sum())), "", "tips used"),
    ]
    lines = bullets((*verdict.lines, *verdict.hints))
    body = [row_of_tiles(tiles), section("Verdict", "What was found, and what to do next.", lines)]
    body.append(section("Numbers", "One sigma behind each figure.", _numbers(result, sigma)))
    if against:
        rows = [list(row) for row in against]
        body.append(section("Beside the truth", "This arm is simulated.", figures_table(["", "off", "stated"], rows)))
    body.append(section("The tip as it was found", "A cross where its end is measured.", _crops(result)))
    text = f"From each tip to where the arm puts it, {RESIDUAL_SCALE} times as long."
    body.append(section("Residuals", text, _residuals(result)))
    if result.unknowns.latency:
        text = "How far the tip lies behind where it was sent, over its speed; the line is what was found."
        body.append(section("Latency", text, _latency(result)))
    word = "passed" if verdict.passed else "failed"
    lead = f"Calibration of the arm {word}: {verdict.lines[0]}."
    return document("stillbed calibrate arm", title, lead, body, "Lengths in mm. Places: where the arm rested.")


def _numbers(result: ArmCalibration, sigma: Array) -> str:
    state = result.fit.state
    arm_from_base = se3.inverse(state.base_from_arm)
    turn = np.degrees(se3.angle_of(arm_from_base))
    dead, lag = (f"{1e3 * s:.2f}" if result.unknowns.latency else "kept" for s in sigma[9:11])
    tool = _three(sigma[6:9], 3) if result.unknowns.tool else "kept"
    rows = [
        ["place of the base in the arm's frame, mm", _three(arm_from_base[:3, 3]), f"{np.linalg.norm(sigma[3:6]):.3f}"],
        ["its turn, degrees", f"{turn:.3f}", f"{np.degrees(np.linalg.norm(sigma[:3])):.4f}"],
        ["tip in the tool, mm", _three(np.asarray(state.tool)), tool],
        ["dead time, ms", f"{1e3 * state.dead_time:.2f}", dead],
        ["servo's lag, ms", f"{1e3 * state.lag:.2f}", lag],
        ["radius of the needle's end, mm", f"{state.blunt:.2f}", f"{sigma[11]:.2f}"],
        ["scatter, in the sigmas of single tips", f"{result.fit.scatter:.2f}", ""],
    ]
    for c, camera in enumerate(result.rig.cameras):
        place = (arm_from_base @ camera.base_from_camera)[:3, 3]
        rows.append([f"{camera.name} in the arm's frame, mm", _three(place), detection_text(result, c)])
    return figures_table(["", "found", "±, or the tip"], rows)


def _three(values: Array, digits: int = 2) -> str:
    return " ".join(f"{v:.{digits}f}" for v in values)


def _crops(result: ArmCalibration) -> str:
    figures = []
    for camera, (images, pixels) in zip(result.rig.cameras, result.tips.crops, strict=True):
        for image, pixel in zip(images, pixels, strict=True):
            h, w = image.shape[:2]
            data = data_url(encode(np.ascontiguousarray(image), CROP_QUALITY)[1])
            x, y = pixel + 0.5
            cross = f'<path class="truth" stroke-width="0.4" d="M{x - 4:.2f} {y:.2f}h8M{x:.2f} {y - 4:.2f}v8"/>'
            place = f'width="{w}" height="{h}" style="image-rendering:pixelated"'
            picture = f'<image href="{data}" {place}/>'
            width = f'style="width:{CROP_SCALE * w}px"'
            svg = f'<svg class="plot" viewBox="0 0 {w} {h}" role="img" aria-label="tip" {width}>{picture}{cross}</svg>'
            figures.append(captioned(svg, camera.name))
    return figure_row(figures)


def _residuals(result: ArmCalibration) -> str:
    s, figures = result.tips.sightings, []
    for c, camera in enumerate(result.rig.cameras):
        rows = (s.camera == c) & result.fit.used
        ends = s.pixels[rows] + RESIDUAL_SCALE * result.fit.residuals[rows]
        lines = "".join(
            f'<path class="truth" stroke-width="3" d="M{a:.0f} {b:.0f}L{x:.0f} {y:.0f}"/>'
            f'<circle class="estimate" cx="{a:.0f}" cy="{b:.0f}" r="5"/>'
            for (a, b), (x, y) in zip(s.pixels[rows], ends, strict=True)
        )
        median = float(np.median(np.linalg.norm(result.fit.residuals[rows], axis=1))) if rows.any() else float("nan")
        caption = f"{camera.name}: {int(rows.sum())} tips, median {median:.2f} px"
        figures.append(captioned(picture_frame(camera.size, lines, "residuals"), caption))
    return figure_row(figures)


def tip_lag(result: ArmCalibration) -> tuple[Array, Array]:
    """Speed (M,), mm/s, of the set-point at sightings on the way, and lag (M,), mm, of the tip behind it.

    By one camera each: along the image of the move, at the tip's depth.
    """
    s, state = result.tips.sightings, result.fit.state
    rows = (s.place < 0) & result.fit.used
    at = s.take(rows)
    kinematics = kinematics_of(result.profile.arm)
    now = predict(state, result.set_point, kinematics, result.rig, at.stamp, at.camera)
    step = 0.005
    axes = [kinematics(result.set_point.lagged(at.stamp + h, 0.0, step))[:, :3, 3] for h in (-step, step)]
    speed = np.linalg.norm(axes[1] - axes[0], axis=1) / (2 * step)
    tip_rate = -now.by_time[..., 0]  # px/s of the tip's picture
    rate = np.linalg.norm(tip_rate, axis=1)
    lag = np.einsum("ni,ni->n", at.pixels - now.pixels, tip_rate) / np.maximum(rate, 1e-9) ** 2  # s ahead
    reported_lag = state.dead_time + state.lag
    measurable = (speed > 5.0) & (rate > 5.0)
    return speed[measurable], ((reported_lag - lag) * speed)[measurable]


def _latency(result: ArmCalibration) -> str:
    speed, late = tip_lag(result)
    if not len(speed):
        return '<p class="note">no pictures on the way</p>'
    width, height = PLOT_SIZE
    most, top = float(speed.max()) * 1.05, max(float(np.percentile(np.abs(late), 98)) * 1.2, 0.1)
    x, y = speed / most * width, height * (1 - np.clip(late / top, -0.1, 1.0))
    dots = "".join(f'<circle class="estimate" cx="{a:.1f}" cy="{b:.1f}" r="3"/>' for a, b in zip(x, y, strict=True))
    total = result.fit.state.dead_time + result.fit.state.lag
    line = f'<path class="truth" stroke-width="2" d="M0 {height}L{width} {height * (1 - total * most / top):.1f}"/>'
    axis = f'<path stroke="var(--faint)" d="M0 {height}H{width}M0 0V{height}"/>'
    labels = (
        f'<text x="{width - 8}" y="{height - 8}" text-anchor="end">{most:.0f} mm/s</text>'
        f'<text x="8" y="16">{top:.1f} mm behind</text>'
    )
    keys = [line_key("truth", f"{1e3 * total:.1f} ms")]
    return chart(width, height + 2, "latency", f"{axis}{line}{dots}{labels}") + legend(keys)


def arm_text(
    result: ArmCalibration, verdict: CalibrationVerdict, against: Sequence[tuple[str, str, str]], out: Path
) -> str:
    """What the terminal shows; against: as on the page."""
    lines = ["PASS" if verdict.passed else "FAIL", *verdict.lines]
    for c, camera in enumerate(result.rig.cameras):
        lines.append(f"{camera.name}: tip {detection_text(result, c)}")
    lines += [f"beside the truth: {what}: {off} (stated {stated or '-'})" for what, off, stated in against]
    lines += list(verdict.hints)
    lines.append(f"arm file: {out}, report: {out.with_suffix('.report.html')}")
    return "\n".join(lines)
