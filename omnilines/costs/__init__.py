"""Costs of a line against its observed arcs: pure residual functions of the projection normal M in the camera frame.

`COSTS` lists (name on the command line, "module:function"), so that names are known without importing torch; the function turns
observed arcs into a cost (`_cost.CostFunction`).
"""

import importlib
from typing import TYPE_CHECKING

from camera_models.errors import InputError

if TYPE_CHECKING:
    from omnilines.costs._cost import CostFunction, ObservedArcs

# The dissertation's own first; the one that attains the Cramer-Rao bound second; then the published image-plane costs.
COSTS: tuple[tuple[str, str], ...] = (
    ("sector", "omnilines.costs.sector:of_arcs"),
    ("whitened", "omnilines.costs.whitened:of_arcs"),
    ("taylor-kriegman", "omnilines.costs.taylor_kriegman:of_arcs"),
    ("bartoli-sturm", "omnilines.costs.bartoli_sturm:of_arcs"),
)


def check_cost(name: str) -> None:
    """Raises InputError where no cost has this name."""
    if name not in dict(COSTS):
        raise InputError(f"A cost is one of {', '.join(dict(COSTS))}, found '{name}'; choose one of these.")


def cost_function(name: str, arcs: "ObservedArcs") -> "CostFunction":
    """The named cost of observed arcs. Raises InputError on an unknown name."""
    check_cost(name)
    module, function = dict(COSTS)[name].split(":")
    cost: CostFunction = getattr(importlib.import_module(module), function)(arcs)
    return cost
