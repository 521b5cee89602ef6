"""Pictures of a scene by each camera at each instant, the nozzle in front."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import Camera, Rig, pixels_from_points
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.process.faults import Fault, fault_rng
from hardware.simulator.scene.appearance import Appearance, Sensor, expose
from hardware.simulator.scene.drape_picture import DRAPE_LATTICE_PX, DrapePicture, drape_picture
from hardware.simulator.scene.fields import Field, upsample
from hardware.simulator.scene.nozzle import nozzle_picture, part_boxes, whole_box
from hardware.simulator.scene.ray_kernels import blend_over
from hardware.simulator.scene.rays import ImageBox, RenderView, rays_at
from hardware.simulator.scene.scene import Scene, SceneState, WorldState, scene_state
from hardware.simulator.scene.shape import BODIES, Shape, Wound, body
from hardware.simulator.scene.surface_picture import SurfacePicture, surface_picture
from perception.boards.board import Board, ink_cells
from perception.frames import Image

Result = TypeVar("Result")


def render(
    scene: Scene,
    cameras: Sequence[Camera],
    instants: Sequence[WorldState],
    sensor: Sensor,
    rngs: Sequence[Generator],
    threads: int = 2,
) -> list[Image]:
    """Images (H, W, 3) BGR, one per camera with its instant and its noise; the same for any number of threads."""
    with ThreadPoolExecutor(threads) as pool:
        return [image.result() for image in begin_render(pool, scene, cameras, instants, sensor, rngs)]


def begin_render(
    pool: Executor,
    scene: Scene,
    cameras: Sequence[Camera],
    instants: Sequence[WorldState],
    sensor: Sensor,
    rngs: Sequence[Generator],
) -> list[Future[Image]]:
    """As `render`, without waiting. pool: begins its jobs in the order of their submission, as they wait for others."""
    states = {key: pool.submit(scene_state, scene, instant) for key, instant in {id(i): i for i in instants}.items()}
    jobs = [(states[id(i)], scene.view(c)) for c, i in zip(cameras, instants, strict=True)]
    skins = [submit_after(pool, surface_picture, *job) for job in jobs]
    cloths = [submit_after(pool, drape_picture, *job) for job in jobs]
    parts = zip(jobs, skins, cloths, rngs, strict=True)
    return [submit_after(pool, _picture, *job, *layers, sensor, rng) for job, *layers, rng in parts]


def submit_after(pool: Executor, function: Callable[..., Result], *arguments: object) -> Future[Result]:
    """Submit a call with the results of those arguments that are futures, submitted to the same pool before."""
    return pool.submit(lambda: function(*(each.result() if isinstance(each, Future) else each for each in arguments)))


class StillScene:
    """Pictures of a scene at rest with a nozzle that casts no shadow: a tenth of the work."""

    def __init__(self, scene: Scene, cameras: Sequence[Camera], still: WorldState) -> None:
        """still: without a nozzle."""
        shared = scene_state(scene, still)
        self._scene, self._shared = scene, shared
        self._views = [scene.view(camera) for camera in cameras]
        self._backgrounds = [(surface_picture(shared, view), drape_picture(shared, view)) for view in self._views]

    def __call__(self, camera: int, instant: WorldState, sensor: Sensor, rng: Generator) -> Image:
        """The image (H, W, 3) BGR of a camera by its number."""
        skin, cloth = self._backgrounds[camera]
        state, background = replace(self._shared, instant=instant), replace(cloth, light=cloth.light.copy())
        return _picture(state, self._views[camera], skin, background, sensor, rng)


def _picture(
    now: SceneState, view: RenderView, skin: SurfacePicture | None, cloth: DrapePicture, sensor: Sensor, rng: Generator
) -> Image:
    light = cloth.light
    if skin is not None:
        blend_over(light, skin.light, skin.box.y0, skin.box.x0)
    nozzle = now.instant.base_from_nozzle
    boxes = part_boxes(nozzle, view)
    if nozzle is not None and boxes:
        box, lit = whole_box(boxes), (now.scene.base_from_rest, now.lamps, now.scene.look.ambient)
        blend_over(light, nozzle_picture(nozzle, *lit, view, boxes, _depth_behind(box, skin, cloth)), box.y0, box.x0)
    return expose(light, sensor, view.fall(sensor), now.instant.gain, rng)


def _depth_behind(box: ImageBox, skin: SurfacePicture | None, cloth: DrapePicture) -> NDArray[np.float32]:
    depth = upsample(cloth.depth[box.lattice(DRAPE_LATTICE_PX)], box.sample_size)
    if skin is None or skin.depth is None:
        return depth
    overlap = ImageBox(*np.maximum(box[:2], skin.box[:2]).tolist(), *np.minimum(box[2:], skin.box[2:]).tolist())
    if min(overlap.size) > 0:
        skin_depth = skin.depth[skin.box.samples(overlap)]
        np.copyto(depth[box.samples(overlap)], skin_depth, where=np.isfinite(skin_depth))
    return depth


WOUND_EXTENT = np.array([[x, y, 0.0] for x in (-26.0, 26.0) for y in (-19.0, 19.0)])  # mm, round a usual wound
COVER_SCALE = 1.35  # size of a cover by that of the wound


def draw_cover(image: Image, box: tuple[Array, Array], aside: float, rng: np.random.Generator) -> Image:
    """A blotchy, skin-toned cover over a box (low, high px); aside: shift, as a share of its width."""
    low, high = box
    angle = rng.uniform(0, 2 * np.pi)
    half = COVER_SCALE * (high - low) / 2
    shift = np.array([np.cos(angle), np.sin(angle)]) * (half + (high - low) / 2) * min(aside, 1.0)
    middle = (low + high) / 2 + shift * 1.45  # wholly beside the box at one, whatever the angle
    if aside >= 1.0:
        return image
    h, w = image.shape
    blotches = rng.normal(150, 28, (14, 18)).astype(np.float32)
    size = tuple(np.maximum(np.round(2 * half), 8).astype(int).tolist())
    cover = cv2.resize(blotches, size, interpolation=cv2.INTER_CUBIC) + rng.normal(0, 6, size[::-1])
    corner = np.round(middle - half).astype(int)
    x0, y0 = np.clip(corner, 0, (w, h))
    x1, y1 = np.clip(corner + size, 0, (w, h))
    result = image.copy()
    part = cover[y0 - corner[1] : y1 - corner[1], x0 - corner[0] : x1 - corner[0]]  # may be empty
    result[y0:y1, x0:x1] = np.clip(part, 0, 255).astype(np.uint8)
    return result


def cover_wound(image: Image, camera: Camera, base_from_surface: Array, fault: Fault) -> Image:
    """An image (H, W, 3) of a camera with a cover over the wound; base_from_surface: (4, 4) mm then."""
    pixels, _ = pixels_from_points(camera, se3.transform_points(base_from_surface, WOUND_EXTENT))
    box = pixels.min(0), pixels.max(0)
    return np.stack([draw_cover(image[..., k], box, 0.0, fault_rng(fault)) for k in range(image.shape[2])], -1)


VIEW_TEXEL = 0.15  # mm, resolved by a camera at 350 mm; half the time of the simulator's own
MASK_SAMPLES = 4  # samples a pixel and axis of the true mask
FINER_OUTLINES = 3  # of pictures by which areas are judged: at 4 and 0.25 mm the outline is off by 1 % of a small wound
IMAGE_SIZES = ((1280, 720), (640, 480), (768, 576))  # px


@dataclass(frozen=True, slots=True, eq=False)
class WoundView:
    """One picture with its ground truth."""

    image: Image  # (H, W, 3) BGR
    wound: NDArray[np.bool_]  # (H, W), all False where the skin is healthy
    camera: Camera
    base_from_surface: Array  # (4, 4) mm
    area: float  # mm^2 of the wound on the surface


@dataclass(frozen=True, slots=True, eq=False)
class WoundSet:
    """Pictures of one wound by the cameras of a rig at one instant, with their ground truth."""

    images: tuple[Image, ...]  # (H, W, 3) BGR, by camera
    wounds: tuple[NDArray[np.bool_], ...]  # (H, W), by camera
    rig: Rig
    base_from_surface: Array  # (4, 4) mm
    area: float  # mm^2 of the skin inside the wound's edge, as without the wound


def wound_view(seed: int, wounded: bool = True) -> WoundView:
    """The picture of a seed: random body, wound, tone, wetness, drape, lamps and camera."""
    rng = np.random.default_rng([seed, 41])
    scene, _ = _random_scene(rng, seed, wounded)
    size = IMAGE_SIZES[rng.integers(len(IMAGE_SIZES))]
    focal = size[0] * rng.uniform(0.7, 1.1)
    camera = arc_rig((rng.uniform(0, 75),), rng.uniform(220, 480), focal, size).cameras[0]
    image, pose = _random_pictures(rng, scene, Rig((camera,)))
    inside, area = scene.shape.inside, 0.0
    if inside is not None:
        area = float((inside > 0).sum()) * scene.shape.step**2
    return WoundView(image[0], _true_mask(scene.shape, camera, pose), camera, pose, area)


def wound_set(seed: int) -> WoundSet:
    """The pictures of a seed by the thesis's three cameras: random as in `wound_view`, and their distance."""
    rng = np.random.default_rng([seed, 43])
    scene, bare = _random_scene(rng, seed, True)
    size = IMAGE_SIZES[rng.integers(len(IMAGE_SIZES))]
    rig = arc_rig(distance=rng.uniform(260, 480), focal=size[0] * rng.uniform(0.7, 1.1), size=size)
    images, pose = _random_pictures(rng, scene, rig)
    inside, step = scene.shape.inside, scene.shape.step
    assert inside is not None
    along, across = np.gradient(bare.heights, step)
    area = float(np.sqrt(1 + along**2 + across**2)[inside > 0].sum()) * step**2
    wounds = tuple(_true_mask(scene.shape, camera, pose, FINER_OUTLINES) for camera in rig.cameras)
    return WoundSet(tuple(images), wounds, rig, pose, area)


def _random_scene(rng: np.random.Generator, seed: int, wounded: bool) -> tuple[Scene, Shape]:
    """A scene, and the shape of its skin without the wound."""
    wound = Wound((rng.uniform(12, 60), rng.uniform(10, 40)), rng.uniform(0.5, 4.0)) if wounded else None
    kind = rng.choice(list(BODIES))
    return Scene(body(kind, wound, seed), _random_appearance(rng), seed=seed), body(kind, None, seed)


def _random_pictures(rng: np.random.Generator, scene: Scene, rig: Rig) -> tuple[list[Image], Array]:
    """A picture (H, W, 3) BGR of each camera, and base_from_surface (4, 4)."""
    pose = BASE_FROM_REST @ se3.make(se3.exp_rotation(rng.normal(0, [0.15, 0.15, 1.5])), rng.normal(0, [12, 12, 6]))
    instant = WorldState(0.0, 0.004, pose, np.zeros(6), gain=float(np.exp(rng.normal(0, 0.15))))
    sensor = Sensor(noise=rng.uniform(0.5, 4), blur=rng.uniform(0.3, 1.2))
    rngs = [rng] if len(rig) == 1 else rng.spawn(len(rig))
    return render(scene, rig.cameras, [instant] * len(rig), sensor, rngs, threads=1), pose


def _true_mask(shape: Shape, camera: Camera, base_from_surface: Array, finer: int = 1) -> NDArray[np.bool_]:
    """(H, W) pixels of the wound in a camera; all False without one.

    finer: refinement of the outline; by 1 it runs through the outermost nodes, half a node too far in.
    """
    outlines = []
    if shape.inside is not None:
        inside = cv2.resize(shape.inside, None, fx=finer, fy=finer, interpolation=cv2.INTER_LINEAR)
        contours, _ = cv2.findContours((inside > 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        middle = (np.array(shape.inside.shape[::-1]) - 1) / 2
        for contour in contours:
            nodes = (contour.reshape(-1, 2) + 0.5) / finer - 0.5
            points = shape.points((nodes - middle) * shape.step)
            outlines.append(pixels_from_points(camera, se3.transform_points(base_from_surface, points))[0])
    return mask_from_outlines(outlines, camera.size, finer * MASK_SAMPLES)


def mask_from_outlines(
    outlines: Sequence[Array], size: tuple[int, int], samples: int = MASK_SAMPLES
) -> NDArray[np.bool_]:
    """(H, W) pixels more than half inside closed outlines (N, 2) px, in an image of `size` (W, H).

    Drawn finer, by `samples` a pixel and axis, and shrunk: OpenCV fills the outline's own pixels too, which would add
    half a pixel all round.
    """
    fine = np.zeros((size[1] * samples, size[0] * samples), np.uint8)
    for outline in outlines:
        cv2.fillPoly(fine, [np.round((outline + 0.5) * samples - 0.5).astype(np.int32)], 255)
    return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA) > 127)


def _random_appearance(rng: np.random.Generator) -> Appearance:
    ambient, key, fill = rng.uniform(0.2, 0.5), rng.uniform(0.35, 0.8), rng.uniform(0.05, 0.4)
    tone, wetness, hair = rng.uniform(0, 0.9), rng.uniform(0.1, 1), rng.uniform(0, 1.2)
    drape = bool(rng.random() < 0.6)
    return Appearance(VIEW_TEXEL, tone, wetness, hair, drape, ambient=ambient, key=key, fill=fill)


BOARD_SAMPLES = 3  # per pixel and axis: edges lie true to a hundredth of a pixel
PAPER_MARGIN = 0.5  # of a square, white around the print
PAPER_GREY, INK_GREY, WALL_GREY = 205.0, 38.0, 120.0  # grey levels of paper, ink and background
DRAWING_SCALE = 8  # parts of a cell along its edge; light between two is interpolated, so that edges do not step
BOX_MARGIN_PX = 12  # px around the board that are drawn


class BoardView:
    """One camera before one board."""

    def __init__(self, camera: Camera, board: Board) -> None:
        self.camera, self._board = camera, board
        ink, cell = ink_cells(board)
        rim = round(PAPER_MARGIN * board.square / cell * DRAWING_SCALE)
        drawing = np.kron(np.where(ink, INK_GREY, PAPER_GREY), np.ones((DRAWING_SCALE, DRAWING_SCALE)))
        paper = INK_GREY if board.inverted else PAPER_GREY
        self._drawing = np.pad(drawing, rim, constant_values=paper).astype(np.float32)
        scale, shift = DRAWING_SCALE / cell, rim - 0.5  # cells' middles are whole numbers
        self._drawing_from_board = np.array([[scale, 0.0, shift], [0.0, scale, shift], [0.0, 0.0, 1.0]])

    def picture(self, base_from_board: Array, blur: float, noise: float, rng: np.random.Generator) -> Image:
        """The image (H, W) grey of the board at a pose (4, 4); blur: px, noise: grey levels, one sigma each."""
        w, h = self.camera.size
        light = np.full((h, w), WALL_GREY, np.float32)
        box = self._box(base_from_board)
        if box is not None:
            x0, y0, x1, y1 = box
            light[y0:y1, x0:x1] = self._patch(base_from_board, box)
        if blur:
            light = np.asarray(cv2.GaussianBlur(light, (0, 0), blur), np.float32)
        grain = rng.standard_normal((h, w), np.float32)
        return np.clip(np.round(light + noise * grain), 0, 255).astype(np.uint8)

    def _box(self, base_from_board: Array) -> tuple[int, int, int, int] | None:
        rim = PAPER_MARGIN * self._board.square
        w, h = self._board.size
        x, y = np.meshgrid(np.linspace(-rim, w + rim, 5), np.linspace(-rim, h + rim, 5))
        outline = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
        pixels, depth = pixels_from_points(self.camera, se3.transform_points(base_from_board, outline))
        if (depth < 1).any():
            return None
        low = np.maximum(np.floor(pixels.min(0)).astype(int) - BOX_MARGIN_PX // 2, 0)
        high = np.minimum(np.ceil(pixels.max(0)).astype(int) + BOX_MARGIN_PX // 2, self.camera.size)
        return (int(low[0]), int(low[1]), int(high[0]), int(high[1])) if (high > low).all() else None

    def _patch(self, base_from_board: Array, box: tuple[int, int, int, int]) -> Field:
        x0, y0, x1, y1 = box
        x, y = ((np.arange((b - a) * BOARD_SAMPLES) + 0.5) / BOARD_SAMPLES - 0.5 + a for a, b in ((x0, x1), (y0, y1)))
        u, v = rays_at(self.camera, x, y)
        camera_from_board = se3.inverse(self.camera.base_from_camera) @ base_from_board
        drawing_from_ray = self._drawing_from_board @ np.linalg.inv(camera_from_board[:3, [0, 1, 3]])
        across, down, depth = (a * u + b * v + c for a, b, c in drawing_from_ray.astype(np.float32))
        light = cv2.remap(self._drawing, across / depth, down / depth, cv2.INTER_LINEAR, borderValue=WALL_GREY)
        return np.asarray(cv2.resize(light, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA), np.float32)
