"""omnilines doctor: what is installed, what the process may use, and whether a rendered camera and room come out right."""

import importlib.metadata
import os
import platform
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import torch

from omnilines.commands.result import CommandResult
from omnilines.compiled_cache import VARIABLE
from omnilines.machine import available_bytes, cores
from omnilines.pipelines.render import RenderOptions, render
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Check, Summary
from omnilines.studies.validate import validate

ABSENT = "absent"
OPENCV = "opencv-contrib-python-headless"
RIVALS = ("opencv-python", "opencv-python-headless", "opencv-contrib-python")
"""They install their files over those of OPENCV."""
TARGET, ROOM = "checkerboard:8x6:30mm", "plain-room"


def doctor(*, check: bool = True, progress: ProgressCallback = silent) -> CommandResult:
    """Tables of the installation and, with `check`, the checks of `validate` on a small target and a small room."""
    packages, extras = _packages()
    machine = _machine()
    checks = _self_check(progress) if check else ()
    summaries = [
        Summary("Installed", tuple(packages.items())),
        Summary("Extras", tuple(extras.items())),
        Summary("Machine", tuple((name, str(value)) for name, value in machine.items())),
    ]
    data = {"packages": packages, "extras": extras, "machine": machine}
    return CommandResult(tuple(summaries), data, checks, warnings=_troubles(packages))


def _troubles(packages: dict[str, str]) -> tuple[str, ...]:
    """What is wrong with the installation, one sentence each."""
    wanting = [name for name, found in packages.items() if found == ABSENT]
    told = [f"not installed: {', '.join(wanting)}; run `pip install omnilines` again."] if wanting else []
    rivals = [name for name in RIVALS if _version(name) != ABSENT]
    if rivals:
        told.append(
            f"{' and '.join(rivals)} lies over {OPENCV}, which is needed; run `pip uninstall {' '.join(rivals)}` and "
            f"`pip install --force-reinstall --no-deps {OPENCV}`."
        )
    return tuple(told)


def _packages() -> tuple[dict[str, str], dict[str, str]]:
    """Versions of what is needed always, and of what extras bring that users ask for."""
    always = {"omnilines": importlib.metadata.version("omnilines"), "Python": platform.python_version()}
    extras: dict[str, str] = {}
    for text in importlib.metadata.requires("omnilines") or []:
        name, extra = re.match(r"[\w.-]+", text), re.search(r"extra == ['\"](\w+)['\"]", text)
        if name is None or (extra and extra[1] in ("docs", "lint", "test")):
            continue
        if extra is None:
            always[name[0]] = _version(name[0])
        else:
            found = _version(name[0])
            extras[extra[1]] = f"pip install 'omnilines[{extra[1]}]'" if found == ABSENT else f"{name[0]} {found}"
    return always, extras


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return ABSENT


def _machine() -> dict[str, Any]:
    free = available_bytes()
    return {
        "system": platform.platform(),
        "cores": cores(),
        "threads of torch, of OpenCV": f"{torch.get_num_threads()}, {cv2.getNumThreads()}",
        "memory that is free": "not known" if free is None else f"{free / 2**30:.1f} GiB",
        "GPU for --device cuda": torch.cuda.get_device_name() if torch.cuda.is_available() else "none that torch can use",
        "compiled functions are kept in": os.environ.get(VARIABLE) or str(Path(__file__).parents[1]),
        "chromium, for the tests": shutil.which("chromium") or ABSENT,
    }


def _self_check(progress: ProgressCallback) -> tuple[Check, ...]:
    """Of a camera from photos of a target, and of lines from photos of a room, both rendered."""
    progress("checking a rendered camera", 0, 0)
    camera = validate(render(TARGET, "opencv-fisheye", RenderOptions(views=8, size_px=(640, 480))))
    progress("checking the lines of a rendered room", 0, 0)
    room = validate(render(ROOM, "opencv-fisheye", RenderOptions(views=6, size_px=(400, 400))))
    return (*camera.checks, *room.checks)
