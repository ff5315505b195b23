"""Errors of cameras whose file states none, as large as somebody says.

A camera from COLMAP or OpenCV, or typed by hand, comes without a covariance, and lines would count it as exact. What is said is
one figure: how far pixels are off, in RMS over what the photos show. With k directions u in which a calibration can be off, and M
the mean over these pixels of J'J, where J is the motion of a pixel by them,

    covariance of u = error_px^2 / k  M^-1

(Zellner 1986, a g-prior): pixels then move by error_px in RMS, each direction taking an equal share of it.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from camera_models import Calibration, CameraModel, InputError
from camera_models.formats.calibration_data import CameraEstimate
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.lines.scores import pseudo_inverse
from omnilines.calibration.uncertainty import supported_grid
from omnilines.pipelines.options import SceneOptions


def require_error(options: SceneOptions) -> None:
    """Raises InputError where `calibration_error_px` is none, or counts for nothing."""
    error_px = options.calibration_error_px
    if error_px is not None and not 0 < error_px < math.inf:
        raise InputError(f"A `calibration_error_px` above 0 was expected, found {error_px}; correct the option.")
    if error_px is not None and "intrinsics" in options.refine:
        raise InputError(
            "`calibration_error_px` counts only with cameras that are held, found `refine` with intrinsics; leave one out."
        )


def with_assumed_errors(cameras: Calibration, arcs: MatchedArcs, options: SceneOptions) -> Calibration:
    """The calibration, in which cameras that state no covariance have one by `calibration_error_px`, where that is given; as
    far off axis as the arcs of their photos reach."""
    if options.calibration_error_px is None:
        return cameras
    assert arcs.observed is not None
    estimates = dict(cameras.estimates)
    for k, (name, model) in enumerate(cameras.items()):
        known = estimates.get(name, CameraEstimate())
        pixels = arcs.observed.pixels[arcs.observed.camera == k].flatten(0, 1)
        if known.covariance is None and model.CALIBRATED and len(pixels):
            reach_rad = float(angles_off_axis(model, pixels).max())
            covariance = assumed_covariance(model, options.calibration_error_px, reach_rad)
            sigma = dict(zip(model.PARAMETER_NAMES, np.sqrt(covariance.diagonal()).tolist(), strict=True))
            estimates[name] = replace(known, sigma=sigma, covariance=covariance)
    return replace(cameras, estimates=estimates)


def assumed_covariance(model: CameraModel, error_px: float, reach_rad: float) -> Float[np.ndarray, "p p"]:
    """Of the parameters of a camera, with which pixels up to so far off axis move by `error_px` in RMS."""
    grid = supported_grid(model, reach_rad)
    bearings, seen = model.unproject(grid)
    _, valid, _, by_parameter = model.project_with_jacobians(bearings[seen])
    basis = model.calibration_basis()
    moving = by_parameter[valid] @ basis
    motion = torch.einsum("nik,nil->kl", moving, moving) / len(moving)
    inverse = pseudo_inverse(motion)
    directions = float((motion * inverse).sum())
    covariance: Float[np.ndarray, "p p"] = (error_px**2 / directions * basis @ inverse @ basis.mT).numpy()
    return covariance
