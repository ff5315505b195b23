"""The contract of every camera model: a pair of functions between pixels and unit bearings.

Pixels are (u right, v down) with the centre of the first pixel at (0, 0). The camera frame is x right, y down, z forward;
the angle off axis is theta = atan2(hypot(x, y), z) in [0, pi].
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar, overload

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models._arrays import Array, array_function, as_tensor, vectors
from camera_models.errors import InputError

FOCAL_LENGTHS = ("fx", "fy")
_LEAST_NORM = 0.5
"""Of a bearing that is one; nothing that is not a number is larger."""


def _size(given: Any) -> tuple[int, int]:
    """Width and height of an image. Raises InputError where they are none."""
    try:
        width, height = given
        whole = (int(width), int(height))
        if whole == (width, height) and min(whole) > 0:
            return whole
    except (TypeError, ValueError, OverflowError):
        pass  # what is wrong with them is said below
    raise InputError(f"An image was expected to be (width, height) in whole pixels above 0, found {given!r}; correct it.")


class CameraModel(ABC):
    """A central camera. Immutable; `with_parameters` makes a neighbour with another parameter vector.

    `parameters` (p,) may require gradients: `project` and `unproject` are differentiable in it and in their argument.
    """

    NAME: ClassVar[str]
    PARAMETER_NAMES: tuple[str, ...]
    LARGEST_ANGLE: ClassVar[float] = math.pi
    """Angle off axis (rad) that no instance of the model reaches."""
    CALIBRATED: ClassVar[bool] = True
    """Whether the model has parameters to estimate; where not, `from_radial_curve` raises InputError."""
    PERIODIC: ClassVar[bool] = False
    """Whether the image closes around the sphere: u and u + width are the same pixel, and the ray behind the camera is seen."""

    VARIANTS: ClassVar[tuple[Mapping[str, int], ...]] = ({},)
    """Options of `from_radial_curve` among which a model is chosen for a lens, from the fewest parameters to the most."""
    NESTED_VARIANTS: ClassVar[bool] = False
    """Whether a calibration goes from one of VARIANTS to another (`of_variant`) until held-out views support it."""
    AXIS_SIGN_OPEN: ClassVar[bool] = False
    """Whether photos of plain boards leave open to which side the camera looks, as a lens or a mirror (`reversed`)."""

    COEFFICIENTS: ClassVar[tuple[int, ...]] = ()
    """How many distortion coefficients a calibration may estimate, where that can be chosen (`coefficients`)."""

    OPTIONAL_TERMS: ClassVar[tuple[tuple[str, ...], ...]] = ()
    """Parameters that a lens may do without (zero), from those that it needs first to those that it needs last."""

    def __init__(self, parameters: Array | Sequence[float | int], image_size: tuple[int, int], *, trial: bool = False) -> None:
        """With `trial` the numbers are those that a fit tries, which may be of no camera."""
        given = as_tensor(parameters)
        # A camera does not change where the array that it was made from does.
        self.parameters: Tensor = given if given.requires_grad else given.clone()
        self.image_size = _size(image_size)
        if self.parameters.shape != (len(self.PARAMETER_NAMES),):
            raise InputError(
                f"Camera model {self.NAME} expects the {len(self.PARAMETER_NAMES)} parameters "
                f"{' '.join(self.PARAMETER_NAMES)}, found {tuple(self.parameters.shape)}; give one number for each."
            )
        if not trial:
            self._require_numbers()

    def _require_numbers(self) -> None:
        """Raises InputError where a parameter is no finite number, or a focal length not above 0."""
        for name, value in self.named_parameters().items():
            if not math.isfinite(value) or (name in FOCAL_LENGTHS and value <= 0.0):
                wanted = "above 0" if math.isfinite(value) else "finite"
                raise InputError(
                    f"The parameter {name} of camera model {self.NAME} was expected to be a number that is {wanted}, found "
                    f"{value:g}; correct it."
                )

    @classmethod
    @abstractmethod
    def from_mapping(cls, parameters: Mapping[str, float], image_size: tuple[int, int]) -> "CameraModel":
        """The model of named parameters as `calibration.yaml` holds them; raises InputError on a missing or unknown name."""

    @classmethod
    @abstractmethod
    def from_radial_curve(
        cls,
        rho_px: Float[Tensor, " n"],
        theta: Float[Tensor, " n"],
        centre: Float[Tensor, "2"],
        image_size: tuple[int, int],
        mirror: bool = False,
        **options: Any,
    ) -> "CameraModel":
        """The model nearest to samples of a radial curve: the start of a calibration.

        `rho_px` is the distance from the centre in the image, `theta` the angle in [0, pi] from the bearing of the centre pixel.
        """

    @classmethod
    @abstractmethod
    def examples(cls) -> "Sequence[CameraModel]":
        """Realistic instances, looped over by the law suite."""

    @abstractmethod
    def _project(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """`project` on tensors."""

    @abstractmethod
    def _unproject(self, pixels: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """`unproject` on tensors."""

    @abstractmethod
    def project_with_jacobians(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"], Float[Tensor, "*batch 2 3"], Float[Tensor, "*batch 2 p"]]:
        """Pixels, valid, d pixel / d point and d pixel / d parameters, analytic. Jacobians are zero where invalid."""

    @property
    @abstractmethod
    def max_angle(self) -> float:
        """The angle (rad) from the bearing of the centre pixel up to which the model is one-to-one; it decides `valid`."""

    @property
    @abstractmethod
    def centre_px(self) -> Float[Tensor, "2"]:
        """The pixel on the optical axis."""

    @overload
    def project(self, points: Tensor) -> tuple[Tensor, Tensor]: ...

    @overload
    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...

    @array_function
    def project(self, points: Float[Array, "*batch 3"]) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Pixels of points (or bearings, of any positive scale) in the camera frame, and where that is defined.

        `valid` is false beyond `max_angle`, at the camera centre, and for numbers that are none (NaN, infinity) or beyond
        computing; the pixel there is finite and means nothing. It says where the model is defined: pixels may lie outside the
        image, or beyond the field that a calibration saw (`max_angle_deg` of its estimate). Raises InputError where points
        are none.
        """
        pixels, valid = self._project(vectors(points, 3, "Points"))
        known = pixels.isfinite().all(-1)
        if not bool(known.all()):
            pixels, valid = torch.where(known[..., None], pixels, self.centre_px), valid & known
        return pixels, valid

    @overload
    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]: ...

    @overload
    def unproject(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...

    @array_function
    def unproject(self, pixels: Float[Array, "*batch 2"]) -> tuple[Float[Array, "*batch 3"], Bool[Array, "*batch"]]:
        """Unit bearings of pixels, and where that is defined; elsewhere the bearing is a unit vector that means nothing.

        Raises InputError where pixels are none.
        """
        bearings, valid = self._unproject(vectors(pixels, 2, "Pixels"))
        known = bearings.norm(dim=-1) > _LEAST_NORM
        if not bool(known.all()):
            ahead = torch.tensor([0.0, 0.0, 1.0], dtype=bearings.dtype, device=bearings.device)
            bearings, valid = torch.where(known[..., None], bearings, ahead), valid & known
        return bearings, valid

    def unproject_jacobian(self, pixels: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3 2"]:
        """d bearing / d pixel, by the inverse-function theorem from the Jacobian of `project` on the tangent plane."""
        bearing, _ = self._unproject(pixels)
        _, _, by_point, _ = self.project_with_jacobians(bearing)
        # Tangent basis B (3x2) of the sphere at the bearing: d pixel = (J B) d tangent.
        helper = torch.nn.functional.one_hot(bearing.abs().argmin(-1), 3).to(bearing.dtype)
        first = torch.linalg.cross(bearing, helper)
        first = first / first.norm(dim=-1, keepdim=True)
        basis = torch.stack([first, torch.linalg.cross(bearing, first)], -1)
        return basis @ torch.linalg.pinv(by_point @ basis)

    def calibration_basis(self) -> Float[Tensor, "p q"]:
        """Directions of the parameter vector that a calibration with free poses can estimate; the default is all of them."""
        return torch.eye(len(self.PARAMETER_NAMES), dtype=torch.float64)

    def rivals(self, largest_angle: float) -> "Sequence[CameraModel]":
        """Instances with nearly the same curve up to `largest_angle` (rad) in other minima of a fit; the default is none.

        Where there are any, a refinement is repeated from each of them and the best is taken.
        """
        return ()

    @classmethod
    def variant_options(cls) -> frozenset[str]:
        """Names of the options of `from_radial_curve` by which its VARIANTS differ."""
        return frozenset(name for options in cls.VARIANTS for name in options)

    @property
    def variant(self) -> Mapping[str, int]:
        """The one of VARIANTS that this is, where they are nested."""
        return {}

    def of_variant(self, variant: Mapping[str, int], rho_px: Float[Tensor, " n"]) -> "CameraModel":
        """Of a model with nested variants, the camera of another one that is nearest to this at some radii."""
        raise InputError(f"A camera model with variants to go through was expected, found {self.NAME}; calibrate it as it is.")

    def reversed(self) -> "CameraModel":
        """The camera that looks to the other side (z reversed), for models with AXIS_SIGN_OPEN."""
        raise InputError(f"A camera model that may look to either side was expected, found {self.NAME}; it has one side.")

    def calibrated_form(self) -> "CameraModel":
        """The same camera turned about its axis to where `calibration_basis` holds it; the default is itself."""
        return self

    @property
    def label(self) -> str:
        """For people: the name, and what else tells how many parameters there are."""
        return " ".join([self.NAME, *(f"of {name} {value}" for name, value in self.variant.items())])

    def with_parameters(self, parameters: Array | Sequence[float | int]) -> "CameraModel":
        """The same model and image with another parameter vector. Of a tensor any numbers are taken, since fits pass through some
        that are of no camera."""
        return type(self)(parameters, self.image_size, trial=isinstance(parameters, Tensor))

    def named_parameters(self) -> dict[str, float]:
        """Parameter names and values in their order."""
        return dict(zip(self.PARAMETER_NAMES, self.parameters.detach().tolist(), strict=True))

    @cached_property
    def image_radius_px(self) -> float:
        """Distance from the centre pixel to the farthest image corner."""
        w, h = self.image_size
        cx, cy = self.centre_px.detach().tolist()
        return max(math.hypot(x - cx, y - cy) for x in (-0.5, w - 0.5) for y in (-0.5, h - 0.5))

    def __repr__(self) -> str:
        values = " ".join(f"{name}={value:.9g}" for name, value in self.named_parameters().items())
        return f"{type(self).__name__}({values}, image_size={self.image_size})"
