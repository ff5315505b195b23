"""A line scene of pylimap, run by .venv-peers: a JSON request on standard input, a JSON result on the last line of its output.

The request: `images`, a folder of perspective photos; `model`, a COLMAP model of them with poses; `names`, the photos to use;
`segments`: "grey" (OpenCV's LSD on the grey photo) or "colour" (LSD on each channel, less what a longer one covers);
`neighbours`, how many photos each is matched with (null: all); `adjust`, whether pylimap's own adjustment of the lines follows,
poses and cameras held.

pylimap's own detectors and point features need downloads of weights; LSD, which it offers too, needs none. Lines are matched
exhaustively, each with every line of its neighbours, which is its mode without descriptors. Neighbours are the photos that see
most of the same space (its own choice counts shared points): a grid of rays to several depths is projected into the others.

The result: `ends_m` (n 2 3), `observations`, for each line a list of (photo, u1, v1, u2, v2), and `seconds` per stage.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from limap.estimators import bundle_adjustment
from limap.geometry import Line2d
from limap.scene import HolisticReconstruction, Structure2d, StructureCorrespondenceGraph
from limap.sfm import GlobalLineTriangulationOptions, global_line_triangulation

COLMAP_SHIFT_PX = 0.5
COVERED_PX = 1.5
"""A segment of one channel is dropped where both its ends lie that near a longer one of another."""
RAYS, DEPTHS = 9, (0.3, 0.6, 1.2, 2.4)
"""Rays across a photo, and depths as shares of the extent of the cameras."""


def lsd(grey: np.ndarray) -> np.ndarray:
    found = cv2.createLineSegmentDetector().detect(grey)[0]
    return np.zeros((0, 4)) if found is None else found.reshape(-1, 4).astype(np.float64)


def uncovered(segments: np.ndarray) -> np.ndarray:
    """The segments less those that lie along a longer one, longest first."""
    first, second = segments[:, :2], segments[:, 2:]
    length = np.linalg.norm(second - first, axis=-1)
    order = np.argsort(-length, kind="stable")
    first, second, length = first[order], second[order], length[order]
    along = (second - first) / length[:, None]
    kept: list[int] = []
    for k in range(len(order)):
        ends = np.stack([first[k], second[k]])
        step = ends[:, None] - first[kept]
        place = (step * along[kept]).sum(-1)
        across = np.abs(step[..., 0] * along[kept, 1] - step[..., 1] * along[kept, 0])
        beside = (across < COVERED_PX) & (place > -COVERED_PX) & (place < length[kept] + COVERED_PX)
        if not beside.all(0).any():
            kept.append(k)
    return segments[order[kept]]


def detected(path: Path, how: str) -> np.ndarray:
    """(n 4) ends in pixels."""
    photo = cv2.imread(str(path))
    if how == "grey":
        return lsd(cv2.cvtColor(photo, cv2.COLOR_BGR2GRAY))
    return uncovered(np.concatenate([lsd(np.ascontiguousarray(photo[..., channel])) for channel in range(3)]))


def neighbours(model: pycolmap.Reconstruction, count: int | None) -> dict[int, list[int]]:
    """For each photo those that see most of the same space, best first."""
    keys = sorted(model.images)
    if count is None or count >= len(keys) - 1:
        return {k: [other for other in keys if other != k] for k in keys}
    centres = np.stack([model.images[k].projection_center() for k in keys])
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    rays = []
    for k in keys:
        camera = model.images[k].camera
        u, v = np.meshgrid(*(np.linspace(0, size, RAYS) for size in (camera.width, camera.height)))
        ray = np.concatenate([camera.cam_from_img(np.stack([u.ravel(), v.ravel()], -1)), np.ones((u.size, 1))], -1)
        depth = extent * np.array(DEPTHS)
        points = (ray[:, None] * depth[:, None]).reshape(-1, 3)
        rays.append(model.images[k].cam_from_world().inverse() * points)
    seen = np.zeros((len(keys), len(keys)))
    for b, k in enumerate(keys):
        camera, pose = model.images[k].camera, model.images[k].cam_from_world()
        for a, points in enumerate(rays):
            inside = pose * points
            inside = inside[inside[:, 2] > 0]
            pixel = camera.img_from_cam(inside)
            seen[a, b] = ((pixel > 0) & (pixel < [camera.width, camera.height])).all(-1).mean() * len(inside) / len(points)
    shared = np.minimum(seen, seen.T)
    np.fill_diagonal(shared, -1.0)
    return {k: [keys[b] for b in np.argsort(-shared[a], kind="stable")[:count]] for a, k in enumerate(keys)}


def adjust(whole: HolisticReconstruction) -> None:
    """Its adjustment of lines with poses and cameras fixed, default options."""
    options = bundle_adjustment.PointLineBundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.refine_rig_from_world = options.refine_sensor_from_rig = options.print_summary = False
    config = bundle_adjustment.PointLineBundleAdjustmentConfig()
    for image in whole.point_recon.images:
        config.add_image(image)
    for line in whole.structure_recon.line3D_ids():
        config.add_variable_line(line)
    bundle_adjustment.create_point_line_bundle_adjuster(options, config, whole).solve()


def reconstruct(request: dict[str, Any]) -> dict[str, Any]:
    """What pylimap makes of the photos."""
    seconds: dict[str, float] = {}
    model = chosen(pycolmap.Reconstruction(request["model"]), request["names"])
    start = time.perf_counter()
    segments = {k: detected(Path(request["images"]) / image.name, request["segments"]) for k, image in model.images.items()}
    seconds["detect"] = time.perf_counter() - start
    start = time.perf_counter()
    whole, graph = HolisticReconstruction(model), StructureCorrespondenceGraph()
    for k in sorted(segments):
        structure = Structure2d()
        structure.set_lines([Line2d(*line) for line in (segments[k] + COLMAP_SHIFT_PX).reshape(-1, 2, 2)])
        whole.structure_recon.add_structure2d(k, structure)
        graph.line_graph.add_image(k, len(segments[k]))
    graph.line_graph.finalize()
    options = GlobalLineTriangulationOptions()
    whole.structure_recon.initialize_all_wireframes(options.wireframe2d_th)
    global_line_triangulation(options, whole, graph.line_graph, neighbours(model, request["neighbours"]))
    seconds["triangulate"] = time.perf_counter() - start
    if request["adjust"]:
        start = time.perf_counter()
        adjust(whole)
        seconds["adjust"] = time.perf_counter() - start
    names = {k: image.name for k, image in model.images.items()}
    lines = list(whole.structure_recon.lines3D.values())
    return {
        "ends_m": [line.as_array().tolist() for line in lines],
        "observations": [
            [[names[part.image_id], *segments[part.image_id][part.point2D_idx].tolist()] for part in line.track.elements]
            for line in lines
        ],
        "segments": sum(map(len, segments.values())),
        "seconds": seconds,
    }


def chosen(model: pycolmap.Reconstruction, names: list[str]) -> pycolmap.Reconstruction:
    """A model of some of the photos."""
    wanted, part = set(names), pycolmap.Reconstruction()
    for camera in model.cameras.values():
        part.add_camera_with_trivial_rig(camera)
    for k, image in sorted(model.images.items()):
        if image.name in wanted:
            copy = pycolmap.Image(name=image.name, image_id=k, camera_id=image.camera_id)
            part.add_image_with_trivial_frame(copy, image.cam_from_world())
    return part


if __name__ == "__main__":
    print(json.dumps(reconstruct(json.load(sys.stdin))))
