"""Times of pycolmap, run by .venv-peers: one JSON object of seconds on standard output."""

import json
import sys
import time
from collections.abc import Callable

import numpy as np
import pycolmap


def best_of(repeats: int, work: Callable[[], object]) -> float:
    """Least wall-clock seconds of one call."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def adjustment_seconds(observations: int, images: int, iterations: int) -> float:
    """Seconds of a bundle adjustment of points with fixed intrinsics, after `iterations` steps of Ceres."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, images, observations // images
    options.num_points2D_without_point3D = 0
    scene = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev, noise.point3D_stddev = 0.5, 0.01
    pycolmap.synthesize_noise(noise, scene)
    solver = pycolmap.BundleAdjustmentOptions()
    solver.print_summary = solver.refine_focal_length = solver.refine_extra_params = False
    solver.ceres.solver_options.max_num_iterations = iterations
    solver.ceres.solver_options.gradient_tolerance = 0.0
    solver.ceres.solver_options.num_threads = 1
    start = time.perf_counter()
    pycolmap.bundle_adjustment(scene, solver)
    return time.perf_counter() - start


def main() -> None:
    """Arguments: number of points, observations, images."""
    points, observations, images = map(int, sys.argv[1:])
    rays = np.random.default_rng(0).normal(size=(points, 3))
    rays[:, 2] = np.abs(rays[:, 2]) + 0.3
    camera = pycolmap.Camera(
        model="OPENCV_FISHEYE", width=1280, height=960, params=[400.0, 400.0, 640.0, 480.0, 0.01, -0.002, 0.0005, 0.0]
    )
    pixels = camera.img_from_cam(rays)
    few, many = (min(adjustment_seconds(observations, images, k) for _ in range(3)) for k in (1, 5))
    result = {
        "project": best_of(5, lambda: camera.img_from_cam(rays)),
        "unproject": best_of(5, lambda: camera.cam_from_img(pixels)),
        "iteration": (many - few) / 4,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
