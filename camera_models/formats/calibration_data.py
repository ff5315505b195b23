"""What a calibration file holds beside the camera models: estimates, rig, views."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.pose import Pose

SIGN_SOURCES = ("assumed", "mirror", "tags", "target", "rig")
"""What decided the side of the lens (the sign of a0), which plain planar boards leave open: nothing (a0 > 0 assumed), the
`--mirror` option, decoded tags, a target that is not planar, the consistency of a rig."""
ROUNDED = 1e-6
"""Of a standard deviation: what numbers of a file may be off by."""


@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """How well one camera is known. None stands for what is not known."""

    sigma: dict[str, float] | None = None
    """One standard deviation of each parameter, by name, in the unit of the parameter."""
    covariance: Float[np.ndarray, "p p"] | None = None
    """Of the parameter vector of the model, in its order; zero rows for parameters that were held."""
    max_angle_deg: float | None = None
    """The angle from the bearing of the centre pixel up to which the data reach; not a limit of the model."""
    min_angle_deg: float = 0.0
    """The angle from which the data reach, above 0 for mirrors that see their own camera in the centre."""
    rms_px_per_axis: float | None = None
    """sqrt(sum r^2 / (2 n)) over n corners."""
    rms_px_per_point: float | None = None
    """sqrt(sum r^2 / n)."""
    sign_source: str | None = None
    """One of SIGN_SOURCES; None where the question does not arise."""

    def __post_init__(self) -> None:
        if self.sign_source is not None and self.sign_source not in SIGN_SOURCES:
            raise InputError(
                f"sign_source must be one of {', '.join(SIGN_SOURCES)}, found '{self.sign_source}'; choose one of these."
            )
        low, high = self.min_angle_deg, 180.0 if self.max_angle_deg is None else self.max_angle_deg
        if not 0.0 <= low <= high <= 180.0:
            raise InputError(
                f"The angles must satisfy 0 <= min_angle_deg <= max_angle_deg <= 180, found {low:g} and {high:g}; correct them."
            )


@dataclass(frozen=True, eq=False)
class RigCamera:
    """Where a camera sits in its rig."""

    cam_from_rig: Pose
    sigma: Float[np.ndarray, "6"] | None = None
    """Standard deviations of the left perturbation (rotation_rad, translation_m)."""
    covariance: Float[np.ndarray, "6 6"] | None = None
    """Of the same perturbation."""


@dataclass(frozen=True, eq=False)
class ViewRecord:
    """What became of one photo in the calibration."""

    image: str
    """POSIX path relative to the photo folder."""
    camera: str
    used: bool
    reason: str | None = None
    """Why it was not used, one sentence; None when it was."""
    corners_used: int = 0
    corners_rejected: int = 0
    rms_px_per_point: float | None = None
    cam_from_board: Pose | None = None
    frame: str | None = None
    """The instant at which the cameras of a rig took it."""
    view: str | None = None
    """Its name in `corners.csv`, where that is not the image."""

    def __post_init__(self) -> None:
        if self.used == bool(self.reason):
            found = f"used: {str(self.used).lower()} and reason: {self.reason or 'null'}"
            raise InputError(f"View {self.image} must be used or have a reason why not, found {found}; give one of the two.")


@dataclass(frozen=True, eq=False)
class Calibration(Mapping[str, CameraModel]):
    """An ordered mapping of camera name to model, with what is known about the estimate. `save` writes it, `load` reads it."""

    cameras: Mapping[str, CameraModel]
    estimates: dict[str, CameraEstimate] = field(default_factory=dict)
    """By camera name; a camera without statistics may be absent."""
    rig: dict[str, RigCamera] = field(default_factory=dict)
    """Every camera of a rig, the first being the rig frame; empty for one camera."""
    views: tuple[ViewRecord, ...] = ()
    provenance: dict[str, Any] = field(default_factory=dict)
    """Where the calibration comes from: texts, numbers, lists and mappings (software, command, inputs, seed)."""

    def __post_init__(self) -> None:
        if not self.cameras:
            raise InputError("A calibration must hold at least one camera, found none; add one.")
        for name, model in self.cameras.items():
            if not (isinstance(name, str) and isinstance(model, CameraModel)):
                raise InputError(
                    f"A calibration was expected to be camera models by their names, found {name!r}: {type(model).__name__}; "
                    "correct it."
                )
        known = ", ".join(self.cameras)
        named = [("estimates", name) for name in self.estimates] + [("views", view.camera) for view in self.views]
        for part, name in [*named, *(("rig", name) for name in self.rig)]:
            if name not in self.cameras:
                raise InputError(f"Every camera named under {part} must be one of {known}, found '{name}'; correct the name.")
        absent = [name for name in self.cameras if name not in self.rig]
        if self.rig and absent:
            raise InputError(
                f"The rig must list every camera ({known}), found none named '{absent[0]}'; add it or leave out rig."
            )
        for name, estimate in self.estimates.items():
            _check_estimate(name, self.cameras[name], estimate)
        for name, mount in self.rig.items():
            _check_mount(name, mount)

    def __repr__(self) -> str:
        cameras = ", ".join(f"{name}={model}" for name, model in self.cameras.items())
        return f"Calibration({cameras}, rig={len(self.rig)}, views={len(self.views)})"

    def __getitem__(self, name: str) -> CameraModel:
        if name not in self.cameras:
            raise KeyError(f"a camera of the name {', '.join(self.cameras)} was expected, found {name!r}")
        return self.cameras[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.cameras)

    def __len__(self) -> int:
        return len(self.cameras)


def _check_estimate(name: str, model: CameraModel, estimate: CameraEstimate) -> None:
    names = model.PARAMETER_NAMES
    for key, value in (estimate.sigma or {}).items():
        if key not in names:
            raise InputError(f"The sigma of camera {name} may name {' '.join(names)}, found '{key}'; correct the name.")
        if value < 0:
            raise InputError(f"The sigma of {key} of camera {name} must not be negative, found {value:g}; correct it.")
    _check_covariance(f"camera {name}", estimate.covariance, len(names))


def _check_mount(name: str, mount: RigCamera) -> None:
    sigma = mount.sigma
    if sigma is not None and not (sigma.shape == (6,) and np.isfinite(sigma).all() and (sigma >= 0).all()):
        raise InputError(
            f"The sigma of rig camera {name} was expected as six numbers of 0 or more, found {sigma.tolist()}; correct it."
        )
    _check_covariance(f"rig camera {name}", mount.covariance, 6)


def _check_covariance(whose: str, c: Float[np.ndarray, "p p"] | None, size: int) -> None:
    """Raises InputError where a matrix is the covariance of nothing."""
    if c is None:
        return
    if not isinstance(c, np.ndarray) or c.shape != (size, size):
        found = " x ".join(map(str, c.shape)) if isinstance(c, np.ndarray) else type(c).__name__
        raise InputError(f"The covariance of {whose} must be an array of {size} x {size} numbers, found {found}; correct it.")
    if not np.isfinite(c).all():
        raise InputError(f"The covariance of {whose} must be of finite numbers, found others; estimate it again.")
    variances = np.diagonal(c)
    scale = np.sqrt(np.abs(np.outer(variances, variances)))
    if (variances < 0).any() or (np.abs(c - c.T) > ROUNDED * scale).any():
        raise InputError(f"The covariance of {whose} must be symmetric with no negative variance; estimate it again.")
    correlation = np.divide(c, scale, out=np.zeros_like(c), where=scale > 0)
    if np.linalg.eigvalsh(correlation)[0] < -size * ROUNDED or (np.abs(c) > (1 + ROUNDED) * scale).any():
        raise InputError(
            f"The covariance of {whose} must leave no combination of its numbers a negative variance, found one that has; "
            "estimate it again."
        )
