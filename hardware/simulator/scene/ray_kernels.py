"""The loops of rendering, compiled: where rays meet a height field, and the light they bring back.

Single precision throughout. Functions return what they find or fill arrays that are given; the interpreter is free
meanwhile, so that cameras are rendered side by side.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.runtime import compiled
from hardware.simulator.scene.fields import Field

SAMPLES_PER_PIXEL = 2  # per pixel and axis
CELL_PX = 8  # px: boxes are whole cells, and what varies slowly is worked out once a cell
CELL_SAMPLES = CELL_PX * SAMPLES_PER_PIXEL

GRAZING_Z = np.float32(-0.03)  # of a ray's z: those that sink less never meet the shape
OFF_GRID = np.float32(-1e5)  # a node where nothing is painted
SEARCH_STEPS = 56  # of the search downwards through all heights
LOCAL_SEARCH_STEPS = 24  # of a search between near bounds
NEWTON_ROUNDS = 2  # of Newton's method
GRAZING_FACING = np.float32(0.3)  # rays that meet the surface more grazing (1: head on) are searched for one by one
NEWTON_TOLERANCE = np.float32(2e-3)  # mm that is left over where Newton's method did not come to rest
NEAR_NODES = np.float32(4.0)  # nodes beyond the field's edge that still count as near it
NOTHING, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)
Bytes = NDArray[np.uint8]

Line = tuple[np.float32, np.float32, np.float32, np.float32, np.float32]


@compiled("UniTuple(f4, 5)(f4[:,::1], f4, f4)", inlined=True)
def _ray_line(m: Field, x: np.float32, y: np.float32) -> Line:
    """A ray (x, y, 1) as a line over the nodes: at height z it stands over (u + z du, v + z dv); and 1 / its own z.

    m: (5, 3): rotation from camera to grid; nodes a mm along x and y, and 1; where the lens stands, in nodes and mm.
    """
    dx, dy = m[0, 0] * x + m[0, 1] * y + m[0, 2], m[1, 0] * x + m[1, 1] * y + m[1, 2]
    dz = m[2, 0] * x + m[2, 1] * y + m[2, 2]
    if dz > GRAZING_Z:
        return OFF_GRID, OFF_GRID, NOTHING, NOTHING, -ONE
    sink = ONE / dz
    du, dv = dx * sink * m[3, 0], dy * sink * m[3, 1]
    return m[4, 0] - m[4, 2] * du, m[4, 1] - m[4, 2] * dv, du, dv, sink


@compiled("UniTuple(f4, 3)(f4, i8)", inlined=True)
def _place(at: np.float32, count: int) -> tuple[np.float32, np.float32, np.float32]:
    """Number of the node before `at` of `count` >= 2, and the weights of it and the next; beyond the edge, the edge."""
    last = np.float32(count - 1)
    if not at > NOTHING:
        return NOTHING, ONE, NOTHING
    if not at < last:
        return last - ONE, NOTHING, ONE
    before = np.float32(int(at))
    return before, ONE - (at - before), at - before


@compiled("f4(f4[:,::1], f4, f4)", inlined=True)
def height_at(heights: Field, u: np.float32, v: np.float32) -> np.float32:
    """The field at column u and row v, bilinear, beyond its edge as it is there."""
    column, left, right = _place(u, heights.shape[1])
    row, upper, lower = _place(v, heights.shape[0])
    i, j = np.uint64(column), np.uint64(row)
    i1, j1 = np.uint64(column + ONE), np.uint64(row + ONE)
    above = left * heights[j, i] + right * heights[j, i1]
    below = left * heights[j1, i] + right * heights[j1, i1]
    height: np.float32 = upper * above + lower * below
    return height


@compiled("UniTuple(f4, 2)(f4[:,:,::1], f4, f4)", inlined=True)
def _slopes(field: Field, u: np.float32, v: np.float32) -> tuple[np.float32, np.float32]:
    """The first two values of a field (H, W, 4), as `height_at`."""
    column, left, right = _place(u, field.shape[1])
    row, upper, lower = _place(v, field.shape[0])
    i, j = np.uint64(column), np.uint64(row)
    i1, j1 = np.uint64(column + ONE), np.uint64(row + ONE)
    a, b, c, d = upper * left, upper * right, lower * left, lower * right
    first = a * field[j, i, 0] + b * field[j, i1, 0] + c * field[j1, i, 0] + d * field[j1, i1, 0]
    return first, a * field[j, i, 1] + b * field[j, i1, 1] + c * field[j1, i, 1] + d * field[j1, i1, 1]


@compiled("UniTuple(f4, 3)(f4[:,::1], f4[:,:,::1], UniTuple(f4, 5), f4)", inlined=True)
def _newton(heights: Field, slopes: Field, ray: Line, z: np.float32) -> tuple[np.float32, np.float32, np.float32]:
    """A height nearer to the surface than z, what was left over before the last round, mm, and how much the ray faces
    the surface. The slope at the start serves all rounds."""
    u, v, du, dv, _ = ray
    across, along = _slopes(slopes, u + z * du, v + z * dv)
    facing = ONE - across * du - along * dv
    step = ONE / max(facing, np.float32(0.15))
    for _round in range(NEWTON_ROUNDS):
        z -= (z - height_at(heights, u + z * du, v + z * dv)) * step
    rest = z - height_at(heights, u + z * du, v + z * dv)
    return z - rest * step, rest, facing


@compiled("UniTuple(f4, 2)(f4[:,::1], UniTuple(f4, 5), f4, f4, i8)", inlined=True)
def _search_down(
    heights: Field, ray: Line, low: np.float32, high: np.float32, steps: int
) -> tuple[np.float32, np.float32]:
    """Height where a ray first meets the field, by steps from high to low, and how much it faces it (1: head on)."""
    u, v, du, dv, _ = ray
    step = (high - low) / np.float32(steps - 1)
    above = step
    for k in range(steps):
        level = high - np.float32(k) * step
        clearance = level - height_at(heights, u + level * du, v + level * dv)
        if clearance <= NOTHING:
            fall = max(above - clearance, np.float32(1e-6))
            return level - step * clearance / fall, fall / step
        above = clearance
    return low, ONE


@compiled("b1(f4[:,::1], f4, f4)", inlined=True)
def _near_field(heights: Field, u: np.float32, v: np.float32) -> bool:
    """Whether a node is on the field or within NEAR_NODES of it."""
    beyond = max(u - np.float32(heights.shape[1]), v - np.float32(heights.shape[0]), -u, -v)
    return bool(beyond < NEAR_NODES)


@compiled("void(f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], f4, f4, f4[:,::1], u1[:,::1], f4[:,::1], f4[:,::1])")
def search_cells(
    m: Field,
    x: Field,
    y: Field,
    heights: Field,
    low: np.float32,
    high: np.float32,
    start: Field,
    hard: Bytes,
    nodes_u: Field,
    nodes_v: Field,
) -> None:
    """Where the rays x, y (h, w) first meet a field that keeps within low and high: height, nodes, and whether hard.

    hard: it grazes the surface there. m: as `_ray_line`.
    """
    for j in range(x.shape[0]):
        for i in range(x.shape[1]):
            ray = _ray_line(m, x[j, i], y[j, i])
            z, facing = _search_down(heights, ray, low, high, SEARCH_STEPS)
            start[j, i], nodes_u[j, i], nodes_v[j, i] = z, ray[0] + z * ray[2], ray[1] + z * ray[3]
            hard[j, i] = facing < GRAZING_FACING and _near_field(heights, nodes_u[j, i], nodes_v[j, i])


@compiled("void(f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], f4[:,:,::1])")
def begin_rays(m: Field, x: Field, y: Field, z: Field, rays: Field) -> None:
    """Rays x, y (H, W) as lines, into rays (8, H, W): nodes at height z, mm, then u, v, du, dv and sink of `_ray_line`;
    the last is left alone."""
    for row in range(x.shape[0]):
        for column in range(x.shape[1]):
            u, v, du, dv, sink = _ray_line(m, x[row, column], y[row, column])
            height = z[row, column]
            rays[0, row, column], rays[1, row, column] = u + height * du, v + height * dv
            rays[2, row, column], rays[3, row, column] = u, v
            rays[4, row, column], rays[5, row, column], rays[6, row, column] = du, dv, sink


@compiled("void(f4[:,:,::1], f4[:,:,::1], f4[:,::1], u1[:,::1])")
def face_rays(slopes: Field, rays: Field, z: Field, doubt: Bytes) -> None:
    """The first round of Newton's method for slopes along u and v and heights, (H, W, 4), at the nodes.

    Into rays[7] goes what serves all rounds. doubt: 2 where a ray grazes the surface.
    """
    for row in range(slopes.shape[0]):
        for column in range(slopes.shape[1]):
            facing = ONE - slopes[row, column, 0] * rays[4, row, column] - slopes[row, column, 1] * rays[5, row, column]
            step = ONE / max(facing, np.float32(0.15))
            height = z[row, column]
            height -= (height - slopes[row, column, 2]) * step
            z[row, column], rays[7, row, column] = height, step
            rays[0, row, column] = rays[2, row, column] + height * rays[4, row, column]
            rays[1, row, column] = rays[3, row, column] + height * rays[5, row, column]
            doubt[row, column] = 2 if facing < GRAZING_FACING else 0


@compiled("void(f4[:,::1], f4[:,:,::1], f4[:,::1])")
def step_rays(heights: Field, rays: Field, z: Field) -> None:
    """A round of Newton's method: z and the nodes, for heights (H, W) mm at the nodes as they were."""
    for row in range(z.shape[0]):
        for column in range(z.shape[1]):
            height = z[row, column]
            height -= (height - heights[row, column]) * rays[7, row, column]
            z[row, column] = height
            rays[0, row, column] = rays[2, row, column] + height * rays[4, row, column]
            rays[1, row, column] = rays[3, row, column] + height * rays[5, row, column]


@compiled("b1(f4[:,::1], f4[:,::1], u1[:,::1], u1[:,::1])")
def note_doubt(heights: Field, z: Field, odd: Bytes, doubt: Bytes) -> bool:
    """Note 1 in doubt (H, W) where a ray's height z is too far from the surface's or its cell (h, w) is odd; any?"""
    found = False
    for row in range(z.shape[0]):
        for column in range(z.shape[1]):
            if not abs(z[row, column] - heights[row, column]) < NEWTON_TOLERANCE:
                doubt[row, column] |= 1
            if odd[row // CELL_SAMPLES, column // CELL_SAMPLES]:
                doubt[row, column] |= 1
            if doubt[row, column]:
                found = True
    return found


@compiled(
    "void(f4[:,::1], f4[:,:], f4[:,:], f4[:,::1], f4[:,:,::1], f4[:,::1], f4[:,::1], u1[:,::1], f4[:,::1], f4[:,:,::1])"
)
def search_doubtful(
    m: Field,
    x: Field,
    y: Field,
    heights: Field,
    slopes: Field,
    low: Field,
    high: Field,
    doubt: Bytes,
    z: Field,
    rays: Field,
) -> None:
    """Search for the rays in doubt one by one, between the bounds low and high (h, w) mm of their cells.

    Puts z (H, W) mm and the nodes in `rays` right.
    """
    for row in range(x.shape[0]):
        for column in range(x.shape[1]):
            if not doubt[row, column]:
                continue
            ray = _ray_line(m, x[row, column], y[row, column])
            j, i = row // CELL_SAMPLES, column // CELL_SAMPLES
            middle = HALF * (low[j, i] + high[j, i])
            if not _near_field(heights, ray[0] + middle * ray[2], ray[1] + middle * ray[3]):
                continue
            found, _ = _search_down(heights, ray, low[j, i], high[j, i], LOCAL_SEARCH_STEPS)
            better, left, _ = _newton(heights, slopes, ray, found)
            height = better if abs(left) < np.float32(10) * NEWTON_TOLERANCE else found
            z[row, column] = height
            rays[0, row, column], rays[1, row, column] = ray[0] + height * ray[2], ray[1] + height * ray[3]


@compiled("void(f4[:,::1], f4[:,::1], f4[:,:,::1], f4[:,::1], f4[:,:,::1])")
def pass_by(u: Field, v: Field, path: Field, times: Field, moved: Field) -> None:
    """Into moved (4, H, W): the places u, v (H, W) less the path (H, W, 2) times a sample's time, then plus it.

    times: (2, 2) of a pixel's samples.
    """
    for row in range(u.shape[0]):
        for column in range(u.shape[1]):
            time = times[row % SAMPLES_PER_PIXEL, column % SAMPLES_PER_PIXEL]
            du, dv = path[row, column, 0] * time, path[row, column, 1] * time
            moved[0, row, column], moved[1, row, column] = u[row, column] - du, v[row, column] - dv
            moved[2, row, column], moved[3, row, column] = u[row, column] + du, v[row, column] + dv


@compiled("f4(f4)", inlined=True)
def _fading(x: np.float32) -> np.float32:
    """exp(x) of x <= 0 to 1e-4 of itself, and at least exp(-16): without a call, so that it costs little."""
    y = max(x, np.float32(-16)) * np.float32(1 / 32)
    power = ONE + y * (ONE + y * (HALF + y * (np.float32(1 / 6) + y * (np.float32(1 / 24) + y * np.float32(1 / 120)))))
    power *= power
    power *= power
    power *= power
    power *= power
    return power * power


@compiled("void(f4[::1], f4[::1], f4[::1], f4[::1], f4, f4[:,::1], f4[::1])", reordered=True)
def shade(
    colours: Field, reliefs: Field, mirrors: Field, passed: Field, looks: float, lamps: Field, room: Field
) -> None:
    """Turn the colours of N samples into the light they send, (4 N,), BGR times opacity and opacity.

    colours, reliefs: (4 N,) sums of textures, of as many `looks`. mirrors: (4 N,) slopes that mirror each lamp. passed:
    (4 N,) share of each lamp's light that arrives, in the first two. lamps: (2, 10) direction, strength BGR, and factor
    of the exponent and strength of the wet and the dry lobe. room: (7,) light BGR and as the film mirrors it, and how
    far light creeps into the shade, BGR.
    """
    part = ONE / np.float32(looks)
    x0, y0, z0, b0, g0, r0 = lamps[0, 0], lamps[0, 1], lamps[0, 2], lamps[0, 3], lamps[0, 4], lamps[0, 5]
    wet_e0, wet_s0, dry_e0, dry_s0 = lamps[0, 6], lamps[0, 7], lamps[0, 8], lamps[0, 9]
    x1, y1, z1, b1, g1, r1 = lamps[1, 0], lamps[1, 1], lamps[1, 2], lamps[1, 3], lamps[1, 4], lamps[1, 5]
    wet_e1, wet_s1, dry_e1, dry_s1 = lamps[1, 6], lamps[1, 7], lamps[1, 8], lamps[1, 9]
    room_b, room_g, room_r, mirrored = room[0], room[1], room[2], room[3]
    creep_b, creep_g, creep_r = room[4], room[5], room[6]
    for k in range(len(colours) // 4):
        across, along = reliefs[4 * k] * part, reliefs[4 * k + 1] * part
        gloss, sky = reliefs[4 * k + 2] * part, reliefs[4 * k + 3] * part
        facing = ONE / np.sqrt(across * across + along * along + ONE)
        open_room = sky * (np.float32(0.45) + np.float32(0.55) * facing)
        wet, dry = gloss * gloss, np.float32(0.3) + gloss
        arrive0, arrive1 = sky * passed[4 * k], sky * passed[4 * k + 1]
        cosine0, cosine1 = (z0 - x0 * across - y0 * along) * facing, (z1 - x1 * across - y1 * along) * facing
        u0, v0 = across - mirrors[4 * k], along - mirrors[4 * k + 1]
        u1, v1 = across - mirrors[4 * k + 2], along - mirrors[4 * k + 3]
        square0, square1 = u0 * u0 + v0 * v0, u1 * u1 + v1 * v1
        film0 = _fading(square0 * wet_e0) * wet_s0 * wet + _fading(square0 * dry_e0) * dry_s0 * dry
        film1 = _fading(square1 * wet_e1) * wet_s1 * wet + _fading(square1 * dry_e1) * dry_s1 * dry
        glint = np.float32(0.06) * wet * open_room * mirrored + arrive0 * film0 + arrive1 * film1
        glint *= colours[4 * k + 3] * part
        light_b = open_room * room_b + max(cosine0 + creep_b, NOTHING) * arrive0 * b0
        light_g = open_room * room_g + max(cosine0 + creep_g, NOTHING) * arrive0 * g0
        light_r = open_room * room_r + max(cosine0 + creep_r, NOTHING) * arrive0 * r0
        light_b += max(cosine1 + creep_b, NOTHING) * arrive1 * b1
        light_g += max(cosine1 + creep_g, NOTHING) * arrive1 * g1
        light_r += max(cosine1 + creep_r, NOTHING) * arrive1 * r1
        colours[4 * k] = colours[4 * k] * part * light_b + glint
        colours[4 * k + 1] = colours[4 * k + 1] * part * light_g + glint
        colours[4 * k + 2] = colours[4 * k + 2] * part * light_r + glint
        colours[4 * k + 3] = colours[4 * k + 3] * part


@compiled("void(f4[:,:,::1], f4[:,::1], f4, f4[:,:,::1], f4[:,::1])")
def note_depth(rays: Field, z: Field, lens: float, light: Field, depth: Field) -> None:
    """Depth (H, W) mm along the optical axis, inf where the light (H, W, 4) is opaque by less than half.

    lens: mm, its height.
    """
    for row in range(z.shape[0]):
        for column in range(z.shape[1]):
            opaque = light[row, column, 3] > HALF
            depth[row, column] = (z[row, column] - lens) * rays[6, row, column] if opaque else np.float32(np.inf)


@compiled("void(f4[:,:,::1], f4[:,:,::1], i8, i8)")
def blend_over(light: Field, layer: Field, top: int, left: int) -> None:
    """Lay a layer (h, w, 4), BGR times opacity and opacity, over light (H, W, 3), its corner at row and column."""
    for row in range(min(layer.shape[0], light.shape[0] - top)):
        for column in range(min(layer.shape[1], light.shape[1] - left)):
            below, above = light[top + row, left + column], layer[row, column]
            passed = ONE - above[3]
            for c in range(3):
                below[c] = below[c] * passed + above[c]
