"""Cameras of which a calibration estimates as many distortion coefficients as are asked for."""

from collections.abc import Sequence

from torch import Tensor

from camera_models._arrays import Array
from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.wording import either


class WithCoefficients(CameraModel):
    """One of COEFFICIENTS is estimated, that of the first of VARIANTS where nothing is said."""

    def __init__(
        self,
        parameters: Array | Sequence[float | int],
        image_size: tuple[int, int],
        coefficients: int | None = None,
        *,
        trial: bool = False,
    ) -> None:
        super().__init__(parameters, image_size, trial=trial)
        self.coefficients = self.VARIANTS[0]["coefficients"] if coefficients is None else coefficients
        if self.coefficients not in self.COEFFICIENTS:
            raise InputError(
                f"Camera model {self.NAME} estimates {either(self.COEFFICIENTS)} distortion coefficients, found {coefficients}; "
                "choose one."
            )

    def with_parameters(self, parameters: Array | Sequence[float | int]) -> "WithCoefficients":
        """As of every model, with as many coefficients to estimate."""
        return type(self)(parameters, self.image_size, self.coefficients, trial=isinstance(parameters, Tensor))
