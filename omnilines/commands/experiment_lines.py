"""omnilines experiment wide, short and room: every triangulation and every cost against noise, with the Cramer-Rao bound.

`wide` and `short` are the synthetic studies of the dissertation (Srestasathiern 2012, section 5.2); `room` repeats them with a
fisheye of 190 degrees and lines all around, where a bearing may point backwards and a line has no image in any plane.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from camera_models import InputError
from omnilines.commands.result import CommandResult
from omnilines.files.folders import output_folder
from omnilines.pages.line_study import study_checks, study_data, study_sections, study_summaries, write_figures
from omnilines.progress import ProgressCallback, silent
from omnilines.report import write_report
from omnilines.studies.line_study import run_study
from omnilines.synthetic.lines import LineWorld, circle_world, room_world

NOISE_PX = (0.2, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
TRIALS = 50
PERTURB_DEG, PERTURB_M = 1.0, 0.05
"""The dissertation does not say by how much its cameras were disturbed."""
ALLOWANCE = {"wide": 0.02, "short": 0.02, "room": 0.03}
"""What the error may exceed the bound by, where two standard errors of the estimate are less."""
TITLES = {
    "wide": "Lines in a cube, cameras 45 degrees apart",
    "short": "Lines in a cube, cameras 9 degrees apart",
    "room": "Lines of a room through a fisheye of 190 degrees",
}
MOST_TRIALS = 10_000


def experiment_lines(
    study: str,
    out: str | Path,
    *,
    noise_px: Sequence[float] = NOISE_PX,
    trials: int = TRIALS,
    perturb_deg: float = PERTURB_DEG,
    perturb_m: float = PERTURB_M,
    seed: int = 0,
    averaging: Mapping[str, Any] | None = None,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Run the study `wide`, `short` or `room`; writes figures.csv and report.html.

    With known poses, lines are triangulated and adjusted; with every pose turned by `perturb_deg` about a random axis through its
    camera and its camera shifted by `perturb_m` in a random direction, lines are triangulated, and lines and poses adjusted.
    `averaging` holds the options of that triangulation.

    Raises InputError for options out of range and GeometryError where the scene does not determine its lines.
    """
    levels = tuple(dict.fromkeys(float(noise) for noise in noise_px))
    if study not in TITLES:
        raise InputError(f"A study among {', '.join(TITLES)} was expected, found '{study}'; choose one of these.")
    if not levels or not all(math.isfinite(noise) and noise >= 0 for noise in levels):
        raise InputError(f"At least one noise of 0 px or more was expected, found {list(noise_px)}; give some, such as 0.5,1.")
    if not 1 <= trials <= MOST_TRIALS:
        raise InputError(f"1 to {MOST_TRIALS} trials were expected, found {trials}; give another number.")
    if not (0 <= perturb_deg < 180 and 0 <= perturb_m < math.inf):
        raise InputError(f"A disturbance of 0 to 180 degrees and at least 0 m was expected, found {perturb_deg} and {perturb_m}.")
    world = study_world(study, seed)
    found = run_study(
        world,
        levels,
        trials,
        perturb_deg=perturb_deg,
        perturb_m=perturb_m,
        seed=seed,
        averaging=averaging or {},
        progress=progress,
    )
    about = (
        *_about(world),
        ("trials", f"{trials} at each noise of {', '.join(f'{noise:g}' for noise in levels)} px"),
        ("poses disturbed by", f"{perturb_deg:g} degrees and {perturb_m:g} m"),
    )
    summaries = study_summaries(found, TITLES[study], about)
    checks = study_checks(found, ALLOWANCE[study])
    folder = output_folder(out)
    table = folder / "figures.csv"
    write_figures(table, found)
    page = write_report(folder / "report.html", TITLES[study], study_sections(found, summaries, checks))
    data = {"study": study, "perturb_deg": perturb_deg, "perturb_m": perturb_m, "beyond_90_deg": _beyond(world)}
    return CommandResult(summaries, {**data, **study_data(found, seed)}, checks, (table, page), page)


def study_world(study: str, seed: int) -> LineWorld:
    """The scene of a study."""
    if study == "room":
        return room_world(seed)
    return circle_world("wide" if study == "wide" else "short", seed)


def parse_noise(text: str) -> tuple[float, ...]:
    """Numbers with commas between, such as 0.5,1,2. Raises InputError on anything else."""
    try:
        return tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        raise InputError(f"--noise was expected as numbers with commas between, such as 0.5,1,2, found '{text}'.") from None


def _beyond(world: LineWorld) -> float:
    """Share of the observed end points whose bearing is more than 90 degrees off the optical axis."""
    bearings, _ = world.camera.unproject(world.ends_px)
    return float((bearings[..., 2] < 0).to(torch.float64).mean())


def _about(world: LineWorld) -> tuple[tuple[str, str], ...]:
    views = np.bincount(world.track.numpy(), minlength=world.lines)
    return (
        ("camera", f"{world.camera.NAME}, {world.camera.image_size[0]} x {world.camera.image_size[1]} px"),
        ("lines, views, segments", f"{world.lines}, {world.images}, {len(world.track)}"),
        ("views of a line", f"{views.min()} to {views.max()}"),
        ("end points beyond 90 degrees off axis", f"{100 * _beyond(world):.1f} %"),
    )
