"""Where the wound is in a scan: by its colours, which the wound network sees, or by a person, whom a page asks."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimation import se3
from estimation.errors import InputError
from estimation.scans.scan import Scan
from estimation.se3 import Array
from hardware.report.evaluation import percent
from hardware.report.page import data_url, document, section
from planning.layers.grid import HeightMap, axes_along, height_map
from planning.layers.outline import ScanColour, WoundPlace, WoundQuestionError, points_on
from planning.layers.repair import mean_normal

Colours = NDArray[np.uint8]
PIXEL = 0.4  # mm of the scan's picture: a wound of 10 mm is 25 px wide, which the network still sees
LIGHT = (-0.5, 0.6, 0.62)  # from the upper left, as maps are shaded
GREY, CONTRAST = 90.0, 150.0  # of 255, of a surface across the light and along it
ZOOM_MARGIN = 0.6  # of a place's size, left around it in its own picture
CLICK_NODES = 160  # along the longer side, of the heights that clicks are laid on
CLICK_SCRIPT = """<script>(function () {
  const view = document.getElementById("scan-view"), words = document.getElementById("scan-clicks");
  const data = JSON.parse(document.getElementById("scan-data").textContent), clicks = [];
  view.addEventListener("click", function (event) {
    const box = view.getBoundingClientRect();
    const u = (event.clientX - box.left) / box.width, v = 1 - (event.clientY - box.top) / box.height;
    const column = Math.min(data.columns - 1, Math.max(0, Math.round(u * (data.columns - 1))));
    const row = Math.min(data.rows - 1, Math.max(0, Math.round(v * (data.rows - 1))));
    const place = [data.low[0] + u * data.size[0], data.low[1] + v * data.size[1], data.heights[row][column], 1];
    clicks.push(data.pose.slice(0, 3).map(r => r.reduce((sum, k, i) => sum + k * place[i], 0).toFixed(1)).join(","));
    words.textContent = "--clicks=" + clicks.slice(-3).join("/");
  });
})();</script>"""


def scan_heights_from_above(scan: Scan, where: object) -> HeightMap:
    """The heights of a scan over its mean plane, a picture's pixel apart or more."""
    axes = axes_along(mean_normal(scan.vertices, scan.triangles, where), np.eye(3)[0])
    return height_map(scan, se3.make(axes, scan.vertices.mean(axis=0)), PIXEL)


def picture_of(above: HeightMap, points: Array, colours: Colours | None) -> Colours:
    """The scan (H, W, 3) BGR from above, y upwards: its colours at points (V, 3) mm, or its relief; white beside."""
    if colours is None:
        along_y, along_x = np.gradient(above.heights, above.grid.step)
        normal = np.stack([-along_x, -along_y, np.ones_like(along_x)], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        shade = np.clip(GREY + CONTRAST * (normal @ np.array(LIGHT)), 0, 255).astype(np.uint8)
        image = np.repeat(shade[..., None], 3, axis=-1)
    else:
        nodes = points_on(above, above.grid.nodes.reshape(-1, 2))
        _, nearest = cKDTree(points).query(nodes)
        image = colours[nearest][:, ::-1].reshape(*above.grid.shape, 3).copy()
    image[~above.known] = 255
    return np.ascontiguousarray(image[::-1])


def scan_colour(scan: Scan, points: Array, colours: Colours | None, where: object) -> ScanColour | None:
    """Where the wound network sees a wound in a scan with colours (V, 3) RGB at points (V, 3) mm; None if nowhere."""
    if colours is None:
        return None
    from perception.wound.network import WoundNetwork, shipped_model
    from perception.wound.segmentation import NetworkSegmenter  # loads onnxruntime

    above = scan_heights_from_above(scan, where)
    network = WoundNetwork(shipped_model(), threads=1)
    mask = NetworkSegmenter(network, network.settings)(picture_of(above, points, colours)).mask[::-1]
    if not mask.any():
        return None
    known = above.known
    return ScanColour(points_on(above, above.grid.nodes[known]), mask[known].astype(float))


def parse_clicks(text: str) -> Array:
    """Points (N, 3) mm of a text X,Y,Z/X,Y,Z/X,Y,Z with three places or more."""
    try:
        points = np.array([[float(word) for word in place.split(",")] for place in text.split("/")])
    except ValueError:
        points = np.empty((0, 0))
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 3 or not np.isfinite(points).all():
        raise InputError(
            "command line", "--clicks", text, "X,Y,Z/X,Y,Z/X,Y,Z: three places or more on the wound's rim, mm"
        )
    if np.linalg.svd(points - points.mean(axis=0))[1][1] < 1.0:
        raise InputError("command line", "--clicks", text, "places that do not lie in one line")
    return points


def write_question(
    file: Path, scan: Scan, points: Array, colours: Colours | None, question: WoundQuestionError
) -> None:
    """Write the page that asks which place is the wound."""
    above = scan_heights_from_above(scan, question.where)
    image = picture_of(above, points, colours)
    whole = _view(above, image, question.places, None, "scan-view")
    parts = [section("The scan from above", "Click three places on the wound's rim to name it by them.", whole)]
    parts[0] += f'<p><code id="scan-clicks">--clicks=...</code></p>{_click_data(above)}{CLICK_SCRIPT}'
    for number, place in enumerate(question.places, 1):
        colour = "" if np.isnan(place.colour) else f", {percent(place.colour, 0)} of it coloured like a wound"
        caption = f"{place.area:.0f} mm², {place.depth:.1f} mm deep{colour}. It is this one: --wound {number}"
        parts.append(section(f"Place {number}", caption, _view(above, image, [place], place, f"place-{number}")))
    title = "Which is the wound?"
    lead = "Nothing was planned: the wound is not clear. Say which place it is, and plan again."
    file.write_text(document("plan", title, lead, parts, str(question.where)), encoding="utf-8")


def _view(
    above: HeightMap,
    image: Colours,
    places: Sequence[WoundPlace],
    zoom: WoundPlace | None,
    name: str,
) -> str:
    """The picture with outlines, as SVG; zoom: the place that fills it."""
    from hardware.files.images import encode

    def pixels(place: WoundPlace) -> Array:
        flat = se3.transform_points(se3.inverse(above.surface_from_plane), place.outline)[:, :2]
        nodes = (flat - above.grid.origin) / above.grid.step
        return np.column_stack([nodes[:, 0], image.shape[0] - 1 - nodes[:, 1]])

    box = (0.0, 0.0, float(image.shape[1]), float(image.shape[0]))
    if zoom is not None:
        low, high = pixels(zoom).min(axis=0), pixels(zoom).max(axis=0)
        margin = ZOOM_MARGIN * float((high - low).max())
        box = (*(low - margin), *(high - low + 2 * margin))
    thick = max(box[2:]) / 250
    lines = ""
    for number, place in enumerate(places, 1):
        ring = pixels(place)
        x, y = ring.mean(axis=0)
        lines += f'<polygon points="{" ".join(f"{u:.1f},{v:.1f}" for u, v in ring)}"/>'
        lines += "" if zoom else f'<text x="{x:.0f}" y="{y:.0f}" font-size="{12 * thick:.0f}">{number}</text>'
    return (
        f'<svg id="{name}" viewBox="{" ".join(f"{v:.1f}" for v in box)}" role="img" aria-label="the scan" '
        f'style="max-width:100%;max-height:70vh"><image width="{image.shape[1]}" height="{image.shape[0]}" '
        f'href="{data_url(encode(image)[1])}"/>'
        f'<g fill="none" stroke="#d3232f" stroke-width="{thick:.2f}">{lines}</g></svg>'
    )


def _click_data(above: HeightMap) -> str:
    every = max(1, max(above.grid.shape) // CLICK_NODES)
    heights = above.heights[::every, ::every]
    size = above.grid.step * (np.array(above.grid.shape[::-1]) - 1)
    data = {
        "low": above.grid.origin.tolist(), "size": size.tolist(), "rows": heights.shape[0], "columns": heights.shape[1],
        "heights": np.round(heights, 2).tolist(), "pose": above.surface_from_plane.tolist(),
    }  # fmt: skip
    return f'<script type="application/json" id="scan-data">{json.dumps(data)}</script>'
