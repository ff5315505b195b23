"""The cost of Taylor and Kriegman on any camera (design section 5): the squared distance in pixels of the observed segment from
the line's image, integrated over the length of the segment.

    g = integral of h(s)^2 ds,   h(s) = (V(s) . M) / |J(s)' M|

V(s) runs along the great circle between the end bearings, ds is a pixel of its image and J(s) = d V / d pixel. The integral is
Gauss's, with NODES nodes; for a pinhole camera h is linear in s to first order and it is exact, l (h1^2 + h1 h2 + h2^2) / 3 for a
segment of length l (C. J. Taylor, D. J. Kriegman, PAMI 17(11), 1995). The residuals are the square roots of its terms.
"""

from torch import Tensor

from camera_models.errors import InputError
from omnilines.costs._cost import Cost, CostFunction, ObservedArcs, scaled_distance
from omnilines.geometry.sphere import points_on_arc


def of_arcs(arcs: ObservedArcs) -> CostFunction:
    """The cost of observed arcs, NODES residuals each, in pixels to the power of 3/2. Raises InputError without nodes."""
    nodes = arcs.nodes
    if nodes is None:
        raise InputError(
            "The Taylor-Kriegman cost needs the image of every arc between its ends, found arcs without; make them with "
            "arcs_from_segments or choose another cost."
        )
    spread, root = nodes.by_pixel @ nodes.by_pixel.mT, nodes.length_px.sqrt()

    def evaluate(bearings: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        h, by_normal = scaled_distance(points_on_arc(bearings[:, 0], bearings[:, 1], nodes.share), spread, normal)
        return root * h, root[..., None] * by_normal

    return evaluate


COST = Cost(of_arcs, integrates=True)
