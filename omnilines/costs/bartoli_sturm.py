"""The cost of Bartoli and Sturm on any camera (design section 5): orthogonal distances in pixels of both observed end points.

    h_i = (V_i . M) / |J_i' M|,   J_i = d V_i / d pixel

For a pinhole camera it agrees with the distance of the end points from the line's image (A. Bartoli, P. Sturm, CVIU 100(3), 2005)
to first order; where the noise is isotropic it is the whitened cost but for its unit.
"""

from torch import Tensor

from omnilines.costs._cost import CostFunction, ObservedArcs, scaled_distance


def of_arcs(arcs: ObservedArcs) -> CostFunction:
    """The cost of observed arcs, two residuals each, in pixels."""
    spread = arcs.by_pixel @ arcs.by_pixel.mT

    def evaluate(bearings: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        return scaled_distance(bearings, spread, normal)

    return evaluate
