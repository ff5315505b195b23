"""Costs of a line against its observed arcs: pure residual functions of the projection normal M in the camera frame.

`COSTS` lists (name on the command line, "module:object"), so that names are known without importing torch; the object is a
`_cost.Cost`, which says all that the rest needs to know of it. To add one is to write its module and its line here.
"""

import importlib
from typing import TYPE_CHECKING

from camera_models.errors import InputError

if TYPE_CHECKING:
    from omnilines.costs._cost import Cost, CostFunction, ObservedArcs

# The dissertation's own first; the one that attains the Cramer-Rao bound second; then the published image-plane costs.
COSTS: tuple[tuple[str, str], ...] = (
    ("sector", "omnilines.costs.sector:COST"),
    ("whitened", "omnilines.costs.whitened:COST"),
    ("taylor-kriegman", "omnilines.costs.taylor_kriegman:COST"),
    ("bartoli-sturm", "omnilines.costs.bartoli_sturm:COST"),
)
WHITENED = "whitened"
"""The cost whose residuals are standard deviations: the noise is judged, and uncertainty stated, by it whatever the cost is."""
IN_PIXELS = "bartoli-sturm"
"""The cost whose residuals are pixels: cameras that move are judged by it."""


def check_cost(name: str) -> None:
    """Raises InputError where no cost has this name."""
    if name not in dict(COSTS):
        raise InputError(f"A cost is one of {', '.join(dict(COSTS))}, found '{name}'; choose one of these.")


def cost_named(name: str) -> "Cost":
    """Raises InputError on an unknown name."""
    check_cost(name)
    module, attribute = dict(COSTS)[name].split(":")
    cost: Cost = getattr(importlib.import_module(module), attribute)
    return cost


def cost_function(name: str, arcs: "ObservedArcs") -> "CostFunction":
    """The named cost of observed arcs. Raises InputError on an unknown name."""
    return cost_named(name).of_arcs(arcs)
