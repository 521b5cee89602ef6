"""How things look: textures of skin, wounds, boards, gauze, drapes, gloves and what else lies in the field.

A texture is (N, M, 4) float32: blue, green, red reflectance and coverage, all 0 to 1. Its middle is the origin; columns
run along x, rows along y. None has detail below 0.25 mm, so that pictures of 0.3 to 0.6 mm a pixel hardly alias.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Texture = NDArray[np.float32]
Field = NDArray[np.float32]
Colour = tuple[float, float, float]  # blue, green, red

FINEST_MM = 0.25  # one sigma of the finest detail
SKIN_SCALE = 5.0  # texels a mm, of skin and what is drawn on it
SKIN_SIDE = 170.0  # mm
BOARD_SCALE = 4.0  # texels a mm
DRAPE_SCALE = 2.5  # texels a mm
SKIN: Colour = (0.26, 0.36, 0.62)
WOUND: Colour = (0.035, 0.045, 0.26)
WHITE: Colour = (0.8, 0.82, 0.84)


def noise(rng: np.random.Generator, side: int, sigma: float) -> Field:
    """Smooth noise (side, side) of mean 0 and standard deviation 1. sigma: texels, of the bell that smooths it."""
    step = max(1.0, sigma / 2)
    small = math.ceil(side / step) + 8
    white = rng.standard_normal((small, small), np.float32)
    smooth = cv2.GaussianBlur(white, (0, 0), sigma / step)
    smooth = (smooth - smooth.mean()) / smooth.std()
    if step == 1.0:
        return np.ascontiguousarray(smooth[:side, :side])
    large = cv2.resize(smooth, (math.ceil(small * step),) * 2, interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(large[:side, :side])


def blank(width: float, height: float, scale: float, colour: Colour = WHITE, cover: float = 1.0) -> Texture:
    """One colour over width x height, mm."""
    texture = np.empty((round(height * scale), round(width * scale), 4), np.float32)
    texture[:] = (*colour, cover)
    return texture


def softened(texture: Texture, scale: float, sigma: float = FINEST_MM) -> Texture:
    """Without detail below `sigma`, mm."""
    return np.asarray(cv2.GaussianBlur(texture, (0, 0), sigma * scale), np.float32)


def grid(shape: Sequence[int], scale: float) -> tuple[Field, Field]:
    """x and y, mm, of every texel."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    return (x - (shape[1] - 1) / 2) / scale, (y - (shape[0] - 1) / 2) / scale


def within(beyond: Field, soft: float) -> Field:
    """From 1 well inside to 0 well outside of a border. beyond: distance from it, positive outside; soft: its width."""
    return np.asarray(0.5 - 0.5 * np.tanh(beyond / (2 * soft)), np.float32)


def skin(rng: np.random.Generator, strength: float = 1.0, moles: int = 6, side: float = SKIN_SIDE) -> Texture:
    """Skin: blotches, furrows, pores, vessels and moles. strength: of all but the moles; 0.2 is weak."""
    n, scale = round(side * SKIN_SCALE), SKIN_SCALE
    blotch = 0.05 * noise(rng, n, 18 * scale) + 0.04 * noise(rng, n, 5 * scale)
    fine = 0.05 * noise(rng, n, 1.5 * scale) + 0.045 * noise(rng, n, 0.5 * scale)
    furrow = -0.10 * np.exp(-((noise(rng, n, 1.1 * scale) / 0.25) ** 2))
    pores = np.zeros((n, n), np.float32)
    spots = rng.integers(0, n, (round(0.12 * side**2), 2))
    pores[spots[:, 0], spots[:, 1]] = rng.uniform(0.5, 1.5, len(spots))
    pores = -2.2 * cv2.GaussianBlur(pores, (0, 0), 0.3 * scale) * scale**0.5
    vessels = -0.16 * _vessels(rng, n, scale)
    dark = strength * (blotch + fine + furrow + pores)
    red = strength * 0.05 * noise(rng, n, 7 * scale)
    texture = blank(side, side, scale, SKIN)
    for channel, (grey, hue, vein) in enumerate(((1.0, -1.0, 0.4), (1.1, -0.8, 1.0), (0.8, 0.5, 1.0))):
        texture[..., channel] *= np.exp(grey * dark + hue * red + strength * vein * vessels)
    for _ in range(moles):
        place, radius = rng.uniform(-0.42, 0.42, 2) * side, rng.uniform(0.5, 1.6)
        spot(texture, scale, place, radius, (0.06, 0.09, 0.19))
    return softened(texture, scale)


def _vessels(rng: np.random.Generator, n: int, scale: float) -> Field:
    drawn = np.zeros((n, n), np.float32)
    for _ in range(14):
        heading, place = rng.uniform(0, 2 * math.pi), rng.uniform(0, n, 2)
        line = [place]
        for _ in range(60):
            heading += rng.normal(0, 0.25)
            line.append(line[-1] + 1.5 * scale * np.array([math.cos(heading), math.sin(heading)]))
        width = max(1, round(rng.uniform(0.5, 1.5) * scale))
        cv2.polylines(drawn, [np.array(line).astype(np.int32)], False, rng.uniform(0.4, 1.0), width)
    return np.asarray(cv2.GaussianBlur(drawn, (0, 0), 0.5 * scale), np.float32)


def spot(texture: Texture, scale: float, place: Sequence[float], radius: float, colour: Colour) -> None:
    """A round mark at a place (x, y), mm, drawn into the texture."""
    reach = radius + 2.0
    h, w = texture.shape[:2]
    column, row = place[0] * scale + (w - 1) / 2, place[1] * scale + (h - 1) / 2
    left, top = max(0, int(column - reach * scale)), max(0, int(row - reach * scale))
    part = texture[top : int(row + reach * scale) + 2, left : int(column + reach * scale) + 2]
    y, x = np.mgrid[: part.shape[0], : part.shape[1]]
    away = np.hypot(x + left - column, y + top - row) / scale
    cover = within(away - radius, 0.15)
    part[..., :3] += cover[..., None] * (np.array(colour) - part[..., :3])


def with_wound(
    rng: np.random.Generator, texture: Texture, radius: float, strength: float = 1.0, contrast: float = 1.0
) -> Texture:
    """The skin with a wound in its middle. contrast: 1 is red and dark, 0.15 hardly differs from skin in colour."""
    n, scale = texture.shape[0], SKIN_SCALE
    x, y = grid(texture.shape, scale)
    away = np.hypot(x, 1.25 * y) + 0.11 * radius * noise(rng, n, 5 * scale)
    inside = within(away - radius, 0.6)
    rim = 0.35 * np.exp(-(((away - radius - 1.5) / 2.0) ** 2))
    flesh = np.empty_like(texture[..., :3])
    bumps = 0.16 * noise(rng, n, 0.6 * scale) + 0.2 * noise(rng, n, 1.6 * scale) + 0.12 * noise(rng, n, 5 * scale)
    fibrin = within(1.3 - noise(rng, n, 2.2 * scale), 0.15)
    for channel in range(3):
        flesh[..., channel] = WOUND[channel] * np.exp(strength * bumps)
        flesh[..., channel] += strength * fibrin * ((0.16, 0.32, 0.4)[channel] - flesh[..., channel])
    flesh = SKIN + contrast * (flesh - SKIN) if contrast < 1 else flesh
    result = texture.copy()
    for channel, redness in enumerate((1.0, 1.0, 0.25)):
        result[..., channel] *= np.exp(-contrast * redness * rim)
    result[..., :3] += inside[..., None] * (flesh - result[..., :3])
    return softened(result, scale)


def board(
    width: float, height: float, square: float, contrast: float = 1.0, margin: float = 0.0, scale: float = BOARD_SCALE
) -> Texture:
    """Printed squares. contrast: 1 is black on white; less lets what is below show through. margin: mm, white round."""
    texture = blank(width + 2 * margin, height + 2 * margin, scale, WHITE, contrast)
    x, y = grid(texture.shape, scale)
    dark = (np.floor(x / square + 0.5).astype(int) + np.floor(y / square + 0.5).astype(int)) % 2 == 1
    dark &= (abs(x) < width / 2) & (abs(y) < height / 2)
    texture[dark, :3] = 0.04
    return softened(texture, scale)


def scribbles(rng: np.random.Generator, texture: Texture, scale: float, count: int) -> Texture:
    """With marks of its own: short strokes and dots of ink, none like another."""
    drawn = texture.copy()
    h, w = texture.shape[:2]
    for _ in range(count):
        place = rng.uniform(-0.4, 0.4, 2) * (w, h) + (w / 2, h / 2)
        points = place + np.cumsum(rng.normal(0, 2.2 * scale, (6, 2)), axis=0)
        ink = (*(float(v) for v in rng.uniform(0.02, 0.5, 3)), 1.0)
        cv2.polylines(drawn, [points.astype(np.int32)], False, ink, max(1, round(0.9 * scale)), cv2.LINE_AA)
    return softened(drawn, scale)


def gauze(rng: np.random.Generator, side: float, pitch: float, irregular: float = 0.03) -> Texture:
    """A woven mesh through which skin shows. irregular: mm, by which threads lie off."""
    scale = 5.0
    texture = blank(side, side, scale, (0.78, 0.8, 0.82), 0.0)
    n = len(texture)
    x, y = grid(texture.shape, scale)
    x, y = x + irregular * noise(rng, n, 6 * scale), y + irregular * noise(rng, n, 6 * scale)
    across = [np.abs((v / pitch + 0.5) % 1 - 0.5) * pitch for v in (x, y)]
    threads = [np.exp(-((a / 0.55) ** 4)) for a in across]
    over = 0.5 + 0.5 * np.sign(np.sin(math.pi * x / pitch) * np.sin(math.pi * y / pitch))
    round_ = [1 - 0.5 * np.minimum(a / 0.6, 1) ** 2 for a in across]
    light = np.where(over > 0.5, threads[0] * round_[0] + (1 - threads[0]) * round_[1], round_[1])
    texture[..., :3] *= light[..., None]
    texture[..., 3] = 0.12 + 0.75 * np.maximum(*threads)
    return softened(texture, scale, 0.2)


def patched(texture: Texture, scale: float, width: float, height: float, centre: Sequence[float]) -> Texture:
    """Only a rectangle of it, mm, with a soft border."""
    x, y = grid(texture.shape, scale)
    off = np.maximum(abs(x - centre[0]) - width / 2, abs(y - centre[1]) - height / 2)
    result = texture.copy()
    result[..., 3] *= within(off, 0.2)
    return result


def dressing(rng: np.random.Generator, width: float, height: float) -> Texture:
    """A plaster: beige cloth with holes, stains and a woven look."""
    scale = 4.0
    texture = blank(width, height, scale, (0.42, 0.55, 0.7))
    n = max(texture.shape[:2])
    look = 0.12 * noise(rng, n, 0.5 * scale) + 0.1 * noise(rng, n, 2 * scale) + 0.1 * noise(rng, n, 6 * scale)
    texture[..., :3] *= np.exp(look[: texture.shape[0], : texture.shape[1], None])
    x, y = grid(texture.shape, scale)
    holes = np.exp(-((np.hypot((x + 1.5) % 3 - 1.5, (y + 1.5) % 3 - 1.5) / 0.45) ** 4))
    texture[..., :3] *= 1 - 0.55 * holes[..., None]
    for _ in range(5):
        place = rng.uniform(-0.4, 0.4, 2) * (width, height)
        spot(texture, scale, place, rng.uniform(0.8, 3), (0.08, 0.1, 0.32))
    return softened(texture, scale)


def drape(
    rng: np.random.Generator, side: float, window: tuple[float, float] | None = None, strong: float = 1.0
) -> Texture:
    """Blue cloth with weave, creases and specks. window: mm, of the opening through which the field is seen."""
    scale = DRAPE_SCALE
    n = round(side * scale)
    texture = blank(side, side, scale, (0.42, 0.25, 0.12))
    weave = 0.10 * noise(rng, n, 0.9) + 0.08 * noise(rng, n, 2.0 * scale)
    crease = noise(rng, n, 12 * scale)
    look = weave + 0.2 * np.exp(-((crease / 0.06) ** 2)) + 0.10 * noise(rng, n, 25 * scale)
    texture[..., :3] *= np.exp(strong * look)[..., None]
    for _ in range(round(40 * strong)):
        spot(texture, scale, rng.uniform(-0.5, 0.5, 2) * side, rng.uniform(0.5, 1.6), (0.6, 0.6, 0.6))
    if window is not None:
        x, y = grid(texture.shape, scale)
        inside = (np.abs(2 * x / window[0]) ** 4 + np.abs(2 * y / window[1]) ** 4) ** 0.25
        texture[..., 3] = within((1 - inside) * window[0] / 2, 0.4)
    return softened(texture, scale, 0.3)


def glove(rng: np.random.Generator, colour: Colour = (0.62, 0.42, 0.2)) -> Texture:
    """A gloved hand that reaches in along x, 420 x 130 mm, its palm in the middle."""
    scale = 3.0
    texture = blank(420, 130, scale, colour, 0.0)
    h, w = texture.shape[:2]
    cover = np.zeros((h, w), np.float32)
    wrist, palm = (0, h // 2), (w // 2, h // 2)
    cv2.line(cover, wrist, palm, 1.0, round(58 * scale))
    cv2.ellipse(cover, palm, (round(48 * scale), round(42 * scale)), 0, 0, 360, 1.0, -1)
    for k, length in enumerate((70, 84, 80, 62)):
        y = h / 2 + (k - 1.5) * 20 * scale
        end = (round((210 + length) * scale), round(y + rng.normal(0, 5) * scale))
        cv2.line(cover, (round(200 * scale), round(y)), end, 1.0, round(17 * scale))
    cover = cv2.GaussianBlur(cover, (0, 0), 0.5 * scale)
    body = cv2.GaussianBlur(cover, (0, 0), 5 * scale)
    folds = 0.12 * noise(rng, max(h, w), 3 * scale)[:h, :w] + 0.06 * noise(rng, max(h, w), 0.8 * scale)[:h, :w]
    texture[..., :3] *= ((0.35 + 0.75 * body) * np.exp(folds))[..., None]
    texture[..., 3] = cover
    return texture


def beads(rng: np.random.Generator, width: float, height: float, pitch: float) -> Texture:
    """Printed beads side by side, along x: translucent gel, brighter on one flank."""
    scale = 6.0
    texture = blank(width, height, scale, (0.62, 0.72, 0.78), 0.92)
    _, y = grid(texture.shape, scale)
    phase = 2 * math.pi * y / pitch
    texture[..., :3] *= (0.62 + 0.28 * np.cos(phase) + 0.16 * np.sin(phase))[..., None]
    n = max(texture.shape[:2])
    texture[..., :3] *= np.exp(0.015 * noise(rng, n, 2 * scale)[: texture.shape[0], : texture.shape[1], None])
    return softened(texture, scale, 0.2)


def sutures(rng: np.random.Generator, count: int, pitch: float, jitter: float = 0.05) -> Texture:
    """A row of stitches along x across a closed seam. jitter: mm."""
    scale = 6.0
    width = count * pitch + 6
    texture = blank(width, 16, scale, (0.08, 0.02, 0.02), 0.0)
    h, w = texture.shape[:2]
    seam, thread = np.zeros((h, w), np.float32), np.zeros((h, w), np.float32)
    cv2.line(seam, (0, h // 2), (w, h // 2), 0.6, round(0.8 * scale))
    for k in range(count):
        x = 3 + (k + 0.5) * pitch + rng.normal(0, jitter)
        ends = [(round(x * scale), round((8 + s * 4.5) * scale)) for s in (-1, 1)]
        cv2.line(thread, *ends, 1.0, round(0.8 * scale), cv2.LINE_AA)
        for end in ends:
            cv2.circle(thread, end, round(0.7 * scale), 1.0, -1, cv2.LINE_AA)
    texture[..., :3] += (seam * (1 - thread))[..., None] * (np.array((0.05, 0.06, 0.3)) - texture[..., :3])
    texture[..., 3] = np.maximum(seam, thread)
    return softened(texture, scale, 0.2)


def hairs(rng: np.random.Generator, side: float, count: int) -> Texture:
    """Dark hairs that all lie much the same way."""
    scale = 5.0
    texture = blank(side, side, scale, (0.02, 0.03, 0.05), 0.0)
    cover = np.zeros(texture.shape[:2], np.float32)
    way = rng.uniform(0, 2 * math.pi)
    for _ in range(count):
        place, heading = rng.uniform(0, side, 2), way + rng.normal(0, 0.35)
        line, bend = [place], rng.normal(0, 0.06)
        for _ in range(14):
            heading += bend
            line.append(line[-1] + np.array([math.cos(heading), math.sin(heading)]))
        cv2.polylines(cover, [(scale * np.array(line)).astype(np.int32)], False, 0.9, 2, cv2.LINE_AA)
    texture[..., 3] = cv2.GaussianBlur(cover, (0, 0), 0.2 * scale)
    return texture


def tattoo(rng: np.random.Generator, side: float, pitch: float) -> Texture:
    """An ornament that repeats in both directions: rings, dots and diagonals of dark ink in the skin."""
    scale = 5.0
    texture = blank(side, side, scale, (0.09, 0.07, 0.05), 0.0)
    x, y = grid(texture.shape, scale)
    u, v = (x / pitch + 0.5) % 1 - 0.5, (y / pitch + 0.5) % 1 - 0.5
    away = np.hypot(u, v) * pitch
    ring = np.exp(-(((away - 0.32 * pitch) / 0.45) ** 4)) + np.exp(-((away / 0.9) ** 4))
    lines = np.exp(-((np.abs(np.abs(u) - np.abs(v)) * pitch / 0.4) ** 4)) * (away > 0.42 * pitch)
    ink = np.clip(ring + lines, 0, 1) * np.exp(0.04 * noise(rng, len(texture), 4 * scale))
    texture[..., 3] = 0.8 * np.minimum(ink, 1)
    return softened(texture, scale)


def lamp_pattern(rng: np.random.Generator, side: float, scale: float, contrast: float, blob: float) -> Field:
    """Light (N, N) about 1 as a lamp with many reflectors casts it. contrast: one sigma of it, so that 0.125
    is 25 % from peak to valley of what stands out; blob: mm."""
    n = round(side * scale)
    look = noise(rng, n, blob * scale) + 0.5 * noise(rng, n, 0.45 * blob * scale)
    return np.asarray(np.clip(1 + contrast * look / 1.12, 0.15, 2.0), np.float32)


def soft_shadow(rng: np.random.Generator, side: float, scale: float, depth: float, edge: float) -> Field:
    """Light (N, N), 1 outside the shadow of an arm or a cable. depth: how much it takes; edge: mm, its penumbra."""
    shape = (round(side * scale),) * 2
    x, y = grid(shape, scale)
    turn = rng.uniform(-0.5, 0.5)
    along = x * math.cos(turn) + y * math.sin(turn) + 3 * noise(rng, shape[0], 20 * scale)
    inside = within(np.abs(along) - 25, edge)
    lobes = 1 + 0.3 * noise(rng, shape[0], 9 * scale)
    return np.asarray(1 - depth * np.clip(inside * lobes, 0, 1), np.float32)


def wet_film(rng: np.random.Generator, side: float, rough: float, gloss: float, grain: float) -> Field:
    """Slopes along x and y and gloss (N, N, 3) of a wet film. rough: one sigma of a slope; grain: mm, of its waves."""
    scale = 4.0
    n = round(side * scale)
    wave = noise(rng, n, grain * scale)
    film = np.empty((n, n, 3), np.float32)
    film[..., 0], film[..., 1] = np.gradient(wave, axis=1), np.gradient(wave, axis=0)
    film[..., :2] *= rough / film[..., 0].std()
    film[..., 2] = gloss * np.clip(1 + 0.5 * noise(rng, n, 8 * scale), 0, 2)
    return film


def lamp_panel(side: float, spots: int) -> Field:
    """Brightness (N, N) of a surgical lamp from below: a ring of round spots, and one in its middle."""
    scale = 1.0
    x, y = grid((round(side * scale),) * 2, scale)
    light = np.exp(-((np.hypot(x, y) / 28) ** 4))
    for k in range(spots):
        angle = 2 * math.pi * k / spots
        light += np.exp(-((np.hypot(x - 95 * math.cos(angle), y - 95 * math.sin(angle)) / 26) ** 4))
    return np.asarray(light, np.float32)
