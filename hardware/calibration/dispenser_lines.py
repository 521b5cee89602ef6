"""How late a dispenser switches, from pictures of the lines that it drew: profiles, fit, verdict, page, file.

Where a line reaches half its width, beyond the place where the nozzle was when the dispenser was told, lies a constant
distance (the nozzle's own, and what the cameras are off) and speed x delay; over several speeds they are told apart.
How long the width takes to get there shows the lag. The width is taken to go with the flow: a bead pressed flat by its
nozzle, or one that is seen through.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares
from scipy.special import log_ndtr, ndtr

from estimation import se3
from estimation.errors import InputError
from estimation.rig import Camera, pixels_from_points
from estimation.se3 import Array
from hardware.calibration.arm_record import ARM_FILE, COMMANDED_FILE, read_commanded
from hardware.calibration.arm_solve import REST_AFTER
from hardware.calibration.dispenser_record import MIN_LINES, SWITCHES_FILE, TAIL, DrawnLine, drawn_lines, read_switches
from hardware.calibration.report import CalibrationVerdict, bullets
from hardware.dispenser.dispenser import DispenserProfile
from hardware.files.arm_file import read_arm
from hardware.files.dispenser_file import write_delays
from hardware.files.session import FrameRef, Session
from hardware.files.session_folder import open_folder
from hardware.report.page import (
    Plot,
    document,
    dot_key,
    figures_table,
    legend,
    line_key,
    row_of_tiles,
    section,
    spanning,
    tile,
)
from planning.material import MAX_DELAY

MAX_PICTURES = 12  # of each camera before, and after: their mean is taken
RUN_IN = 4.0  # mm before the place of the switch at which nothing can be printed yet
STRIP_STEP = 0.2  # mm
MIN_ROOM, MAX_ROOM = 1.0, 4.0  # mm on each side of a line in which nothing else lies; more is not looked at
CORE = (0.5, 0.95)  # share of the length at which the full width is measured
WHITE, BLACK = 252.0, 3.0  # grey levels beyond which a camera is saturated
MIN_CONTRAST, MIN_SIGNAL = 12.0, 8.0  # grey levels between line and sheet; its width over the width's noise
MAX_BEND, MAX_BESIDE = 0.3, 2.0  # mm: of a line's middle off a straight line, RMS, and beside the nozzle's way
MAX_UNSTEADY = 0.15  # share by which the width differs between the halves of its core
DISCS = 17  # of a bead that are looked at
BLUR_NODES = ((-(3.0**0.5), 1 / 6), (0.0, 2 / 3), (3.0**0.5, 1 / 6))  # of a normal distribution, and their weights
LN2 = float(np.log(2.0))
MIN_SPEED_RATIO, MIN_SHARE = 1.5, 0.5  # fastest to slowest; share of the lines that count, at least
PLACE_DOUBT, END_DOUBT = 0.04, 0.08  # mm, and share of the widths' range, of half the width from slow to fast lines
MAX_DELAY_SIGMA, MAX_SCATTER, MAX_MISFIT = 0.010, 0.3, 0.08  # s, mm, share of the width: to pass
MAX_JUMP = 2.0  # s of delay or lag that are sought


def mean_pictures(session: Session, folder: Path, span: tuple[float, float]) -> list[tuple[Array, Array] | None]:
    """Of each camera its mean picture (H, W, 3) before and after `span`, s, with the arm at rest; None without."""
    set_point = read_commanded(folder / COMMANDED_FILE)
    refs = [ref for refs in session.sets for ref in refs]
    rests = set_point.places(np.array([ref.stamp for ref in refs]), REST_AFTER) >= 0
    refs = [ref for ref, still in zip(refs, rests, strict=True) if still]
    means: list[tuple[Array, Array] | None] = []
    with closing(session.open_reader()) as reader:

        def mean(some: Sequence[FrameRef]) -> Array:
            image: Array = np.asarray(np.mean([reader.read(ref) for ref in some], axis=0, dtype=np.float64))
            return np.asarray(np.repeat(image[..., None], 3, 2) if image.ndim == 2 else image)

        for camera in range(len(session.rig)):
            before = [r for r in refs if r.camera == camera and r.stamp < span[0]][-MAX_PICTURES:]
            after = [r for r in refs if r.camera == camera and r.stamp > span[1]][-MAX_PICTURES:]
            means.append((mean(before), mean(after)) if before and after else None)
    if not any(means):
        allowed = "some before the first line and after the last"
        raise InputError(session.path, "pictures", "none of the resting arm", allowed)
    return means


@dataclass(frozen=True, slots=True, eq=False)
class LineProfile:
    """One line in one camera."""

    number: int  # of the line
    camera: int
    line: DrawnLine
    along: Array  # (K,) mm from the nozzle's place at on
    share: Array  # (K,) of its full width
    width: float  # mm
    contrast: float  # grey levels at its middle: fewer where the line is thinner than the picture is sharp


def profile_of(
    number: int, line: DrawnLine, camera: int, lens: Camera, pictures: tuple[Array, Array], room: float
) -> LineProfile | str:
    """The profile of a line, or why there is none. room: mm on each side that is the line's own."""
    along = np.arange(-RUN_IN, line.length + 0.8 * TAIL * line.speed, STRIP_STEP)
    across = np.arange(-room, room + STRIP_STEP / 2, STRIP_STEP)
    grid = np.stack([*np.meshgrid(along, across, indexing="ij"), np.zeros((len(along), len(across)))], -1)
    pixels, depth = pixels_from_points(lens, se3.transform_points(line.frame, grid.reshape(-1, 3)))
    inside = (depth > 1) & (pixels > 0).all(1) & (pixels < np.array(lens.size) - 1).all(1)
    if not inside.all():
        return "not whole in the picture"
    where = pixels[:, ::-1].T
    before, after = (
        np.stack([map_coordinates(m[..., c], where, order=1) for c in range(3)], -1).reshape(*grid.shape[:2], 3)
        for m in pictures
    )
    core = (along > CORE[0] * line.length) & (along < CORE[1] * line.length)
    edge = np.abs(across) > 0.75 * room
    change = after - before
    change -= change[:, edge].mean(1, keepdims=True)
    colour = change[core][:, np.abs(across) < 0.25 * room].mean((0, 1))
    bright = np.percentile((change[core] @ colour) / max(np.linalg.norm(colour), 1e-6), 98)
    if bright < MIN_CONTRAST:
        return f"no line seen: {bright:.0f} grey levels beside the sheet"
    if any(
        ((m[core].min(-1) > WHITE).mean() > 0.02) or (m[core].max(-1) < BLACK).mean() > 0.02 for m in (before, after)
    ):
        return "saturated: too bright or too dark"
    signal = (change @ colour) / np.linalg.norm(colour) / bright
    width = signal.sum(1) * STRIP_STEP
    empty = along < -1.0
    base, full = float(np.median(width[empty])), float(np.median(width[core]))
    if full - base < MIN_SIGNAL * width[empty].std():
        return "no line seen: it does not stand out from the noise"
    middle = (np.clip(signal[core], 0, None) * across).sum(1) / np.clip(signal[core], 0, None).sum(1)
    fitted = np.polyval(np.polyfit(along[core], middle, 1), along[core])
    bend, beside = float(np.std(middle - fitted)), float(np.abs(fitted).max())
    if bend > MAX_BEND or beside > min(MAX_BESIDE, 0.6 * room):
        return f"not straight: it bends by {bend:.2f} mm and lies {beside:.2f} mm beside the nozzle's way"
    halves = [float(np.median(half)) for half in np.array_split(width[core], 2)]
    if abs(halves[1] - halves[0]) > MAX_UNSTEADY * (full - base):
        return "its width is not steady: a longer line, or no air in the material"
    return LineProfile(number, camera, line, along, (width - base) / (full - base), full - base, float(bright))


def flow_share(beyond: Array, rise: Array, blur: float) -> Array:
    """The share that a change of the flow has reached `beyond` mm the dead place: 1 - exp(-x / rise), blurred."""
    x, r = beyond / blur, blur / rise
    return np.asarray(ndtr(x) - np.exp(np.minimum(r * r / 2 - x * r + log_ndtr(x - r), 0.0)))


def bead_share(beyond: Array, rise: Array, blur: float, width: Array, on: bool) -> Array:
    """The share (N,) of a bead's full `width` (N,), mm: it is the union of discs, each as wide as the flow then is."""
    apart, out = np.linspace(-1, 1, DISCS), np.zeros(len(beyond))
    for (
        node,
        weight,
    ) in BLUR_NODES:  # half of the blur's variance is the flow's, for a smooth fit; half is the picture's
        at = (beyond + node * blur / 2**0.5)[:, None] - apart * width[:, None] / 2
        flow = flow_share(at, rise[:, None], blur / 2**0.5)
        out += weight * np.sqrt(np.maximum((flow if on else 1 - flow) ** 2 - apart**2, 0.0).max(1))
    return out


@dataclass(frozen=True, slots=True, eq=False)
class SwitchFit:
    """How one switch, on or off, acts."""

    dead_time: float  # s
    lag: float  # s
    scatter_sigma: float  # s, of dead time + ln 2 lag, by how lines differ
    shape_sigma: float  # s, of the same, by what the model does not know of a bead's ends
    lag_sigma: float  # s
    constant: float  # mm, the same at any speed
    blur: float  # mm, one sigma
    lines: NDArray[np.int64]  # (L,) numbers of the lines
    speeds: Array  # (L,) mm/s
    places: Array  # (L,) mm from the switch to half the width, the constant and the cameras' own errors taken off
    rms: float  # of the profile about the fit, as a share of the width

    @property
    def delay(self) -> float:
        """Seconds from the switch to half the flow."""
        return self.dead_time + LN2 * self.lag

    @property
    def delay_sigma(self) -> float:
        """Seconds, one sigma of the delay."""
        return float(np.hypot(self.scatter_sigma, self.shape_sigma))

    @property
    def scatter(self) -> float:
        """mm, RMS of the lines about the fit."""
        return float(np.sqrt(np.mean((self.places - self.delay * self.speeds) ** 2)))


def fit_switch(profiles: Sequence[LineProfile], on: bool) -> SwitchFit:
    """Fit dead time, lag and constant distances to the beginnings (on) or the ends of all lines."""
    parts = [p.along < 0.6 * p.line.length if on else p.along > 0.8 * p.line.length for p in profiles]
    x = np.concatenate([p.along[rows] - (not on) * p.line.length for p, rows in zip(profiles, parts, strict=True)])
    y = np.concatenate([p.share[rows] for p, rows in zip(profiles, parts, strict=True)])
    row = np.repeat(np.arange(len(profiles)), [int(rows.sum()) for rows in parts])
    speed, width, forth = (
        np.array(v) for v in zip(*((p.line.speed, p.width, p.line.forth) for p in profiles), strict=True)
    )
    number, camera = (np.array(v) for v in zip(*((p.number, p.camera) for p in profiles), strict=True))
    own = [forth * (camera == c) for c in np.unique(camera) if len(set(forth[camera == c])) == 2]
    columns = np.stack([np.ones(len(profiles)), *own], 1)  # what the cameras are off changes sign with the direction

    def model(state: Array) -> Array:
        place = state[0] * speed + columns @ state[3:]
        return bead_share(x - place[row], (state[1] * speed)[row], state[2], width[row], on)

    begin = np.array([0.05, 0.05, 0.3, *np.zeros(columns.shape[1])])
    low, high = np.full(len(begin), -20.0), np.full(len(begin), 20.0)
    low[:3], high[:3] = [0.0, 5e-4, 0.02], [MAX_JUMP, MAX_JUMP, 3.0]
    solution = least_squares(lambda s: model(s) - y, begin, bounds=(low, high), x_scale=0.1)
    state, off, slopes = np.asarray(solution.x), np.asarray(solution.fun), np.asarray(solution.jac)
    beside = -np.bincount(row, slopes[:, 3] * off) / np.bincount(row, slopes[:, 3] ** 2)
    lines, free = np.unique(number), (state > low) & (state < high)
    without = np.repeat(state[None], len(lines), axis=0)
    for i, line in enumerate(lines):  # a jackknife, by a step of Gauss and Newton: samples of a line err alike
        remaining = number[row] != line
        without[i, free] -= np.linalg.lstsq(slopes[remaining][:, free], off[remaining], rcond=None)[0]
    sigma = [np.sqrt((len(lines) - 1) * np.var(v)) for v in (without[:, 0] + LN2 * without[:, 1], without[:, 1])]
    speeds = np.array([speed[number == line].mean() for line in lines])
    places = (state[0] + LN2 * state[1]) * speeds + np.array([beside[number == line].mean() for line in lines])
    dead, lag, blur, constant = state[:4].tolist()
    shape = float((PLACE_DOUBT + END_DOUBT * np.ptp(width)) / np.ptp(speed))
    rms = float(np.sqrt(np.mean(off**2)))
    return SwitchFit(dead, lag, float(sigma[0]), shape, float(sigma[1]), constant, blur, lines, speeds, places, rms)


@dataclass(frozen=True, slots=True, eq=False)
class LinesResult:
    """What a recorded folder says."""

    lines: tuple[DrawnLine, ...]
    names: tuple[str, ...]  # of the cameras
    profiles: tuple[LineProfile, ...]
    left_out: Mapping[tuple[int, int], str]  # (line, camera): why
    on: SwitchFit
    off: SwitchFit

    def delays(self, profile: DispenserProfile) -> DispenserProfile:
        """The profile with what was measured."""
        on, off = self.on, self.off
        return replace(profile, on_dead_time=on.dead_time, on_lag=on.lag, off_dead_time=off.dead_time, off_lag=off.lag)


def measure_lines(folder: Path, dispenser: DispenserProfile, height: float) -> LinesResult:
    """Measure a recorded folder; InputError says what cannot be trusted. height: mm of the nozzle above the sheet."""
    for name in (COMMANDED_FILE, ARM_FILE, SWITCHES_FILE):
        if not (folder / name).is_file():
            raise InputError(folder, name, "missing", "a folder that `stillbed calibrate dispenser` has recorded")
    switches = read_switches(folder / SWITCHES_FILE, dispenser.name)
    session, profile = open_folder(folder), read_arm(folder / ARM_FILE)
    lines = drawn_lines(folder, profile, dispenser.nozzle_offset, switches, height)
    means = mean_pictures(session, folder, (switches[0][0], switches[-1][1]))
    places = np.stack([line.frame[:3, 3] + line.frame[:3, 0] * line.length / 2 for line in lines])
    gaps = np.linalg.norm(places[:, None] - places, axis=-1) + 1e9 * np.eye(len(lines))
    profiles, left_out = [], {}
    for number, line in enumerate(lines):
        for camera, pictures in enumerate(means):
            room = min(float(gaps[number].min()) / 2 - 0.2, MAX_ROOM)
            crowded = f"another line lies {gaps[number].min():.1f} mm beside it" if room < MIN_ROOM else ""
            found: LineProfile | str = line.wrong or crowded or "no pictures"
            if pictures is not None and not (line.wrong or crowded):
                found = profile_of(number, line, camera, session.rig.cameras[camera], pictures, room)
            if isinstance(found, str):
                left_out[number, camera] = found
            else:
                profiles.append(found)
    numbers = {p.number for p in profiles}
    if len(numbers) < max(MIN_LINES, MIN_SHARE * len(lines)):
        reasons = list(left_out.values())
        got = f"{len(numbers)} of {len(lines)}; most often: {max(reasons, key=reasons.count)}"
        raise InputError(folder, "lines that can be measured", got, f"{MIN_LINES} or more, and half of all")
    speeds = [lines[n].speed for n in numbers]
    if max(speeds) < MIN_SPEED_RATIO * min(speeds):
        got = f"{min(speeds):.1f} to {max(speeds):.1f} mm/s"
        raise InputError(folder, "speeds", got, f"a ratio of {MIN_SPEED_RATIO:g} or more: one shows no delay alone")
    names = tuple(c.name for c in session.rig.cameras)
    most = [max((p.contrast for p in profiles if p.camera == c), default=0.0) for c in range(len(names))]
    profiles = [replace(p, width=p.width * p.contrast / most[p.camera]) for p in profiles]
    fits = fit_switch(profiles, True), fit_switch(profiles, False)
    return LinesResult(tuple(lines), names, tuple(profiles), left_out, *fits)


def judge_lines(result: LinesResult) -> CalibrationVerdict:
    """Whether the delays can be led by a print."""
    lines, hints = [], []
    for word, fit in (("on", result.on), ("off", result.off)):
        late, sigma, rise = (f"{1e3 * v:.1f}" for v in (fit.delay, fit.delay_sigma, fit.lag))
        lines.append(
            f"half the flow {late} ± {sigma} ms after {word}: {1e3 * fit.dead_time:.1f} ms dead time and 0.69 of "
            f"{rise} ± {1e3 * fit.lag_sigma:.1f} ms lag; single lines scatter by {fit.scatter:.2f} mm (RMS), "
            f"the profile is off its fit by {100 * fit.rms:.1f} % of the width"
        )
        if fit.delay_sigma > MAX_DELAY_SIGMA:
            hints.append(
                f"{word}: ± {1e3 * MAX_DELAY_SIGMA:g} ms is allowed: more lines, speeds farther apart, thinner lines"
            )
        if fit.scatter > MAX_SCATTER:
            hints.append(
                f"{word}: a scatter of {MAX_SCATTER:g} mm is allowed: it does not repeat; is air in the material?"
            )
        if fit.rms > MAX_MISFIT:
            hints.append(
                f"{word}: {100 * MAX_MISFIT:g} % of the width is allowed: no dead time with a lag describes it"
            )
        if fit.delay > MAX_DELAY:
            hints.append(
                f"{word}: a live run leads {MAX_DELAY:g} s at most: a shorter tube, a stiffer syringe, a valve"
            )
    return CalibrationVerdict(not hints, tuple(lines), tuple(hints))


def lines_page(title: str, result: LinesResult, verdict: CalibrationVerdict) -> str:
    """The page as HTML."""
    tiles = [
        tile(f"{1e3 * fit.delay:.0f}", f"± {1e3 * fit.delay_sigma:.1f} ms", f"{word}, to half the flow")
        for word, fit in (("on", result.on), ("off", result.off))
    ]
    body = [
        row_of_tiles(tiles),
        section("Verdict", "What was found, and what to do next.", bullets((*verdict.lines, *verdict.hints))),
    ]
    for word, fit in (("On", result.on), ("Off", result.off)):
        x = np.array([0.0, fit.speeds.max() * 1.1])
        plot = Plot(900, 240, (0.0, float(x[1])), spanning([fit.places, x * fit.delay]), label="mm, over mm/s")
        plot.line(x, x * fit.delay, "truth")
        plot.dots(fit.speeds, fit.places, "estimate", 3.0)
        keys = legend([dot_key("estimate", "a line"), line_key("truth", f"{1e3 * fit.delay:.1f} ms")])
        text = "From the nozzle's place at the switch to half the width, constant distances taken off."
        body.append(section(f"{word}: the way over the speed", text, plot.svg() + keys))
        body.append(
            section(f"{word}: profile and fit", "Width over mm from the switch, a speed each.", _profiles(result, fit))
        )
    rows = []
    for number, line in enumerate(result.lines):
        profiles = [p for p in result.profiles if p.number == number]
        reasons = {result.names[c]: text for (n, c), text in result.left_out.items() if n == number}
        beside = [
            f"{float(f.places[i]):.2f}" for f in (result.on, result.off) for i in np.flatnonzero(f.lines == number)
        ]
        width = f"{np.mean([p.width for p in profiles]):.2f}" if profiles else ""
        reason_text = "; ".join(f"{name}: {text}" for name, text in reasons.items())
        rows.append([str(number + 1), f"{line.speed:.1f}", width, *(beside or ["", ""]), reason_text])
    head = ["line", "mm/s", "width", "on, mm", "off, mm", "left out"]
    body.append(section("Lines", "As above, and which camera could not measure one.", figures_table(head, rows)))
    lead = f"Calibration of the dispenser {'passed' if verdict.passed else 'failed'}: {verdict.lines[0]}."
    return document("stillbed calibrate dispenser", title, lead, body, "The width is taken to go with the flow.")


def _profiles(result: LinesResult, fit: SwitchFit) -> str:
    """The profiles of one line at each speed about a switch, with the fit."""
    charts, on = [], fit is result.on
    for number in dict.fromkeys(
        int(fit.lines[np.argmin(np.abs(fit.speeds - v))]) for v in np.unique(fit.speeds.round())
    ):
        shown = next(p for p in result.profiles if p.number == number)
        x = shown.along - (0 if on else shown.line.length)
        near = (x > -RUN_IN) & (x < RUN_IN + 2 * (fit.delay + 3 * fit.lag) * shown.line.speed)
        place = float(fit.places[fit.lines == number][0] - LN2 * fit.lag * shown.line.speed) + fit.constant
        width, rise = np.full(near.sum(), shown.width), np.full(near.sum(), fit.lag * shown.line.speed)
        plot = Plot(
            900, 180, (float(x[near].min()), float(x[near].max())), (-0.15, 1.2), label=f"{shown.line.speed:.0f} mm/s"
        )
        plot.dots(x[near], shown.share[near], "estimate")
        plot.line(x[near], bead_share(x[near] - place, rise, fit.blur, width, on), "truth")
        charts.append(plot.svg())
    return "".join(charts) + legend([dot_key("estimate", "seen"), line_key("truth", "fit")])


def calibrate_lines(
    folder: Path, file: Path, dispenser: DispenserProfile, height: float, write: bool = True
) -> tuple[CalibrationVerdict, str]:
    """Measure a recorded folder and judge it; the report is written beside `file`, and the delays into it if it passes.

    InputError as `measure_lines`. Returns the verdict, and the text for the terminal.
    """
    result = measure_lines(folder, dispenser, height)
    verdict = judge_lines(result)
    report = file.with_name(f"{file.stem}.{dispenser.name}.report.html")
    report.write_text(lines_page(f"{dispenser.name}, {folder.resolve().name}", result, verdict), encoding="utf-8")
    used = len({p.number for p in result.profiles})
    text = ["PASS" if verdict.passed else "FAIL", *verdict.lines, f"{used} of {len(result.lines)} lines were measured"]
    text += [f"line {n + 1}, {result.names[c]}: left out: {why}" for (n, c), why in result.left_out.items()]
    text += verdict.hints
    if verdict.passed and write:
        write_delays(file, dispenser.name, result.delays(dispenser))
        text.append(f"{file}: the delays of {dispenser.name} were written")
    else:
        text.append(f"{file}: stays as it was")
    return verdict, "\n".join([*text, f"report: {report}"])
