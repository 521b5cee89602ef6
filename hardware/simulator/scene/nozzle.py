"""The print head before the camera: a needle, its hub, a cartridge and its holder, frustums about one axis.

What is seen of it and the shadow that it casts. Metal mirrors a room that is bright above and dark below.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import pixels_from_points
from estimation.runtime import compiled
from estimation.se3 import Array
from hardware.simulator.scene.appearance import Lamp
from hardware.simulator.scene.fields import Field, as_field, linear_light, upsample
from hardware.simulator.scene.ray_kernels import NOTHING, ONE
from hardware.simulator.scene.rays import ImageBox, RenderView

MIN_PART_DEPTH = 30.0  # mm before the lens: nearer, a part is not drawn
NOZZLE_LATTICE_PX = 4  # px between the rays that are looked up; straight between them, off by 1e-3 px


@dataclass(frozen=True, slots=True, eq=False)
class Frustum:
    """One part of the print head."""

    z0: float  # mm above the tip
    z1: float  # mm
    r0: float  # mm, radius at z0
    r1: float  # mm
    colour: Field  # linear BGR
    gloss: float  # 0..1
    metal: bool  # mirrors the room in its own colour


STEEL, PLASTIC, CARTRIDGE, LUER, RING, CAP = (
    linear_light(bgr)
    for bgr in ([176, 178, 180], [190, 198, 198], [136, 176, 204], [62, 92, 196], [104, 106, 110], [150, 112, 62])
)
NOZZLE_PARTS = (
    Frustum(0.0, 2.0, 0.32, 0.42, STEEL, 0.8, True),
    Frustum(2.0, 12.7, 0.42, 0.42, STEEL, 0.8, True),
    Frustum(12.7, 13.6, 0.5, 1.5, LUER, 0.5, False),
    Frustum(13.6, 21.0, 1.5, 2.5, LUER, 0.5, False),
    Frustum(21.0, 23.0, 3.6, 3.6, LUER, 0.5, False),
    Frustum(23.0, 27.0, 2.4, 4.6, PLASTIC, 0.6, False),
    Frustum(27.0, 50.0, 4.6, 4.6, CARTRIDGE, 0.65, False),
    Frustum(50.0, 58.0, 4.6, 4.6, PLASTIC, 0.6, False),
    Frustum(58.0, 76.0, 8.0, 8.0, RING, 0.5, True),
    Frustum(76.0, 78.0, 8.0, 7.0, RING, 0.5, True),
    Frustum(78.0, 88.0, 5.6, 5.2, CAP, 0.4, False),
    Frustum(88.0, 96.0, 2.2, 2.2, STEEL, 0.6, True),
)
NOZZLE_LENGTH = NOZZLE_PARTS[-1].z1
NOZZLE_OUTLINE = np.array(  # heights and radii mm; the steps are bridged
    [(part.z0, part.r0) for part in NOZZLE_PARTS] + [(NOZZLE_LENGTH, NOZZLE_PARTS[-1].r1)], np.float32
)
PART_TABLE = as_field([(p.z0, p.z1, p.r0, p.r1, *p.colour, p.gloss, p.metal) for p in NOZZLE_PARTS])  # (P, 9)
PartBox = tuple[int, ImageBox]  # number of a part, and the part of the image that it can touch


def part_outline(part: Frustum) -> Array:
    """Points (N, 3) mm, nozzle frame, whose pictures hold the part's."""
    rings = ((part.z0, 1.02 * part.r0), (part.z1, 1.02 * part.r1))
    angles = np.linspace(0, 2 * np.pi, 17)[:-1]
    return np.array([[r * np.cos(a), r * np.sin(a), z] for z, r in rings for a in angles])


PART_OUTLINES = np.stack([part_outline(part) for part in NOZZLE_PARTS])  # (P, N, 3) mm


def part_boxes(base_from_nozzle: Array | None, view: RenderView) -> list[PartBox]:
    """The parts in view and the part of the image that each can touch; base_from_nozzle: (4, 4) mm."""
    if base_from_nozzle is None:
        return []
    points = se3.transform_points(base_from_nozzle, PART_OUTLINES.reshape(-1, 3))
    pixels, depth = pixels_from_points(view.camera, points)
    pixels, depth = pixels.reshape(*PART_OUTLINES.shape[:2], 2), depth.reshape(PART_OUTLINES.shape[:2])
    boxes = (
        view.clip(p.min(0) - 2, p.max(0) + 3) if d.min() > MIN_PART_DEPTH else None
        for p, d in zip(pixels, depth, strict=True)
    )
    return [(part, box) for part, box in enumerate(boxes) if box is not None]


def whole_box(boxes: Sequence[PartBox]) -> ImageBox:
    """The box that holds all of them."""
    corners = np.array([box for _, box in boxes])
    x0, y0 = (int(v) for v in corners[:, :2].min(0))
    x1, y1 = (int(v) for v in corners[:, 2:].max(0))
    return ImageBox(x0, y0, x1, y1)


def nozzle_picture(
    base_from_nozzle: Array,
    base_from_rest: Array,
    lamps: Sequence[Lamp],
    ambient: float,
    view: RenderView,
    boxes: Sequence[PartBox],
    behind: Field,
) -> Field:
    """Light (H, W, 4) of parts in their whole box: linear BGR times opacity, and opacity.

    base_from_nozzle, base_from_rest: (4, 4) mm; the lamps hang over the latter. behind: (2H, 2W) mm, what may hide
    them, which takes their depths.
    """
    box = whole_box(boxes)
    nozzle_from_camera = se3.inverse(base_from_nozzle) @ view.camera.base_from_camera
    nozzle_from_rest = (se3.inverse(base_from_nozzle) @ base_from_rest)[:3, :3]
    x, y = (
        upsample(tangents[box.lattice(NOZZLE_LATTICE_PX)], box.sample_size)
        for tangents in view.coarse(NOZZLE_LATTICE_PX)
    )
    seen, normals = np.full(behind.shape, -1, np.int8), np.empty((3, *behind.shape), np.float32)
    for part, inner in boxes:
        rows, columns = box.samples(inner)
        corners = np.array([rows.start, rows.stop, columns.start, columns.stop])
        _meet_part(part, PART_TABLE, as_field(nozzle_from_camera), x, y, corners, behind, seen, normals)
    table = as_field([[*nozzle_from_rest @ lamp.towards, lamp.strength, 12 / (0.06 + lamp.spread)] for lamp in lamps])
    light = np.zeros((*behind.shape, 4), np.float32)
    room = as_field([*nozzle_from_rest[:, 2], ambient])
    _shade_parts(PART_TABLE, as_field(nozzle_from_camera), x, y, seen, normals, table, room, light)
    return as_field(cv2.resize(light, box.size[::-1], interpolation=cv2.INTER_AREA))


@compiled("void(i8, f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], i8[::1], f4[:,::1], i1[:,::1], f4[:,:,::1])")
def _meet_part(
    part: int,
    parts: Field,
    m: Field,
    tangents_x: Field,
    tangents_y: Field,
    box: NDArray[np.int64],
    depth: Field,
    seen: NDArray[np.int8],
    normals: Field,
) -> None:
    """Where rays meet a part nearer than depth (H, W): its side or one of its flat ends; depth, part and normal there.

    parts: PART_TABLE. m: nozzle_from_camera. box: rows from, until, columns from, until. normals: (3, H, W).
    """
    z0, z1, r0, r1 = parts[part, 0], parts[part, 1], parts[part, 2], parts[part, 3]
    ox, oy, oz = m[0, 3], m[1, 3], m[2, 3]
    k = (r1 - r0) / (z1 - z0)
    slant = ONE / np.sqrt(ONE + k * k)
    r = r0 + k * (oz - z0)
    c = ox * ox + oy * oy - r * r
    flat_z, flat_r, flat_side = (z1, r1, ONE) if oz > z1 else (z0, r0, -ONE)
    beside = z0 <= oz and oz <= z1  # no flat end is seen
    for row in range(box[0], box[1]):
        for column in range(box[2], box[3]):
            tx, ty = tangents_x[row, column], tangents_y[row, column]
            dx, dy = m[0, 0] * tx + m[0, 1] * ty + m[0, 2], m[1, 0] * tx + m[1, 1] * ty + m[1, 2]
            dz = m[2, 0] * tx + m[2, 1] * ty + m[2, 2]
            a = dx * dx + dy * dy - k * k * dz * dz
            b = dx * ox + dy * oy - k * r * dz
            nearest, nx, ny, nz = depth[row, column], NOTHING, NOTHING, NOTHING
            inside = b * b - a * c
            if inside >= NOTHING:
                side = (-b - np.sqrt(inside)) / a
                z = oz + side * dz
                if side > NOTHING and side < nearest and z >= z0 and z <= z1:
                    x, y = ox + side * dx, oy + side * dy
                    inverse = slant / np.sqrt(x * x + y * y)
                    nearest, nx, ny, nz = side, x * inverse, y * inverse, -k * slant
            if not beside:
                end = (flat_z - oz) / dz
                x, y = ox + end * dx, oy + end * dy
                if end > NOTHING and end < nearest and x * x + y * y <= flat_r * flat_r:
                    nearest, nx, ny, nz = end, NOTHING, NOTHING, flat_side
            if nearest < depth[row, column]:
                depth[row, column], seen[row, column] = nearest, part
                normals[0, row, column], normals[1, row, column], normals[2, row, column] = nx, ny, nz


@compiled("void(f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], i1[:,::1], f4[:,:,::1], f4[:,::1], f4[::1], f4[:,:,::1])")
def _shade_parts(
    parts: Field,
    m: Field,
    tangents_x: Field,
    tangents_y: Field,
    seen: NDArray[np.int8],
    normals: Field,
    lamps: Field,
    room: Field,
    light: Field,
) -> None:
    """Light (H, W, 4) of the samples in which a part is seen, linear BGR and opacity.

    lamps: (L, 5) towards each, its strength, and how narrow its glint is. room: (4,) upwards, and its irradiance.
    """
    for row in range(seen.shape[0]):
        for column in range(seen.shape[1]):
            part = seen[row, column]
            if part < 0:
                continue
            tx, ty = tangents_x[row, column], tangents_y[row, column]
            dx, dy = m[0, 0] * tx + m[0, 1] * ty + m[0, 2], m[1, 0] * tx + m[1, 1] * ty + m[1, 2]
            dz = m[2, 0] * tx + m[2, 1] * ty + m[2, 2]
            nx, ny, nz = normals[0, row, column], normals[1, row, column], normals[2, row, column]
            length = ONE / np.sqrt(dx * dx + dy * dy + dz * dz)
            away = (dx * nx + dy * ny + dz * nz) * length  # cosine, negative towards the eye
            turned = np.float32(2) * away
            x, y, z = dx * length - turned * nx, dy * length - turned * ny, dz * length - turned * nz  # mirrored
            height = x * room[0] + y * room[1] + z * room[2]
            mirrored = np.float32(0.46) + np.float32(0.45) * height + np.float32(0.12) * np.sin(np.float32(9) * height)
            mirrored = min(max(mirrored, np.float32(0.12)), ONE)
            up = nx * room[0] + ny * room[1] + nz * room[2]
            lit, glint = room[3] * (np.float32(0.6) + np.float32(0.4) * up), NOTHING
            for k in range(len(lamps)):
                lit += lamps[k, 3] * max(nx * lamps[k, 0] + ny * lamps[k, 1] + nz * lamps[k, 2], NOTHING)
                near = x * lamps[k, 0] + y * lamps[k, 1] + z * lamps[k, 2] - ONE
                glint += lamps[k, 3] * np.exp(lamps[k, 4] * near)
            facing = ONE + min(away, NOTHING)
            rim = np.float32(0.04) + np.float32(0.5) * facing * facing * facing * facing
            gloss, metal = parts[part, 7], parts[part, 8] > NOTHING
            own = np.float32(0.75) * mirrored + np.float32(0.25) * lit if metal else lit
            film = np.float32(0.7) * glint * gloss if metal else (rim * mirrored + np.float32(0.5) * glint) * gloss
            for c in range(3):
                colour = parts[part, 4 + c]
                light[row, column, c] = colour * own + (colour * film if metal else film)
            light[row, column, 3] = ONE


def passing_light(points: tuple[Field, Field, Field], nozzle_from_rest: Array, lamp: Lamp) -> Field:
    """Share of the lamp's light that passes the nozzle, at points given by x, y, z (H, W) mm, nozzle frame.

    The lamp is a disc: the shadow's edge softens with the distance between the nozzle and what it falls on.
    """
    share = np.empty_like(points[2])
    towards = as_field(nozzle_from_rest[:3, :3] @ lamp.towards)
    _pass_nozzle(*points, towards, np.float32(lamp.spread), NOZZLE_OUTLINE, share)
    return share


@compiled("void(f4[:,::1], f4[:,::1], f4[:,::1], f4[::1], f4, f4[:,::1], f4[:,::1])")
def _pass_nozzle(x: Field, y: Field, z: Field, lamp: Field, spread: np.float32, outline: Field, share: Field) -> None:
    """Share (H, W) of a lamp's light that passes the nozzle at points x, y, z mm of its frame.

    lamp: (3,) towards it, unit. spread: rad. outline: (N, 2) heights, rising, and radii mm of the nozzle, of straight
    pieces between: its steps are bridged.
    """
    lx, ly, lz = lamp[0], lamp[1], lamp[2]
    across = max(lx * lx + ly * ly, np.float32(1e-4))
    top = outline[len(outline) - 1, 0]
    for row in range(x.shape[0]):
        for column in range(x.shape[1]):
            px, py, pz = x[row, column], y[row, column], z[row, column]
            away = max(-(px * lx + py * ly) / across, NOTHING)  # mm along the ray to where it passes the axis
            height = min(max(pz + away * lz, NOTHING), top)
            if abs(lz) > np.float32(0.2):
                away = max((height - pz) / lz, NOTHING)
            gx, gy, gz = px + away * lx, py + away * ly, pz + away * lz - height
            gap = np.sqrt(gx * gx + gy * gy + gz * gz)
            soft = np.float32(0.25) + spread * away
            k = 1
            while k < len(outline) - 1 and outline[k, 0] < height:
                k += 1
            part = (height - outline[k - 1, 0]) / max(outline[k, 0] - outline[k - 1, 0], np.float32(1e-6))
            radius = outline[k - 1, 1] + min(max(part, NOTHING), ONE) * (outline[k, 1] - outline[k - 1, 1])
            hidden = min(max((radius + soft - gap) / (np.float32(2) * soft), NOTHING), ONE)
            if hidden > NOTHING:
                hidden *= min(ONE, (radius / soft) ** np.float32(0.7))
            share[row, column] = ONE - hidden * hidden * (np.float32(3) - np.float32(2) * hidden)
