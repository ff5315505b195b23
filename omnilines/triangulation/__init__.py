"""3D lines from the interpretation planes of matched arcs, batched over tracks of unequal length.

`TRIANGULATIONS` lists (name on the command line, "module:function"), the recommended method first, so that names are known
without importing torch.
"""

import importlib
from typing import TYPE_CHECKING, Any

from camera_models.errors import InputError

if TYPE_CHECKING:
    import omnilines.triangulation.observations
    import omnilines.triangulation.result

TRIANGULATIONS: tuple[tuple[str, str], ...] = (
    ("dual", "omnilines.triangulation.dual:triangulate"),
    ("averaging", "omnilines.triangulation.averaging:triangulate"),
    ("svd", "omnilines.triangulation.svd:triangulate"),
)


def triangulate(
    method: str, observations: "omnilines.triangulation.observations.PlaneObservations", **options: Any
) -> "omnilines.triangulation.result.Triangulation":
    """The lines of all tracks by the named method; `options` are those of its function. Raises InputError on an unknown name."""
    registry = dict(TRIANGULATIONS)
    if method not in registry:
        raise InputError(
            f"Expected a triangulation method among {', '.join(registry)}, found {method!r}; give one of these names."
        )
    module, function = registry[method].split(":")
    result: omnilines.triangulation.result.Triangulation = getattr(importlib.import_module(module), function)(
        observations, **options
    )
    return result
