"""What can be asked of a calibration, of one camera or of a rig."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict

from camera_models import InputError, model_class
from camera_models.typed import require_fields
from camera_models.wording import either
from omnilines.calibration.thresholds import CalibrationThresholds

AUTO = "auto"
"""In the place of a model's name: fit all and take the one that predicts held-out views best."""
REFINABLE = ("surface", "aspect", "flatness")
"""What can be estimated of a board (`board_shape`)."""


@dataclass(frozen=True, repr=False)
class CalibrationOptions(CalibrationThresholds):
    """What can be asked of a calibration, and its thresholds. Raises InputError where it cannot work, before any photo is looked
    at."""

    model: str = "scaramuzza"
    """Name of a camera model, or "auto": fit all and take the one that predicts held-out views best."""
    degree: int | None = None
    """Of the polynomial of a scaramuzza camera; without it that is chosen by held-out views."""
    coefficients: int | None = None
    """Of the distortion: of a pinhole camera 0, 5 or 8 (without it 5; from lines 8 too, where that predicts held-out photos
    better than chance makes it), of a fisheye624 6, 8 or 12 (without it 6). Those that the views do not support are held."""
    loss: str = "cauchy"
    """Plain least squares of every corner ("none"), or the loss by which those that do not fit are found ("huber", "cauchy")."""
    mirror: bool = False
    """Whether the camera looks into a mirror (a0 < 0)."""
    refine_board: tuple[str, ...] = ()
    """What is estimated of the board: "aspect", and "flatness" (a quadratic bend) or "surface" (to the fourth degree)."""
    rolling_shutter: bool = False
    """Whether the line delay of each camera is estimated, from the board's motion in frames that follow one another closely."""
    searches: int = 3
    """Times at most that the camera is sent out for corners that were missed in its photos; the first time all corners are fitted
    again along the edges that it sees."""

    def __post_init__(self) -> None:
        """Refuse what cannot work."""
        require_fields(self)
        # Loaded with the first options and not with their class, whose defaults the help of the command line shows.
        from omnilines.least_squares import Loss

        if self.model != AUTO:
            model_class(self.model)
        elif self.of_model:
            raise InputError(
                f"`model` auto tries every number of coefficients itself, found `{next(iter(self.of_model))}` beside it; "
                "leave that out or name a model."
            )
        Loss(self.loss)
        require_refinable(self.refine_board)
        if self.degree is not None and self.degree < 2:
            raise InputError(f"`degree` was expected to be at least 2, found {self.degree}; leave it out to have it chosen.")

    @property
    def of_model(self) -> dict[str, int]:
        """The options that go to the model."""
        given = {"degree": self.degree, "coefficients": self.coefficients}
        return {name: value for name, value in given.items() if value is not None}

    def require_of_models(self, models: Sequence[str]) -> None:
        """Raises InputError where an option of the model is given that none of these models has."""
        known = {name for model in models if model != AUTO for variant in model_class(model).VARIANTS for name in variant}
        for name in self.of_model:
            if name not in known:
                found = ", ".join(dict.fromkeys(models)) or "cameras that are known"
                raise InputError(f"`{name}` was expected with a `model` that has it, found {found}; leave it out.")
        for model in models:
            choices = () if model == AUTO else model_class(model).COEFFICIENTS
            if choices and self.coefficients not in (None, *choices):
                raise InputError(
                    f"`coefficients` of {model} was expected to be {either(choices)}, found {self.coefficients}; choose one."
                )


class CalibrationFields(TypedDict, total=False):
    """Fields of `CalibrationOptions` that a call may give by name."""

    model: str
    degree: int | None
    coefficients: int | None
    loss: str
    mirror: bool
    refine_board: tuple[str, ...]
    rolling_shutter: bool
    searches: int


def require_refinable(names: Sequence[str]) -> None:
    """Raises InputError where something else than REFINABLE is to be estimated of a board."""
    unknown = [name for name in names if name not in REFINABLE]
    if unknown:
        raise InputError(
            f"What can be refined of a board is {', '.join(REFINABLE[:-1])} and {REFINABLE[-1]}, found '{unknown[0]}'; give some "
            "of them as `refine_board`, as in aspect,flatness."
        )
