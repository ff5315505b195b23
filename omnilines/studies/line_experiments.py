"""The studies `wide`, `short` and `room`: every triangulation and every cost against noise, with the Cramer-Rao bound.

`wide` and `short` are the synthetic studies of the dissertation (Srestasathiern 2012, section 5.2); `room` repeats them with a
fisheye of 190 degrees and lines all around, where a bearing may point backwards and a line has no image in any plane.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from camera_models import InputError
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Check
from omnilines.studies.line_study import Study, run_study, study_checks
from omnilines.synthetic.lines import LineWorld, circle_world, room_world

TITLES = {
    "wide": "Lines in a cube, cameras 45 degrees apart",
    "short": "Lines in a cube, cameras 9 degrees apart",
    "room": "Lines of a room through a fisheye of 190 degrees",
}
ALLOWANCE = {"wide": 0.02, "short": 0.02, "room": 0.03}
"""What the error may exceed the bound by, where two standard errors of the estimate are less."""
MOST_TRIALS = 10_000


@dataclass(frozen=True)
class LineStudyOptions:
    """Noise, trials and errors of the first poses."""

    noise_px: tuple[float, ...] = (0.2, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
    """Standard deviations of the end points, one after another."""
    trials: int = 50
    """At each noise."""
    perturb_deg: float = 1.0
    """Turn of every pose about a random axis through its camera, before it is estimated; the dissertation has no figure."""
    perturb_m: float = 0.05
    """Shift of every camera in a random direction."""
    seed: int = 0
    """What the scene, the noise and these errors are drawn from."""
    averaging: Mapping[str, Any] = field(default_factory=dict)
    """Options of the triangulation of that name."""

    def __post_init__(self) -> None:
        """Refuse what gives no figure."""
        if not self.noise_px or not all(math.isfinite(noise) and noise >= 0 for noise in self.noise_px):
            raise InputError(
                f"At least one noise of 0 px or more was expected, found {list(self.noise_px)}; give some, such as 0.5,1."
            )
        if not 1 <= self.trials <= MOST_TRIALS:
            raise InputError(f"1 to {MOST_TRIALS} trials were expected, found {self.trials}; give another number.")
        if not (0 <= self.perturb_deg < 180 and 0 <= self.perturb_m < math.inf):
            raise InputError(
                f"A disturbance of 0 to 180 degrees and at least 0 m was expected, found {self.perturb_deg} and {self.perturb_m}."
            )


def study_world(study: str, seed: int) -> LineWorld:
    """The scene of a study; raises InputError for an unknown one."""
    if study not in TITLES:
        raise InputError(f"A study among {', '.join(TITLES)} was expected, found '{study}'; choose one of these.")
    if study == "room":
        return room_world(seed)
    return circle_world("wide" if study == "wide" else "short", seed)


def line_experiment(
    study: str, options: LineStudyOptions = LineStudyOptions(), progress: ProgressCallback = silent
) -> tuple[Study, tuple[Check, ...]]:
    """Run a study, and compare it with the bound.

    With known poses, lines are triangulated and adjusted; with disturbed ones, lines are triangulated, and lines and poses
    adjusted. Raises InputError for an unknown study and GeometryError where the scene does not determine its lines.
    """
    found = run_study(
        study_world(study, options.seed),
        tuple(dict.fromkeys(map(float, options.noise_px))),
        options.trials,
        perturb_deg=options.perturb_deg,
        perturb_m=options.perturb_m,
        seed=options.seed,
        averaging=options.averaging,
        progress=progress,
    )
    return found, study_checks(found, ALLOWANCE[study])
