"""Adjustments of pylimap (lines) and pycolmap (points), run by .venv-peers: times and memory as JSON on standard output.

Arguments: a street saved by `engine_scene.py`; `poses` (lines and poses), `lines` (lines only) or `points`; number of threads;
most iterations of the last run, which is to converge.
Seconds are wall-clock and of the processor, of building the problem, of one iteration and of all up to convergence; memory is the
peak of the process, in MB.
"""

import json
import re
import resource
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pycolmap

FEW, MANY = 2, 5
"""Iterations whose difference gives the time of one."""


def reconstruction(street: Any) -> pycolmap.Reconstruction:
    """Camera and images."""
    scene = pycolmap.Reconstruction()
    width, height = (int(v) for v in street["size"])
    focal = float(street["focal_px"])
    params = [focal, focal, (width - 1) / 2, (height - 1) / 2]
    scene.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, model="PINHOLE", width=width, height=height, params=params))
    for k, (rotation, translation) in enumerate(zip(street["rotation"], street["translation"], strict=True), start=1):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
        scene.add_image_with_trivial_frame(pycolmap.Image(name=str(k), image_id=k, camera_id=1), pose)
    return scene


def with_lines(street: Any) -> Any:
    """The disturbed lines with all their observations."""
    from limap.geometry import Line2d, Line3d
    from limap.scene import HolisticReconstruction, Structure2d

    whole = HolisticReconstruction(reconstruction(street))
    image, track, ends = street["image"], street["track"], street["ends_px"]
    number = np.empty(len(image), dtype=np.int64)
    for k in range(len(street["rotation"])):
        own = np.flatnonzero(image == k)
        number[own] = np.arange(len(own))
        structure = Structure2d()
        structure.set_lines([Line2d(*ends[row]) for row in own])
        whole.structure_recon.add_structure2d(k + 1, structure)
    for t, (first, second) in enumerate(street["ends_m"]):
        whole.structure_recon.add_line3D(t, Line3d(first, second))
    for k, t, n in zip(image.tolist(), track.tolist(), number.tolist(), strict=True):
        whole.structure_recon.add_line_observation(t, pycolmap.TrackElement(k + 1, n))
    return whole


def with_points(street: Any) -> pycolmap.Reconstruction:
    """The first ends of the disturbed lines as points."""
    scene = reconstruction(street)
    image, track, pixels = street["image"], street["track"], street["ends_px"][:, 0]
    place = np.empty(len(image), dtype=np.int64)
    for k in range(len(street["rotation"])):
        own = np.flatnonzero(image == k)
        place[own] = np.arange(len(own))
        scene.images[k + 1].points2D = pycolmap.Point2DList([pycolmap.Point2D(pixels[row]) for row in own])
    order = np.argsort(track, kind="stable")
    bounds = np.searchsorted(track[order], np.arange(len(street["ends_m"]) + 1))
    for t, (first, _) in enumerate(street["ends_m"]):
        rows = order[bounds[t] : bounds[t + 1]].tolist()
        elements = [pycolmap.TrackElement(int(image[r]) + 1, int(place[r])) for r in rows]
        scene.add_point3D(first, pycolmap.Track(elements))
    return scene


def adjuster(street: Any, what: str, threads: int, steps: int) -> Any:
    """A problem of plain least squares, ready to be solved."""
    if what == "points":
        options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
        whole = points = with_points(street)
    else:
        from limap.estimators import bundle_adjustment as line_adjustment

        options, config = (
            line_adjustment.PointLineBundleAdjustmentOptions(),
            line_adjustment.PointLineBundleAdjustmentConfig(),
        )
        whole = with_lines(street)
        points = whole.point_recon
        options.line_weight_normalization_length = 0.0
        options.loss_function_type_line = type(options.loss_function_type_line).TRIVIAL
        for line in whole.structure_recon.line3D_ids():
            config.add_variable_line(line)
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.refine_sensor_from_rig = options.print_summary = False
    options.refine_rig_from_world = what != "lines"
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations = threads, steps
    options.ceres.min_num_residuals_for_cpu_multi_threading = 0
    for image in points.images:
        config.add_image(image)
    if what != "lines":
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    if what == "points":
        return timed(lambda: pycolmap.create_default_bundle_adjuster(options, config, whole)), whole
    return timed(lambda: line_adjustment.create_point_line_bundle_adjuster(options, config, whole)), whole


def timed(work: Callable[[], Any]) -> tuple[float, float, Any]:
    """Wall-clock and processor seconds of a call, and what it returned."""
    start, own = time.perf_counter(), time.process_time()
    result = work()
    return time.perf_counter() - start, time.process_time() - own, result


def main() -> None:
    """See the head of the file."""
    with np.load(sys.argv[1]) as arrays:
        street = dict(arrays)
    what, threads, most = sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    seconds = {}
    for steps in sorted({FEW, MANY, most}):
        (wall, own, problem), whole = adjuster(street, what, threads, steps)
        build = (wall, own)
        wall, own, summary = timed(problem.solve)
        seconds[steps] = (wall, own)
        report = summary.brief_report()
        del problem, whole
    found = re.search(r"Iterations: (\d+), Initial cost: (\S+), Final cost: (\S+), Termination: (\S+)", report)
    assert found is not None, report
    few, many = np.array(seconds[FEW]), np.array(seconds[MANY])
    result = {
        "build": build,
        "iteration": ((many - few) / (MANY - FEW)).tolist(),
        "all": seconds[most],
        "iterations": int(found[1]),
        "start": found[2],
        "end": found[3],
        "outcome": found[4],
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
