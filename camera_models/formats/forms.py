"""The ways in which files of a format write a camera: declared as a table, from which reading, writing and fitting follow."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from camera_models import model_class
from camera_models._model import CameraModel
from camera_models.errors import InputError


@dataclass(frozen=True)
class Form:
    """One way in which files of a format write a camera."""

    name: str
    """As the format calls it."""
    model: str
    """Our camera model."""
    order: tuple[str, ...] | None = None
    """Our parameters in the order of the file, `f` for a common fx and fy; None where it takes all of them by name."""
    fixed: Mapping[str, float] = field(default_factory=dict)
    """Values of the parameters that it does not write; 0 for those not named here."""
    positive: tuple[str, ...] = ()
    """Parameters that must be above 0."""
    options: Mapping[str, int] = field(default_factory=dict)
    """Of the model, for a fit to this form."""
    ends_deg: float = 180.0
    """Angle off axis at which the code of the format's own tool stops."""
    on_request: bool = False
    """Whether cameras of other models are fitted by it only where its model is named: few programs read it."""

    @property
    def written(self) -> tuple[str, ...] | None:
        """Our parameters that stand in the file; None for all."""
        if self.order is None:
            return None
        return tuple(name for item in self.order for name in (("fx", "fy") if item == "f" else (item,)))

    @property
    def tied(self) -> tuple[str, ...]:
        """Parameters for which one value stands in the file."""
        return ("fx", "fy") if "f" in (self.order or ()) else ()

    @property
    def held(self) -> dict[str, float]:
        """Parameters that a camera fitted to this form must have at a given value."""
        names: Sequence[str] = getattr(model_class(self.model), "PARAMETER_NAMES", tuple(self.fixed))
        written = self.written
        return {} if written is None else {name: self.fixed.get(name, 0.0) for name in names if name not in written}

    def why_not(self, model: CameraModel) -> str | None:
        """Why it cannot hold a camera exactly, as the end of a sentence; None where it can."""
        if model.NAME != self.model:
            return f"{self.name} is not the camera model {model.NAME}"
        values, written = model.named_parameters(), self.written
        if written is None:
            return None
        lost = [name for name, value in values.items() if name not in written and value != self.fixed.get(name, 0.0)]
        if lost:
            return f"{self.name} has no place for {', '.join(f'{name} = {values[name]:g}' for name in lost)}"
        low = [name for name in self.positive if not values[name] > 0]
        if low:
            return f"{self.name} needs {low[0]} above 0"
        if "f" in (self.order or ()) and values["fx"] != values["fy"]:
            return f"{self.name} has one focal length"
        return None

    def values(self, model: CameraModel) -> list[float]:
        """The parameters of a camera in the order of the file."""
        named = model.named_parameters()
        return list(named.values()) if self.order is None else [named["fx" if name == "f" else name] for name in self.order]

    def camera(self, values: Sequence[float], image_size: tuple[int, int], where: str) -> CameraModel:
        """The camera of the parameters in the order of the file; raises InputError where their number is another."""
        order = self.order or ()
        if len(values) != len(order):
            raise InputError(f"{self.name} of {where} must have {len(order)} parameters, found {len(values)}; correct them.")
        named = dict(zip(order, values, strict=True))
        if "f" in named:
            named["fx"] = named["fy"] = named.pop("f")
        return model_class(self.model).from_mapping({**self.fixed, **named}, image_size)
