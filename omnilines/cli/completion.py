"""What a shell offers for the values of options, once `omnilines --install-completion` has told it to ask."""

from camera_models import MODELS
from camera_models.formats import FORMATS


def model_names(incomplete: str) -> list[str]:
    """Camera models that begin so."""
    return [name for name in ("auto", *(name for name, _ in MODELS)) if name.startswith(incomplete)]


def format_names(incomplete: str) -> list[str]:
    """Formats of calibrations that begin so."""
    return [entry.name for entry in FORMATS if entry.name.startswith(incomplete)]
