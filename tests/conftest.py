"""Shapes and types of every signature are enforced while testing (jaxtyping with beartype)."""

import gc
import os
import pathlib
import re
import shutil
import signal
from collections.abc import Generator

# The workers of pytest-xdist share the cores: more threads than one each wait for each other, busily, and small systems of
# equations take ten times as long. NumPy's linear algebra reads this when it is loaded: in the workers, which inherit it, and in
# commands that tests start. A run without workers has loaded NumPy before this line (a plugin does) and keeps its threads.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import pytest
import torch
from enforced import enforce

enforce(["camera_models", "calib_patterns", "omnilines"])

torch.set_num_threads(1)
cv2.setNumThreads(1)

# A shell starts what it runs in the background with Ctrl-C ignored, which commands that tests start would inherit.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

DATA = pathlib.Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported while tests are collected stays: a million objects, which are not searched for garbage then nor later."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


KERNELS = re.compile(r"test_\w*kernels|test_extraction_curves|test_api")
FEW_KERNELS = re.compile(r"test_(calibration|formats|fuzz|model|native|options|report|rig)")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What compiles comes first, and what compiles little where the second of two workers begins: in a fresh clone both would
    compile the same kernels at the same time otherwise."""
    first = [item for item in items if KERNELS.match(item.path.name)]
    middle = [item for item in items if FEW_KERNELS.match(item.path.name)]
    others = [item for item in items if not KERNELS.match(item.path.name) and not FEW_KERNELS.match(item.path.name)]
    before = max(0, len(items) // 2 - len(first))
    items[:] = [*first, *others[:before], *middle, *others[before:]]


@pytest.fixture(scope="session")
def shared_data() -> pathlib.Path:
    """The folder of real photos and corners; tests that need it skip where it is absent, but never in CI."""
    if not DATA.is_dir():
        if os.environ.get("CI"):
            pytest.fail(f"CI must have the shared data beside the project, at {DATA}; it is absent.")
        pytest.skip("the folder ../shared/data with real photos is absent")
    return DATA


@pytest.fixture(scope="session")
def chromium() -> str:
    """Path of Debian's Chromium; where it is absent these tests skip, but never in CI."""
    path = shutil.which("chromium") or "/usr/bin/chromium"
    if not pathlib.Path(path).exists():
        if os.environ.get("CI"):
            pytest.fail("CI must have Debian's chromium (apt-get install chromium); it is absent.")
        pytest.skip("Debian's chromium is absent; install it to test the report in a browser")
    return path
