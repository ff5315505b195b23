"""3D lines from the interpretation planes of matched arcs, batched over tracks of unequal length.

RMS 3D error over the Cramer-Rao bound at 0.5 px with exact poses, each line's error over its own bound; 200 trials of 40 lines,
8 views (`tests/triangulation_scenes.py`; standard errors 0.004, 0.005 and 0.005):

    method                                      circle, 45 degrees   circle, 9 degrees   190 degree fisheye in a room
    ml                                                1.00                 1.00                   1.00
    dual                                              1.01                 1.00                   1.07
    svd                                               1.01                 1.00                   1.07
    averaging                                         1.02                 1.01                   1.08
    dual, published weights                           1.20                 1.01                   1.08
    dual, published weights, file's origin            4.47                 2.65                   3.94

`ml` weighs every end by its noise in pixels, and takes twice as long as `dual`. `dual` stays first: it is as good a start for the
adjustment that follows. Tracks with wrong members are for `robust.robust_triangulate`, which takes any of them.

`TRIANGULATIONS` lists (name on the command line, "module:function"), the recommended method first, so that names are known
without importing torch.
"""

import importlib
import math
from typing import TYPE_CHECKING, Any

from camera_models.errors import InputError

if TYPE_CHECKING:
    import omnilines.triangulation.observations
    import omnilines.triangulation.result

TRIANGULATIONS: tuple[tuple[str, str], ...] = (
    ("dual", "omnilines.triangulation.dual:triangulate"),
    ("averaging", "omnilines.triangulation.averaging:triangulate"),
    ("svd", "omnilines.triangulation.svd:triangulate"),
    ("ml", "omnilines.triangulation.likelihood:triangulate"),
)
WEIGHTS = ("unit", "published", "most-likely")
"""Of the rows of `dual`."""


def check_triangulation(method: str) -> None:
    """Raises InputError where no method has this name."""
    names = list(dict(TRIANGULATIONS))
    if method not in names:
        raise InputError(f"Expected a triangulation method among {', '.join(names)}, found {method!r}; give one of these names.")


def method_options(
    method: str, *, subset: int | None = None, bandwidth: float | None = None, weights: str | None = None
) -> dict[str, Any]:
    """The options of a method's function from those of the command line, None where not given; `weights="published"` is the
    published form as a whole, with the coordinates of the file.

    Raises InputError for an option that the method does not have, or a value that it does not take.
    """
    check_triangulation(method)
    given = {"subset": subset is not None, "bandwidth": bandwidth is not None, "weights": weights is not None}
    takes = {"averaging": ("subset", "bandwidth"), "dual": ("weights",)}
    for option in (name for name, is_given in given.items() if is_given):
        owner = next(name for name, options in takes.items() if option in options)
        if method != owner:
            raise InputError(
                f"`{option}` was expected with `triangulation` {owner} and only there, found {method}; correct the options."
            )
    if weights not in (None, *WEIGHTS):
        raise InputError(f"`weights` was expected among {', '.join(WEIGHTS)}, found '{weights}'; give one of these.")
    if subset is not None and subset < 2:
        raise InputError(f"`subset` was expected to be 2 planes or more, found {subset}; correct the option.")
    if bandwidth is not None and not 0 < bandwidth < math.inf:
        raise InputError(f"`bandwidth` was expected in radians above 0, found {bandwidth}; correct the option.")
    found: dict[str, Any] = {"subset": subset, "bandwidth": bandwidth, "weights": weights}
    if weights == "published":
        found["origin"] = "file"
    return {name: value for name, value in found.items() if value is not None}


def triangulate(
    method: str, observations: "omnilines.triangulation.observations.PlaneObservations", **options: Any
) -> "omnilines.triangulation.result.Triangulation":
    """The lines of all tracks by the named method; `options` are those of its function. Raises InputError on an unknown name."""
    check_triangulation(method)
    module, function = dict(TRIANGULATIONS)[method].split(":")
    result: omnilines.triangulation.result.Triangulation = getattr(importlib.import_module(module), function)(
        observations, **options
    )
    return result
