"""What photos and their calibration may be in place of what poses are of: flipped or turned photos, those of another camera."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from camera_models import Calibration, CameraModel, OpenCVFisheye, Pinhole
from camera_models.wording import rounded
from omnilines.pipelines.photo_arcs import FoundArcs

TURNED: tuple[tuple[str, tuple[tuple[int, int], tuple[int, int]]], ...] = (
    ("mirrored", ((-1, 0), (0, 1))),
    ("flipped upside down", ((1, 0), (0, -1))),
    ("turned by 180 degrees", ((-1, 0), (0, -1))),
    ("turned by 90 degrees to the right", ((0, 1), (-1, 0))),
    ("turned by 90 degrees to the left", ((0, -1), (1, 0))),
)
"""What photos look, and what takes their pixels, from the middle of the image, to those that they should be."""
STEP, STEPS = 1.1, 9
"""Of the angles under which another camera would see: so many steps to either side."""
FINER = (-0.5, -0.25, 0.25, 0.5)
"""Of a step, about the best."""
ALIKE = 0.02
"""Share of the angles by which two cameras differ at most that are one."""
BEHIND = -0.95
"""Cosine of the angle from the axis."""


@dataclass(frozen=True)
class PhotoReading:
    """The same photos, taken for others, or for those of another camera."""

    looks: str
    """What they seem to be, behind "the photos look"."""
    remedy: str
    """What to do, one imperative."""
    found: Sequence[FoundArcs]
    cameras: Calibration


def turned_photos(found: Sequence[FoundArcs], cameras: Calibration) -> Iterator[PhotoReading]:
    """The ways in which photos may have been flipped or turned without a change of their size."""
    sizes = [cameras[name].image_size for name in dict.fromkeys(one.camera for one in found)]
    for looks, rows in TURNED:
        matrix = np.array(rows, dtype=np.float64)
        if matrix[0, 0] or all(width == height for width, height in sizes):
            again = [_mapped(one, 0.5 * np.array(cameras[one.camera].image_size) - 0.5, matrix) for one in found]
            remedy = "flip or turn them back, as those that poses and calibration are of"
            if np.linalg.det(matrix) < 0:
                # Poses of a mirrored world and mirrored cameras fit photos that are mirrored just as well.
                remedy += "; if the poses are of a left-handed world (Unity, Unreal), give right-handed ones"
            yield PhotoReading(looks, remedy, again, cameras)


def slipped_calibrations(found: Sequence[FoundArcs], cameras: Calibration) -> Iterator[PhotoReading]:
    """The slips of a calibration that was written by hand: its centre the other way round, its numbers those of another size."""
    around = [cameras[one.camera].centre_px.detach().numpy() for one in found]
    moved = [replace(one, endpoints_px=one.endpoints_px + at - at[::-1]) for one, at in zip(found, around, strict=True)]
    seen = [_seen(one, cameras[one.camera]) for one in moved]
    yield PhotoReading("like those of a camera whose cx and cy are exchanged", "exchange them in the calibration", seen, cameras)
    for times, which in ((0.5, "half"), (2.0, "twice")):
        scaled = [_mapped(one, np.full(2, -0.5), times * np.eye(2)) for one in found]
        seen = [_seen(one, cameras[one.camera]) for one in scaled]
        looks = f"like those of a camera that was calibrated with photos of {which} their size"
        yield PhotoReading(looks, "give the calibration of photos of their size", seen, cameras)


def other_cameras(found: Sequence[FoundArcs], cameras: Calibration, angles: Sequence[float]) -> Iterator[PhotoReading]:
    """Cameras that see what the calibrated ones see under so many times their angles: alike, without distortion, and fisheyes."""
    for scale in angles:
        times = f"like those of a camera whose focal length is {rounded(1 / scale)} times that of the calibration"
        scaled = [_scaled(one, cameras[one.camera], scale) for one in found]
        yield PhotoReading(times, _CALIBRATE, scaled, cameras)
        for name, lens in (("a camera without distortion (pinhole)", _pinhole), ("a fisheye (opencv-fisheye)", _fisheye)):
            others = {own: lens(model, scale) for own, model in cameras.items()}
            if not all(_alike(one, cameras[one.camera], others[one.camera], scale) for one in found):
                focal = rounded(float(next(iter(others.values())).parameters[0]))
                looks = f"like those of {name} with a focal length of about {focal} px"
                seen = [_seen(one, others[one.camera]) for one in found]
                yield PhotoReading(looks, _CALIBRATE, seen, replace(cameras, cameras=others, estimates={}))


_CALIBRATE = "give the calibration of the camera that took them, at their zoom and size"


def steps_of_angles() -> list[float]:
    """The angles that are tried first, times those of the calibration."""
    return [STEP**k for k in range(-STEPS, STEPS + 1)]


def finer_angles(best: float) -> list[float]:
    """Those about the best."""
    return [best, *(best * STEP**k for k in FINER)]


def _mapped(one: FoundArcs, middle: Float[np.ndarray, "2"], matrix: Float[np.ndarray, "2 2"]) -> FoundArcs:
    """The arcs with their pixels taken elsewhere about the middle of the image; what was to the left of an arc lies to its right
    where they are flipped."""
    flipped = np.linalg.det(matrix) < 0
    return replace(
        one,
        endpoints_px=(one.endpoints_px - middle) @ matrix.T + middle,
        covariance_px2=matrix @ one.covariance_px2 @ matrix.T,
        colours=one.colours[:, ::-1] if flipped else one.colours,
    )


def _scaled(one: FoundArcs, model: CameraModel, scale: float) -> FoundArcs:
    """The arcs with their pixels so many times as far from the centre, those that the camera sees there."""
    return _seen(_mapped(one, model.centre_px.detach().numpy(), scale * np.eye(2)), model)


def _seen(one: FoundArcs, model: CameraModel) -> FoundArcs:
    """The arcs that a camera sees, but for those straight behind it, where all pixels of a ring may be one place."""
    with torch.no_grad():
        (bearings, valid), (ahead, _) = model.unproject(one.endpoints_px), model.unproject(model.centre_px.numpy())
    seen = (valid & (bearings @ ahead > BEHIND)).all(-1)
    arrays = {name: getattr(one, name)[seen] for name in ("endpoints_px", "covariance_px2", "length_px", "colours")}
    return replace(one, **arrays)


def _per_radian(model: CameraModel) -> float:
    """Pixels at the centre."""
    with torch.no_grad():
        return 1.0 / float(model.unproject_jacobian(model.centre_px)[:, 0].norm())


def _pinhole(model: CameraModel, scale: float) -> CameraModel:
    focal, (u, v) = _per_radian(model) / scale, model.centre_px.tolist()
    return Pinhole.from_mapping({"fx": focal, "fy": focal, "cx": u, "cy": v}, model.image_size)


def _fisheye(model: CameraModel, scale: float) -> CameraModel:
    focal, (u, v) = _per_radian(model) / scale, model.centre_px.tolist()
    return OpenCVFisheye.from_mapping(
        {"fx": focal, "fy": focal, "cx": u, "cy": v, "k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0}, model.image_size
    )


def _alike(one: FoundArcs, model: CameraModel, other: CameraModel, scale: float) -> bool:
    """Whether another camera sees the arcs as the camera sees them scaled."""
    if not len(one):
        return True
    middle = model.centre_px.detach().numpy()
    ends = one.endpoints_px.reshape(-1, 2)
    scaled, seen = model.unproject(middle + scale * (ends - middle))
    there, valid = other.unproject(ends)
    between = np.arccos(np.clip((scaled * there).sum(-1), -1.0, 1.0))
    off = np.arccos(np.clip(scaled @ model.unproject(middle)[0], -1.0, 1.0))
    return bool((seen & valid).all() and (between <= ALIKE * off + 1e-3).all())
