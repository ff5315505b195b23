"""lensfun itself, by lensfunpy in an environment of its own, sees what we see through the files that we write."""

import functools
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from pylimap_scenes import PEERS

from camera_models import Calibration, CameraModel, OpenCVFisheye, Pinhole
from camera_models.formats import write

PEER = Path(__file__).parent / "bench" / "peer_lensfun.py"
STEP = 20
PIXEL = 0.02
"""lensfun counts in single precision."""


@functools.cache
def why_absent() -> str | None:
    if not PEERS.is_file():
        return f"lensfunpy is compared in an environment of its own, which is absent: {PEERS}; `make bench` installs it"
    found = subprocess.run([PEERS, "-c", "import lensfunpy"], capture_output=True, text=True)
    return f"lensfunpy cannot be imported by {PEERS}" if found.returncode else None


@pytest.mark.parametrize(
    "model",
    [
        OpenCVFisheye([400.0, 400.0, 652.3, 470.1, -0.02, 0.003, 0.0, 0.0], (1280, 960)),
        Pinhole([900.0, 900.0, 652.3, 470.1, 0.0, -0.12, 0.03, *([0.0] * 6)], (1280, 960)),
        Pinhole([900.0, 900.0, 452.3, 670.1, *([0.0] * 9)], (960, 1280)),
    ],
    ids=["fisheye", "pinhole", "portrait"],
)
def test_lensfun_sees_what_we_see(model: CameraModel, tmp_path: Path) -> None:
    reason = why_absent()
    if reason is not None:
        pytest.skip(reason)
    path = tmp_path / "lensfun.xml"
    write(path, Calibration({"cam0": model}))
    width, height = model.image_size
    done = subprocess.run([PEERS, PEER, path, str(width), str(height), str(STEP)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["type"] == ("FISHEYE" if isinstance(model, OpenCVFisheye) else "RECTILINEAR")
    named = model.named_parameters()
    rows, columns = np.mgrid[0:height:STEP, 0:width:STEP]
    longitude, latitude = (columns - named["cx"]) / named["fx"], (rows - named["cy"]) / named["fx"]
    level = np.cos(latitude)
    rays = np.stack([level * np.sin(longitude), np.sin(latitude), level * np.cos(longitude)], -1)
    pixels, valid = model.project(rays)
    theirs = np.array(told["pixels"])
    use = np.asarray(valid) & (theirs >= 0).all(-1) & (theirs <= [width - 1, height - 1]).all(-1)
    assert use.mean() > 0.5
    np.testing.assert_allclose(np.asarray(pixels)[use], theirs[use], atol=PIXEL)
