"""Whether an arm's calibration is good enough to print with, in words that a technician understands."""

from __future__ import annotations

import numpy as np

from hardware.calibration.arm_solve import ArmCalibration
from hardware.calibration.verdict import Verdict

LIMIT = 0.1  # mm, of the tip in the working volume: a fourth of a bead
BESIDE = 0.3  # mm, median, by which pictures that were held out lie beside: blunders and a bent arm are beyond it
LATE = 0.005  # s, one sigma of the arm's lag: at 20 mm/s a tenth of a millimetre
SEEN = 0.3  # of a camera's pictures in which the tip should be found


def judge(found: ArmCalibration, limit: float) -> Verdict:
    """The verdict. limit: mm, one sigma of the tip in 19 of 20 places."""
    typical, worst = float(np.sqrt(np.mean(found.error**2))), float(np.percentile(found.error, 95))
    beside, px = float(np.nanmedian(found.held_mm)), float(np.nanmedian(found.held_px))
    sigma, state = found.fit.sigma, found.fit.state
    late = float(np.sqrt(max(found.fit.covariance[9:11, 9:11].sum(), 0.0)))
    good = [worst <= limit, beside <= BESIDE, late <= LATE]
    word = "good enough" if good[0] else "NOT good enough"
    lines = [
        f"{word} to print: the tip is where it is thought to be within {typical:.3f} mm (one sigma), in 19 of 20 "
        f"places within {worst:.3f} mm; {limit:g} mm is allowed",
        f"pictures that took no part lie {beside:.3f} mm ({px:.2f} px) beside where the arm should be (median); "
        f"{BESIDE:g} mm is allowed",
    ]
    if found.asked.tool:
        x, y, z = state.tool
        lines.append(
            f"the tip is at X{x:+.2f} Y{y:+.2f} Z{z:+.2f} mm in the tool, beside where the arm takes it to be, "
            f"± {np.linalg.norm(sigma[6:9]):.2f} mm"
        )
    if found.asked.latency:
        lines.append(
            f"the arm begins {1e3 * state.dead_time:.1f} ± {1e3 * sigma[9]:.1f} ms late and follows with a lag of "
            f"{1e3 * state.lag:.1f} ± {1e3 * sigma[10]:.1f} ms; both together are known to ± {1e3 * late:.1f} ms, "
            f"± {1e3 * LATE:g} ms is allowed"
        )
    out = 1 - found.fit.used.mean()
    if out > 0.05:
        lines.append(f"{100 * out:.0f} % of what was taken for the tip was something else, and is left out")
    return Verdict(all(good), tuple(lines), () if all(good) else tuple(_hints(found, good)))


def seen_words(found: ArmCalibration, camera: int) -> str:
    """In how many of a camera's pictures the tip was found, and why not in the others where that is known."""
    look, hidden = found.look, int(found.hidden[camera])
    words = f"found in {look.found[camera]} of {look.looked[camera]} pictures"
    return f"{words}, hidden by the tool itself in {hidden}" if hidden else words


def _hints(found: ArmCalibration, good: list[bool]) -> list[str]:
    look, hints = found.look, []
    for camera, seen, found_in, hidden in zip(found.rig.cameras, look.looked, look.found, found.hidden, strict=True):
        if hidden > seen / 2:
            hints.append(f"{camera.name} looks along the tool, which hides its own tip: a larger --turn-deg")
        elif found_in < SEEN * (seen - hidden):
            hints.append(
                f"{camera.name} found the tip in {found_in} of {seen} pictures: is the needle in view, lit, and of "
                "another colour than what is behind it?"
            )
    if not good[0]:
        hints.append("more places, farther apart: --places 40 --reach-mm 70")
    if not good[1]:
        hints.append("calibrate the cameras anew, and see that nothing but the arm moves: stillbed calibrate cameras")
    if not good[2]:
        hints.append("a longer swing: --swing-s 20; and cameras that take more pictures a second")
    return hints
