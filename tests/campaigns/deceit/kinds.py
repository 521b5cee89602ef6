"""The kinds of sessions: what deceives in each, and what must stay followed though it is hard."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from estimation import se3
from tests.campaigns.deceit import looks
from tests.campaigns.deceit.motions import cough, glide, smooth_step, steps, sway
from tests.campaigns.deceit.scenes import (
    BUMP_SHARE,
    PASSING_S,
    REST_HEIGHT,
    SETS,
    TRICK,
    Draw,
    Session,
    changed,
    cloth,
    drawn_region,
    flat,
    ordinary,
    passing,
    seen_by,
    told_as,
)
from tests.campaigns.deceit.world import PSF, Decal, Gloss, Sheet

Kind = Callable[[Draw], Session]
PURE = "a borderless pattern that repeats, moved by its own period between two pictures, looks as if it had not moved"
OPEN, OPEN_SCALE = 900.0, 1.5  # mm and texels a mm, of a board that reaches beyond every picture
COVERED_SETS = 8  # frame sets that a sheet covers the field


def start_of(fps: float, number: int = TRICK) -> float:
    """s, half a frame before a set."""
    return (number - 0.5) / fps


def along(x: float, y: float) -> tuple[float, ...]:
    """A shift, (6,) mm, in the surface's plane at rest, before `turned` puts it there."""
    return 0.0, 0.0, 0.0, x, y, 0.0


def in_plane(made: Session, at: float, x: float, y: float) -> Session:
    """The session whose surface jumps at an instant along its own axes by x and y, mm."""
    before, step = made.world.base_from_surface, se3.make(np.eye(3), [x, y, 0.0])
    return changed(made, base_from_surface=lambda t: before(t) @ step if t > at else before(t))


# -- boards and cloths that repeat


BOARDS = (  # squares along x and y that it jumps; whether it has a border, marks of its own
    (2, 0, True, False),
    (1, 1, True, True),
    (2, 0, False, False),
    (4, 0, False, True),
    (2, 2, True, False),
)
SQUARE = 12.0  # mm


def _board(
    draw: Draw, border: bool, marks: bool, fps: float, sets: int, *parts: Callable[[float], np.ndarray]
) -> Session:
    (side, scale), margin = (8 * SQUARE, 4.0) if border else (OPEN, OPEN_SCALE), 8.0 if border else 0.0
    texture = looks.board(side, side, SQUARE, margin=margin, scale=scale)
    if marks:
        texture = looks.scribbles(draw.rng, texture, scale, 7 if border else 450)  # seven or so in the region
    return flat(draw, texture, scale, *parts, fps=fps, sets=sets, reach=68.0 if border else 50.0, breath=1.5)


def board_jump(draw: Draw) -> Session:
    """A printed board jumps by one or two of its periods from one picture to the next."""
    x, y, border, marks = draw.pick(*BOARDS)
    fps = 30.0 if draw.variant % 2 else 13.0
    made = in_plane(_board(draw, border, marks, fps, SETS), start_of(fps), x * SQUARE, y * SQUARE)
    what = f"{SQUARE * math.hypot(x, y):.1f} mm at {fps:g} fps, {_words(border, marks)}"
    return told_as(made, what, settled=start_of(fps), decidable="" if border or marks else PURE)


def board_covered(draw: Draw) -> Session:
    """A printed board jumps while a cloth covers it."""
    x, y, border, marks = draw.pick(*BOARDS)
    fps = 30.0
    start, end = start_of(fps), start_of(fps, TRICK + COVERED_SETS)
    made = in_plane(_board(draw, border, marks, fps, SETS + 16), (start + end) / 2, x * SQUARE, y * SQUARE)
    made = changed(made, sheets=(cloth(draw.rng, start, end),))
    what = f"{SQUARE * math.hypot(x, y):.1f} mm while covered, {_words(border, marks)}"
    return told_as(made, what, settled=end + PASSING_S, decidable="" if border or marks else PURE)


def board_sway(draw: Draw) -> Session:
    """A printed board sways at 4 pictures a second: further than its squares from one to the next."""
    _, _, border, marks = draw.pick(*BOARDS)
    fps, start, amplitude = 4.0, start_of(4.0, 20), draw.uniform(28, 42)
    made = _board(draw, border, marks, fps, 50, sway(draw.rng, amplitude, draw.uniform(0.35, 0.6), start))
    what = f"{amplitude:.0f} mm at {fps:g} fps, {_words(border, marks)}"
    return told_as(made, what, settled=start, decidable="" if border or marks else PURE)


def _words(border: bool, marks: bool) -> str:
    return f"{'border' if border else 'no border'}, {'own marks' if marks else 'no marks'}"


def _gauze(draw: Draw, fps: float, *parts: Callable[[float], np.ndarray]) -> Session:
    strength, contrast = draw.pick((0.4, 0.15), (1.0, 1.0), (0.3, 1.0), (0.5, 0.1), (0.25, 0.15))
    made = ordinary(draw, *parts, fps=fps, breath=2.0, strength=strength, contrast=contrast, moles=3)
    mesh = looks.gauze(draw.rng, looks.SKIN_SIDE, 4.0, draw.uniform(0.0, 0.05), haze=draw.uniform(0.1, 0.4))
    return changed(made, decals=(Decal(mesh, looks.SKIN_SCALE),))


def gauze_jump(draw: Draw) -> Session:
    """Gauze of 4 mm over skin that shows through, jumping together."""
    far, fps = draw.pick(4.0, 8.0, 14.4, 4.0, 12.0), 30.0
    made = in_plane(_gauze(draw, fps), start_of(fps), far, 0.0)
    return told_as(made, f"{far:g} mm at {fps:g} fps", settled=start_of(fps))


def gauze_cough(draw: Draw) -> Session:
    """Gauze over skin in a cough."""
    amplitude, quarter, start = draw.uniform(12, 24), draw.uniform(0.08, 0.15), start_of(30.0)
    made = _gauze(draw, 30.0, cough(draw.rng, start, amplitude, quarter))
    return told_as(made, f"{amplitude:.0f} mm in {1000 * quarter:.0f} ms at 30 fps", settled=start)


def gauze_slip(draw: Draw) -> Session:
    """Gauze slips over skin that rests, or the skin moves under gauze that is held."""
    fps, far = 30.0, draw.uniform(5, 12)
    start = start_of(fps)
    made = ordinary(draw, fps=fps, breath=2.0, sets=SETS + 10)
    mesh = looks.patched(looks.gauze(draw.rng, looks.SKIN_SIDE, 4.0), looks.SKIN_SCALE, 60, 60, (0.0, 22.0))
    decal = Decal(mesh, looks.SKIN_SCALE, lambda t: (far * smooth_step(t - start), 0.0))
    return told_as(changed(made, decals=(decal,)), f"slips by {far:.0f} mm in 1 s over half the wound", settled=start)


def _squares(draw: Draw, fps: float, sets: int) -> Session:
    contrast = draw.pick(0.1, 0.1, 1.0, 0.3, 0.1)
    strength = draw.uniform(0.15, 0.4)
    made = ordinary(draw, fps=fps, breath=2.0, sets=sets, strength=strength, moles=3, contrast=contrast)
    faint = looks.board(looks.SKIN_SIDE, looks.SKIN_SIDE, 10.0, contrast=draw.uniform(0.15, 0.4))
    return changed(made, decals=(Decal(faint, looks.BOARD_SCALE),))


def squares_jump(draw: Draw) -> Session:
    """Faint squares over skin, jumping by a period."""
    fps, far = 30.0, draw.pick(20.0, 40.0, 20.0, 20.0, 28.3)
    x, y = (20.0, 20.0) if far == 28.3 else (far, 0.0)
    made = in_plane(_squares(draw, fps, SETS), start_of(fps), x, y)
    return told_as(made, f"{far:g} mm", settled=start_of(fps))


def squares_covered(draw: Draw) -> Session:
    """Faint squares over skin, jumping by a period while a cloth covers them."""
    fps, far = 30.0, draw.pick(20.0, 40.0, 20.0, 20.0, 20.0)
    start, end = start_of(fps), start_of(fps, TRICK + COVERED_SETS)
    made = in_plane(_squares(draw, fps, SETS + 16), (start + end) / 2, far, 0.0)
    made = changed(made, sheets=(cloth(draw.rng, start, end),))
    return told_as(made, f"{far:g} mm while covered", settled=end + PASSING_S)


def chequerboard_hops(draw: Draw) -> Session:
    """A calibration board moved by hand, 30 to 40 mm between pictures at 2 Hz."""
    fps, count, start, square = 2.0, 36, 14, 24.0
    hops, place = [], np.zeros(6)
    for _ in range(count - start):
        angle = draw.uniform(0, 2 * math.pi)
        step = draw.uniform(30, 40) * np.array([math.cos(angle), math.sin(angle)])
        step *= 1 if np.linalg.norm(place[3:5] + step) < np.linalg.norm(place[3:5] - step) else -1
        place = np.r_[draw.rng.normal(0, 0.02, 3), place[3:5] + step, draw.rng.normal(0, 2)]
        hops.append(place)
    stamps = [start_of(fps, k) for k in range(start, count)]
    texture = looks.board(7 * square, 5 * square, square, margin=12.0)
    made = flat(
        draw, texture, looks.BOARD_SCALE, steps(stamps, np.array(hops)), fps=fps, sets=count, reach=95.0, breath=0.0
    )
    return told_as(made, f"7 x 5 squares of {square:g} mm at {fps:g} fps", settled=stamps[0])


def printed_beads(draw: Draw) -> Session:
    """A printed patch of parallel beads over the wound, jumping across them."""
    fps, pitch = 30.0, draw.uniform(1.8, 4.0)
    periods = draw.pick(1, 2, 3, 5, 4)
    strength, side, beyond = draw.pick((0.8, 30.0, 22.0), (0.4, 32.0, 10.0), (0.3, 40.0, 14.0))
    made = ordinary(draw, fps=fps, breath=2.0, strength=strength, moles=3, beyond=beyond)
    made = in_plane(made, start_of(fps), 0.0, periods * pitch)
    patch = looks.beads(draw.rng, side, side, pitch)
    made = changed(made, decals=(Decal(patch, 6.0),))
    return told_as(made, f"{periods} periods of {pitch:.2f} mm", settled=start_of(fps))


def suture_row(draw: Draw) -> Session:
    """A row of stitches on weak skin, jumping along the row by whole stitches."""
    fps, pitch, count, strength = 30.0, draw.uniform(5, 8), draw.pick(1, 2, 1, 3, 1), draw.uniform(0.12, 0.3)
    made = ordinary(draw, fps=fps, breath=2.0, strength=strength, moles=2, contrast=0.1, beyond=14.0)
    row = looks.sutures(draw.rng, 11, pitch)
    made = changed(in_plane(made, start_of(fps), count * pitch, 0.0), decals=(Decal(row, 6.0),))
    return told_as(made, f"{count} stitches of {pitch:.1f} mm, skin {strength:.2f}", settled=start_of(fps))


def tattoo(draw: Draw) -> Session:
    """An ornament in the skin that repeats, jumping by its period."""
    fps, pitch, strength = 30.0, draw.uniform(9, 14), draw.uniform(0.15, 0.5)
    x, y = draw.pick((1, 0), (2, 0), (1, 1), (0, 1), (0, 2))
    made = ordinary(draw, fps=fps, breath=2.0, strength=strength, moles=3, contrast=draw.pick(0.2, 1.0))
    ink = looks.tattoo(draw.rng, looks.SKIN_SIDE, pitch)
    made = changed(in_plane(made, start_of(fps), x * pitch, y * pitch), decals=(Decal(ink, 5.0),))
    return told_as(made, f"{x}, {y} periods of {pitch:.1f} mm, skin {strength:.2f}", settled=start_of(fps))


# -- what is drawn on the tissue, what lies on it, what rests beside it


def _rising(draw: Draw, region: bool) -> Session:
    high, lasts, fps, narrow = draw.pick(
        (2.0, 1.0, 13.0, 0.3),
        (6.0, 2.3, 30.0, 0.4),
        (2.0, 1.0, 30.0, 0.5),
        (3.0, 2.4, 13.0, 0.3),
        (3.0, 1.0, 30.0, 0.35),
    )
    start, seen = start_of(fps), region or draw.variant % 2 == 0  # by the network that looks for the wound
    contrast, strength = (1.0 if seen else 0.1), draw.uniform(0.5, 1.0)
    breath, sets, beyond = (2.0 if seen else 0.0), TRICK + 12 + round(fps * lasts), draw.uniform(25, 45)
    made = ordinary(
        draw, fps=fps, breath=breath, sets=sets, region=region, contrast=contrast, strength=strength, beyond=beyond
    )
    lie = made.world.relief
    lie = replace(lie, rise=lambda t: high * smooth_step((t - start) / lasts), sigma=narrow * lie.sigma / BUMP_SHARE)
    what = f"{high:g} mm in {lasts:g} s at {fps:g} fps, {lie.sigma:.1f} mm wide, {'a' if seen else 'no'} red wound"
    return told_as(changed(made, relief=lie), what, settled=start)


def wound_rise(draw: Draw) -> Session:
    """The wound alone rises, within the drawn region."""
    return _rising(draw, True)


def wound_rise_alone(draw: Draw) -> Session:
    """The wound alone rises, no region given."""
    return _rising(draw, False)


def resting_drape(draw: Draw) -> Session:
    """A printed drape rests round a field that moves; no region, and a wound that hardly differs from skin."""
    fps, far = draw.pick(30.0, 13.0), draw.uniform(8, 18)
    start = start_of(fps)
    angle = draw.uniform(0, 2 * math.pi)
    part = glide(start, start + 1.2, along(far * math.cos(angle), far * math.sin(angle)))
    made = ordinary(
        draw, part, fps=fps, breath=2.0, contrast=0.08, region=draw.variant == 4, strength=0.7, sets=SETS + 10
    )
    width = draw.uniform(62, 84)
    sheet = looks.drape(draw.rng, 420, (width, width * 0.85), strong=1.6)
    pose = se3.make(np.eye(3), [0, 0, REST_HEIGHT + 7.0])
    made = changed(made, sheets=(Sheet(sheet, looks.DRAPE_SCALE, lambda _: pose),))
    return told_as(made, f"field glides {far:.0f} mm in a window of {width:.0f} mm at {fps:g} fps", settled=start)


def dressing_slip(draw: Draw) -> Session:
    """A dressing beside the wound slips over the skin; with and without a region."""
    fps, far, region = 30.0, draw.uniform(15, 28), draw.variant % 3 == 2
    start, lasts = start_of(fps), draw.uniform(0.8, 1.4)
    made = ordinary(draw, fps=fps, breath=2.0, strength=0.5, contrast=0.3, region=region, sets=SETS + 20)
    plaster = looks.dressing(draw.rng, 66, 84)
    decal = Decal(plaster, 4.0, lambda t: (-46.0, far * smooth_step((t - start) / lasts) - far / 2))
    what = f"{far:.0f} mm in {lasts:.1f} s, {'region' if region else 'no region'}"
    return told_as(changed(made, decals=(decal,)), what, settled=start)


def hair(draw: Draw) -> Session:
    """Hairs over the skin that a draught combs aside while the skin rests."""
    fps, far, start = 30.0, draw.uniform(3, 9), start_of(30.0)
    made = ordinary(draw, fps=fps, breath=2.0, strength=draw.pick(1.0, 0.4), region=True)
    coat = looks.hairs(draw.rng, looks.SKIN_SIDE, draw.pick(700, 1500))
    decal = Decal(coat, 5.0, lambda t: (far * smooth_step(t - start), 0.4 * far * smooth_step(t - start)))
    return told_as(changed(made, decals=(decal,)), f"hairs move by {far:.0f} mm in 1 s", settled=start)


def two_patients(draw: Draw) -> Session:
    """Another patient's skin lies there once a cloth is lifted."""
    fps, start, end = 30.0, start_of(30.0), start_of(30.0, TRICK + COVERED_SETS)
    made = ordinary(draw, fps=fps, breath=2.0, sets=SETS + 16)
    rng, first, middle = draw.rng, made.world.skin(0.0), (start + end) / 2
    other = looks.with_wound(rng, looks.skin(rng), rng.uniform(13, 19))
    made = changed(made, skin=lambda t: first if t < middle else other)
    made = changed(made, sheets=(cloth(draw.rng, start, end),))
    return told_as(made, "another skin while covered", settled=end, gone=middle)


# -- light


LIGHT_SIDE = 700.0  # mm


def lamp_at_rest(draw: Draw) -> Session:
    """A lamp's pattern rests while the tissue moves through it."""
    fps, strength = draw.pick(30.0, 13.0), draw.pick(1.0, 0.25, 0.5, 0.25, 0.12)
    angle, far = draw.uniform(0, 2 * math.pi), draw.uniform(8, 16)
    start = start_of(fps)
    part = glide(start, start + draw.pick(0.8, 1.5), along(far * math.cos(angle), far * math.sin(angle)))
    made = ordinary(draw, part, fps=fps, breath=2.0, strength=strength, moles=2)
    light = looks.lamp_pattern(draw.rng, LIGHT_SIDE, 1.0, 0.125, draw.uniform(2.0, 6.0))
    made = changed(made, light=light)
    return told_as(made, f"25 % contrast, skin {strength:g}, glides {far:.0f} mm at {fps:g} fps", settled=start)


def shadow_drift(draw: Draw) -> Session:
    """A soft shadow or a lamp's pattern drifts over tissue that rests or breathes."""
    fps, strength, rate = 13.0, draw.pick(1.0, 0.25, 0.12, 0.5, 0.25), draw.uniform(8, 25)
    start = start_of(fps)
    made = ordinary(draw, fps=fps, breath=draw.pick(0.0, 2.0), strength=strength, moles=2, sets=SETS + 10)
    if draw.variant % 2:
        light = looks.soft_shadow(draw.rng, LIGHT_SIDE, 1.0, draw.uniform(0.35, 0.6), draw.uniform(2, 6))
    else:
        light = looks.lamp_pattern(draw.rng, LIGHT_SIDE, 1.0, 0.125, draw.uniform(3, 8))
    made = changed(made, light=light, light_shift=lambda t: (-15 + rate * max(t - start, 0.0), 0.0))
    name = "shadow" if draw.variant % 2 else "pattern"
    return told_as(made, f"{name} at {rate:.0f} mm/s over skin {strength:g}", settled=start)


def wet_film(draw: Draw) -> Session:
    """A wet film mirrors a surgical lamp: highlights that stay while the tissue moves."""
    fps, strength, far = 30.0, draw.pick(0.8, 0.25, 0.15), draw.uniform(6, 14)
    start = start_of(fps)
    angle = draw.uniform(0, 2 * math.pi)
    part = glide(start, start + 0.9, along(far * math.cos(angle), far * math.sin(angle)))
    made = ordinary(draw, part, fps=fps, breath=2.0, strength=strength, moles=2)
    rough, grain = draw.pick((0.015, 5.0), (0.04, 2.0), (0.08, 1.2), (0.0, 4.0)), draw.uniform(0.25, 0.6)
    film = looks.wet_film(draw.rng, looks.SKIN_SIDE, rough[0], grain, rough[1])
    flowing = (lambda t: (6.0 * max(t - start, 0.0), 0.0)) if draw.variant == 4 else (lambda _: (0.0, 0.0))
    made = changed(made, gloss=Gloss(film, looks.lamp_panel(620, 6), flowing))
    return told_as(made, f"waves of {rough[1]:g} mm, skin {strength:g}, glides {far:.0f} mm", settled=start)


# -- cameras


def _swaying(draw: Draw, fps: float, fast: bool, sets: int = SETS) -> Session:
    if not fast:
        return ordinary(draw, fps=fps, breath=4.0, sets=sets)
    return ordinary(draw, sway(draw.rng, draw.uniform(12, 20), draw.uniform(0.4, 0.7)), fps=fps, breath=2.0, sets=sets)


def _two_of(draw: Draw) -> list[int]:
    return [int(c) for c in draw.rng.permutation(3)[:2]]


def two_frozen(draw: Draw) -> Session:
    """Two of three cameras hang and give the same picture with fresh noise."""
    fps, fast = draw.pick(30.0, 13.0), draw.variant % 2 == 1
    start, made = start_of(fps), _swaying(draw, fps, fast, SETS + 20)
    views = {c: {"time": lambda t: min(t, start)} for c in _two_of(draw)}
    what = f"{'fast sway' if fast else 'slow breathing'} at {fps:g} fps"
    return told_as(seen_by(made, views), what, settled=start)


def two_late(draw: Draw) -> Session:
    """Two of three cameras show what was 100 ms ago."""
    fps, start = 30.0, draw.pick(start_of(30.0), -1.0)
    made = _swaying(draw, fps, draw.variant % 5 != 4, SETS + 20)
    views = {c: {"time": lambda t: t - 0.1 if t > start else t} for c in _two_of(draw)}
    return told_as(
        seen_by(made, views), "late from the start" if start < 0 else "late from the trick on", settled=start
    )


def frozen_and_late(draw: Draw) -> Session:
    """One camera hangs with fresh noise and another is 100 ms late."""
    fps, start = draw.pick(30.0, 13.0), 0.0
    start = start_of(fps)
    made, (frozen, late) = _swaying(draw, fps, draw.variant % 2 == 0, SETS + 20), _two_of(draw)
    views = {frozen: {"time": lambda t: min(t, start)}, late: {"time": lambda t: t - 0.1 if t > start else t}}
    return told_as(seen_by(made, views), f"at {fps:g} fps", settled=start)


def mirrored(draw: Draw) -> Session:
    """Cameras whose pictures are mirrored, upside down or swapped from the start."""
    flips = draw.pick({0: "mirror"}, {1: "turn"}, dict.fromkeys(range(3), "mirror"), {}, {2: "mirror"})
    made = ordinary(draw, fps=30.0, breath=3.0)
    views: dict[int, dict[str, object]] = {c: {"flip": flip} for c, flip in flips.items()}
    views = views or {0: {"shows": 2}, 2: {"shows": 0}}
    made = seen_by(made, views)
    made = replace(made, roi=drawn_region(made, 38.0))
    what = ", ".join(f"{c} {v.get('flip', 'swapped')}" for c, v in views.items())
    return told_as(made, what)


def shimmer(draw: Draw) -> Session:
    """Hot air above a lamp or a cautery bends the rays."""
    made = ordinary(draw, fps=draw.pick(30.0, 13.0), breath=3.0)
    warp = draw.pick(0.3, 0.6, 1.0, 1.5, 0.8)
    return told_as(changed(made, shimmer=warp), f"{warp:g} px")


def rolling_shutter(draw: Draw) -> Session:
    """Rows that are read one after another, at speed."""
    fps, readout, amplitude, rate = 30.0, draw.pick(0.015, 0.025, 0.03), draw.uniform(10, 22), draw.uniform(0.6, 1.4)
    start = start_of(fps)
    made = ordinary(draw, sway(draw.rng, amplitude, rate, start, degrees=2.0), fps=fps, breath=2.0)
    what = f"{1000 * readout:.0f} ms, up to {2 * math.pi * amplitude * rate:.0f} mm/s"
    return told_as(changed(made, readout=readout), what, settled=start)


# -- hard but honest: these stay followed


def teleport(draw: Draw) -> Session:
    """Ordinary skin that is elsewhere from one picture to the next."""
    fps, far, angle = draw.pick(30.0, 13.0), draw.uniform(8, 40), draw.uniform(0, 2 * math.pi)
    made = in_plane(ordinary(draw, fps=fps), start_of(fps), far * math.cos(angle), far * math.sin(angle))
    return told_as(made, f"{far:.0f} mm at {fps:g} fps", settled=start_of(fps), honest=True)


def glove(draw: Draw) -> Session:
    """A gloved hand passes over the field, or rests on it for a while."""
    fps, lasts = 30.0, draw.pick(0.1, 0.5, 0.3)
    start = start_of(fps)
    made = ordinary(draw, fps=fps, sets=SETS + 20)
    colour = draw.pick((0.62, 0.42, 0.2), (0.7, 0.72, 0.75), (0.2, 0.14, 0.1))
    height = draw.uniform(50, 90)
    hand = passing(looks.glove(draw.rng, colour), 3.0, start, start + lasts, height, way=-420.0)
    return told_as(changed(made, sheets=(hand,)), f"{lasts:g} s", settled=start + lasts + PASSING_S, honest=True)


def flicker(draw: Draw) -> Session:
    """A lamp on the mains, seen row by row and from picture to picture."""
    ripple = draw.pick(0.1, 0.2, 0.3)
    made = changed(ordinary(draw, fps=draw.pick(30.0, 13.0)), ripple=ripple)
    return told_as(made, f"{100 * ripple:.0f} %", honest=True)


def exposure_steps(draw: Draw) -> Session:
    """Cameras that set their exposure anew, by steps."""
    fps, gains = 30.0, draw.rng.permutation([0.45, 0.7, 1.0, 1.5, 1.9])
    made = ordinary(draw, fps=fps)
    view = {"gain": lambda t: float(gains[max(0, int((t * fps - TRICK) / 7) + 1) % 5]) if t * fps > TRICK else 1.0}
    made = seen_by(made, dict.fromkeys(range(3) if draw.variant % 2 else range(1), view))
    return told_as(made, "all cameras" if draw.variant % 2 else "one camera", honest=True)


def blur(draw: Draw) -> Session:
    """Long exposures of a surface that sways."""
    exposure, amplitude = draw.uniform(0.012, 0.025), draw.uniform(8, 15)
    made = ordinary(draw, sway(draw.rng, amplitude, draw.uniform(0.5, 0.9), start_of(30.0)), fps=30.0, breath=2.0)
    made = changed(made, exposure=exposure, samples=4)
    return told_as(made, f"{1000 * exposure:.0f} ms, {amplitude:.0f} mm", honest=True)


def defocus(draw: Draw) -> Session:
    """A lens that goes out of focus, and comes back."""
    made, deep, start = ordinary(draw, fps=30.0), draw.uniform(1.5, 3.0), start_of(30.0)
    view = {"blur": lambda t: PSF + deep * math.sin(math.pi * min(max((t - start) / 0.8, 0.0), 1.0))}
    cameras = range(3) if draw.variant % 2 else [int(draw.rng.integers(3))]
    return told_as(seen_by(made, dict.fromkeys(cameras, view)), f"{deep:.1f} px, {len(cameras)} cameras", honest=True)


def slow_pictures(draw: Draw) -> Session:
    """Four pictures a second of breathing and sway."""
    made = ordinary(draw, sway(draw.rng, draw.uniform(4, 8), 0.3), fps=4.0, breath=4.0, sets=50)
    return told_as(made, "4 fps", honest=True)


def focal_off(draw: Draw) -> Session:
    """A calibration whose focal length is 3 % off in one camera or in all."""
    made = ordinary(draw, fps=30.0, breath=4.0)
    wrong = range(3) if draw.variant % 2 else [int(draw.rng.integers(3))]
    factor, cameras = 1 + 0.03 * (-1) ** draw.variant, list(made.told.cameras)
    for c in wrong:
        matrix = cameras[c].matrix @ np.diag([factor, factor, 1])
        matrix[:2, 2] = cameras[c].matrix[:2, 2]
        cameras[c] = replace(cameras[c], matrix=matrix)
    return told_as(
        made, f"{len(wrong)} cameras, {factor:g}", told=replace(made.told, cameras=tuple(cameras)), honest=True
    )


def camera_dark(draw: Draw) -> Session:
    """One camera goes dark."""
    made, camera = ordinary(draw, fps=30.0), int(draw.rng.integers(3))
    start = start_of(30.0)
    made = seen_by(made, {camera: {"gain": lambda t: 0.01 if t > start else 1.0}})
    return told_as(made, made.told.cameras[camera].name, honest=True)


def plain(draw: Draw) -> Session:
    """Breathing, and nothing else; some on weak skin."""
    strength = draw.pick(1.0, 0.5, 0.25)
    made = ordinary(draw, fps=draw.pick(30.0, 13.0), breath=4.0, strength=strength, region=draw.variant != 4)
    return told_as(made, f"skin {strength:g}", honest=True)


def one_frozen(draw: Draw) -> Session:
    """One camera hangs and gives the same picture with fresh noise, or is 100 ms late."""
    fps, late = 30.0, draw.variant % 2 == 1
    start, made, camera = start_of(fps), _swaying(draw, fps, draw.variant % 3 != 0), int(draw.rng.integers(3))
    time = (lambda t: t - 0.1 if t > start else t) if late else (lambda t: min(t, start))
    return told_as(seen_by(made, {camera: {"time": time}}), "late" if late else "frozen", honest=True)


def gauze_at_rest(draw: Draw) -> Session:
    """Gauze that breathes with the skin below."""
    plainer = replace(draw, variant=1 + draw.variant % 2)  # of the skins those that show
    return told_as(_gauze(plainer, draw.pick(30.0, 13.0)), "breathing", honest=True)


def ordinary_cough(draw: Draw) -> Session:
    """A cough on ordinary skin."""
    amplitude, quarter, start = draw.uniform(10, 20), draw.uniform(0.1, 0.2), start_of(30.0)
    made = ordinary(draw, cough(draw.rng, start, amplitude, quarter), fps=30.0, breath=2.0)
    return told_as(made, f"{amplitude:.0f} mm in {1000 * quarter:.0f} ms", settled=start, honest=True)


KINDS: tuple[Kind, ...] = (
    *(board_jump, board_covered, board_sway, gauze_jump, gauze_cough, gauze_slip, squares_jump, squares_covered),
    *(chequerboard_hops, printed_beads, suture_row, tattoo, wound_rise, wound_rise_alone, resting_drape),
    *(dressing_slip, hair, two_patients, lamp_at_rest, shadow_drift, wet_film, two_frozen, two_late),
    *(frozen_and_late, mirrored, shimmer, rolling_shutter, teleport, glove, flicker, exposure_steps, blur, defocus),
    *(slow_pictures, focal_off, camera_dark, plain, one_frozen, gauze_at_rest, ordinary_cough),
)
NAMES = tuple(kind.__name__ for kind in KINDS)


def make_session(seed: int, index: int, size: tuple[int, int]) -> Session:
    """Session number `index` of a campaign: kinds take turns, and its draws are its own."""
    kind = KINDS[index % len(KINDS)]
    draw = Draw(np.random.default_rng([seed, index]), index // len(KINDS), size)
    return replace(kind(draw), kind=kind.__name__, seed=seed, index=index)
