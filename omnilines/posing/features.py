"""SIFT features of a photo as bearings: the camera turns each keypoint into a unit vector, and all after that is on the sphere.

Keypoints come from the photo as it is, with affine shapes (K. Mikolajczyk, C. Schmid, Scale and affine invariant interest point
detectors, IJCV 2004), which make up for much of what slant and a wide lens do to a patch. Left out are those that the camera
cannot see, those beyond the angles that its calibration is supported by, and those at the edge of the lens's dark surround, which
stand still in every photo.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from camera_models import CameraEstimate, CameraModel, InputError
from omnilines.photo_file import eight_bits
from omnilines.posing._pycolmap import pycolmap
from omnilines.posing.options import FeatureOptions


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints of one photo, rows in the order of falling scale."""

    bearings: Float[torch.Tensor, "n 3"]
    """Unit vectors in the camera frame."""
    rows: Float[torch.Tensor, "n 2 3"]
    """Across each bearing, in units of the keypoint's standard deviation: rows (b' - b) is the error in standard deviations."""
    sigma_rad: Float[torch.Tensor, " n"]
    """The larger standard deviation of the bearing."""
    descriptors: UInt8[torch.Tensor, "n 128"]
    """RootSIFT, of length 512 or so."""

    def __len__(self) -> int:
        return len(self.bearings)

    @cached_property
    def lengths(self) -> Float[np.ndarray, " n"]:
        """Of the descriptors, in single precision."""
        return self.descriptors.to(torch.float32).norm(dim=-1).clamp_min(1.0).numpy()

    def unit_descriptors(self) -> Float[torch.Tensor, "n 128"]:
        """In single precision."""
        whole = self.descriptors.to(torch.float32)
        return whole / whole.norm(dim=-1, keepdim=True).clamp_min(1.0)


def feature_finder(
    options: FeatureOptions = FeatureOptions(),
) -> Callable[[np.ndarray, CameraModel, CameraEstimate | None, Bool[np.ndarray, "h w"] | None], Features]:
    """A function that finds the features of a photo, where its mask is true."""
    module = pycolmap()
    extraction = module.FeatureExtractionOptions()
    extraction.use_gpu, extraction.num_threads = False, 1
    extraction.sift.estimate_affine_shape = True
    extraction.sift.peak_threshold = options.min_contrast
    extraction.sift.first_octave = 0
    extraction.sift.max_num_features = options.max_features
    extractor = module.FeatureExtractor.create(extraction, module.Device.cpu)

    def find(
        image: np.ndarray, model: CameraModel, estimate: CameraEstimate | None, mask: Bool[np.ndarray, "h w"] | None
    ) -> Features:
        """Features of a photo (h, w) or (h, w, 3) of 8 or 16 bits; raises InputError where it has not the camera's size."""
        if image.shape[1::-1] != model.image_size:
            expected, found = (f"{w}x{h} px" for w, h in (model.image_size, image.shape[1::-1]))
            raise InputError(f"A photo of {expected} was expected for its camera, found one of {found}; give that of its camera.")
        grey = _grey(image)
        searched, factor = _searched(grey, options)
        clear = clear_of_surround(grey, options)
        if mask is not None:
            clear = clear & mask
        keypoints, descriptors = extractor.extract_from_uint8_array(searched)
        table = np.asarray(module.keypoints_to_matrix(keypoints), dtype=np.float64).reshape(-1, 4)
        # COLMAP's first pixel has its centre at 0.5, and so has resampling.
        pixels, scale_px = table[:, :2] / factor - 0.5, table[:, 2] / factor.mean()
        sigma_px = options.sigma_px * np.maximum(scale_px / options.large_scale_px, 1.0)
        return _on_sphere(
            pixels,
            sigma_px,
            np.array(descriptors.data),
            model,
            _supported_rad(estimate, options),
            clear,
        )

    return find


def _grey(image: np.ndarray) -> UInt8[np.ndarray, "h w"]:
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.ascontiguousarray(eight_bits(grey))


def _searched(
    grey: UInt8[np.ndarray, "h w"], options: FeatureOptions
) -> tuple[UInt8[np.ndarray, "h2 w2"], Float[np.ndarray, "2"]]:
    """The photo with about as many pixels as are searched, and how much larger it is (across, down)."""
    size = np.array(grey.shape[::-1])
    factor = min(options.max_enlarged, math.sqrt(1e6 * options.searched_megapixels / grey.size))
    wanted = np.maximum(np.rint(factor * size).astype(int), 1)
    way = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    return cv2.resize(grey, (int(wanted[0]), int(wanted[1])), interpolation=way), wanted / size


def clear_of_surround(grey: UInt8[np.ndarray, "h w"], options: FeatureOptions = FeatureOptions()) -> Bool[np.ndarray, "h w"]:
    """Pixels away from the dark surround of the image circle and then from the image's border; all where no corner is dark."""
    dark = (cv2.blur(grey, (3, 3)) <= options.surround_grey).astype(np.uint8)
    if not dark[[0, 0, -1, -1], [0, -1, 0, -1]].any():
        return np.ones(grey.shape, dtype=bool)
    # What is dark at the border is joined by a ring around the image: the circle may cut it into slivers.
    _, labels = cv2.connectedComponents(cv2.copyMakeBorder(dark, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1))
    distance = cv2.distanceTransform((labels != labels[0, 0]).astype(np.uint8), cv2.DIST_L2, 3)
    clear: Bool[np.ndarray, "h w"] = distance[1:-1, 1:-1] > options.surround_px
    return clear


def _supported_rad(estimate: CameraEstimate | None, options: FeatureOptions) -> tuple[float, float]:
    """The angles off axis between which a camera is believed."""
    if estimate is None:
        return 0.0, math.inf
    most = math.pi if estimate.max_angle_deg is None else math.radians(estimate.max_angle_deg) + options.beyond_support_rad
    return math.radians(estimate.min_angle_deg), most


def off_axis_rad(model: CameraModel, bearings: Float[torch.Tensor, "n 3"]) -> Float[torch.Tensor, " n"]:
    """The angle of each bearing from that of the centre pixel."""
    axis, _ = model.unproject(model.centre_px)
    return torch.atan2(torch.linalg.cross(bearings, axis.expand_as(bearings)).norm(dim=-1), bearings @ axis)


def _on_sphere(
    pixels: Float[np.ndarray, "n 2"],
    sigma_px: Float[np.ndarray, " n"],
    descriptors: UInt8[np.ndarray, "n 128"],
    model: CameraModel,
    supported_rad: tuple[float, float],
    clear: Bool[np.ndarray, "h w"],
) -> Features:
    place: Int[np.ndarray, "n 2"] = np.clip(np.rint(pixels).astype(np.int64), 0, np.array(model.image_size) - 1)
    with torch.no_grad():
        at = torch.as_tensor(pixels)
        bearings, valid = model.unproject(at)
        angle = off_axis_rad(model, bearings)
        supported = (angle >= supported_rad[0]) & (angle <= supported_rad[1])
        jacobian = model.unproject_jacobian(at)
    finite = torch.isfinite(jacobian).flatten(1).all(-1)
    keep = valid & supported & finite & torch.as_tensor(clear[place[:, 1], place[:, 0]])
    jacobian, own_px = jacobian[keep], torch.as_tensor(sigma_px)[keep]
    rows = torch.linalg.pinv(jacobian) / own_px[:, None, None]
    sigma_rad = own_px * torch.linalg.matrix_norm(jacobian, ord=2)
    return Features(bearings[keep], rows, sigma_rad, torch.as_tensor(descriptors)[keep])
