"""Cameras with finite, wild parameters, through what reads photos with them. For a process of its own, since it might end it:

python tests/wild_cameras.py SEED COUNT
"""

import random
import sys
import time
import warnings
from collections.abc import Iterator

import cv2
import numpy as np
import torch

from calib_patterns import Detection, DetectionOptions, pattern
from camera_models import MODELS, CameraModel, GeometryError, InputError, OpenCVFisheye, Pinhole, model_class
from omnilines.extraction import extract_arcs
from omnilines.pipelines.camera_search import searched
from omnilines.pipelines.rectify import rectify

SIZE = (320, 240)
SPEC = "checkerboard:5x4:30mm"
SIZES = (0.0, 1e-300, 1e-30, 1e-9, 1e-3, 1.0, 10.0, 1e3, 1e6, 1e10, 1e30, 1e50, 1e150, 1e300)
TIME_S = 60.0
"""Of the processor, for one camera."""
LENS = (160.0, 160.0, 160.0, 120.0)
KNOWN = (
    Pinhole([*LENS, 0.0, -0.05, 0.02, 0.0, 0.0, 0.0, -1000.0, 0.0, 0.0], SIZE),
    Pinhole([*LENS, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1e6, 0.0, 0.6], SIZE),
    OpenCVFisheye([*LENS, 1e50, 0.0, 0.0, 0.0], SIZE),
)
"""That once ended the process, or took 4 GB and a minute."""


def photo() -> np.ndarray:
    """Bright strips in noise."""
    rng = np.random.default_rng(0)
    image = np.full(SIZE[::-1], 40, np.uint8)
    for grey, width in zip(rng.integers(60, 255, 25), rng.integers(1, 9, 25), strict=True):
        (u1, u2), (v1, v2) = rng.integers(0, SIZE[0], 2).tolist(), rng.integers(0, SIZE[1], 2).tolist()
        cv2.line(image, (u1, v1), (u2, v2), int(grey), int(width), cv2.LINE_AA)
    return (cv2.GaussianBlur(image, (0, 0), 0.6) + rng.normal(0.0, 1.5, image.shape)).clip(0, 255).astype(np.uint8)


def wild(seed: int, count: int) -> Iterator[CameraModel]:
    """Examples of all models with one to three parameters changed."""
    chance = random.Random(seed)
    names = [name for name, _ in MODELS if model_class(name).CALIBRATED]
    for _ in range(count):
        example = chance.choice(list(model_class(chance.choice(names)).examples()))
        scale = SIZE[0] / example.image_size[0]
        values = {k: v * (scale if k in ("fx", "fy", "cx", "cy", "a0") else 1.0) for k, v in example.named_parameters().items()}
        for key in chance.sample(list(values), chance.randint(1, 3)):
            sign = chance.choice((-1.0, 1.0))
            values[key] = sign * (chance.choice(SIZES) if chance.random() < 0.6 else values[key] * 10 ** chance.uniform(-6, 6))
        try:
            yield type(example)(list(values.values()), SIZE)
        except InputError:
            continue


def look(model: CameraModel, image: np.ndarray) -> None:
    """Assert that what is found is finite, or refused."""
    try:
        found = extract_arcs(image, model)
        for array in (found.endpoints_px, found.covariance_px2, found.length_px):
            assert np.isfinite(array).all(), model
    except (InputError, GeometryError):
        pass
    board = pattern(SPEC)
    found = searched(image, board, model, Detection.empty(), mirrored=False, options=DetectionOptions())
    assert np.isfinite(found.pixels).all(), model
    for view in ("perspective", "panorama"):
        try:
            for _, pixels in rectify({"a.png": image}, model, view, size=(64, 48)).pixels():
                assert pixels.shape == (48, 64)
        except (InputError, GeometryError):
            pass


def main(seed: int, count: int) -> None:
    """Look with all of them; the one at work is named before, so that it is known if the process ends."""
    warnings.simplefilter("error")
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    image = photo()
    for model in (*KNOWN, *wild(seed, count)):
        print(model, flush=True)
        begun = time.process_time()
        look(model, image)
        assert time.process_time() - begun < TIME_S, model
    print("done", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
