"""Costs of a line against its observed arcs: pure residual functions of the projection normal M in the camera frame.

Every cost is r = F M / |M| with a factor F of its own, so that one function, `sector.line_residual`, forms all Jacobians.
"""

# The dissertation's own first; the one that attains the Cramer-Rao bound second.
COSTS: tuple[tuple[str, str], ...] = (
    ("sector", "omnilines.costs.sector:prepare"),
    ("whitened", "omnilines.costs.whitened:prepare"),
)
