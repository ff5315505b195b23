"""Costs of arcs when the camera moves that turns their pixels into bearings.

Noise lies in pixels, so a camera has to be judged by distances in pixels, h = (V . M) / |J' M| (or in standard deviations of
pixels). Two things bias it otherwise, each by a term that has one sign in all observations and adds up:

The derivative. With the bearing V of the pixel p and g = d (V . M) / d parameters at a fixed pixel,
d h = (g - h d|J' M|) / |J' M|. Its second term correlates with h. It is what g changes by from p to the foot of its perpendicular
on the line's image, so that d h is g at the foot over |J' M|, to first order in h: g = -M' J d pixel / d parameters there.

The weights. Costs in radians, or by the length of the arc, shrink where the camera makes all angles smaller. Of these the weights
G in r = G h are taken once and held during a solve, then formed anew (iteratively reweighted least squares).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models import CameraModel
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.costs import cost_function, cost_named
from omnilines.costs._cost import by_bearings


def distance_by_parameters(
    model: CameraModel,
    bearings: Float[Tensor, "n 2 3"],
    by_pixel: Float[Tensor, "n 2 3 2"],
    normal: Float[Tensor, "n 3"],
    covariance_px2: Float[Tensor, "n 2 2 2"] | None,
) -> Float[Tensor, "n 2 p"]:
    """d h / d camera parameters at fixed pixels and a fixed line, h in pixels or, with a covariance, in standard deviations.

    An end whose foot lies outside the domain of the model is taken where it is.
    """
    m = (normal / normal.norm(dim=-1, keepdim=True))[:, None, :, None]
    gradient = by_pixel.mT @ m
    downhill = gradient if covariance_px2 is None else covariance_px2 @ gradient
    width2 = (gradient.mT @ downhill)[..., 0, 0]
    across = (bearings[..., None, :] @ m)[..., 0, 0]
    foot = bearings - (by_pixel @ downhill)[..., 0] * (across / width2)[..., None]
    on_line = foot - (foot[..., None, :] @ m)[..., 0] * m[..., 0]
    on_line = on_line / on_line.norm(dim=-1, keepdim=True)
    _, inside = model.project(on_line)
    place = torch.where(inside[..., None], on_line, bearings)
    _, _, by_point, by_parameter = model.project_with_jacobians(place)
    # J' M at the foot: it stands on the image of the line and gives 1 for the image of M.
    along = (by_point @ torch.linalg.cross(m[..., 0].expand_as(place), place)[..., None])[..., 0]
    upright = torch.stack([-along[..., 1], along[..., 0]], -1)[..., None]
    rise = (by_point @ m)[..., 0]
    at_foot = upright / (rise[..., None, :] @ upright)
    return -(at_foot.mT @ by_parameter)[..., 0, :] / width2.sqrt()[..., None]


def weights_to_hold(
    cost: str, arcs: MatchedArcs, normal: Float[Tensor, "n 3"], mix: Float[Tensor, "n m 2"] | None = None
) -> Float[Tensor, "n m 2"] | None:
    """G at one state, r = G h with the distances h (px) of both ends: of the cost, or of residuals mix @ (V . Mh) where a `mix`
    is given; None for costs that are these distances."""
    if mix is None and cost_named(cost).distances_in:
        return None
    m = normal / normal.norm(dim=-1, keepdim=True)
    width = (arcs.by_pixel.mT @ m[:, None, :, None])[..., 0].norm(dim=-1)
    if mix is None:
        mix = (by_bearings(cost_function(cost, arcs), arcs.bearings, m) @ m[:, None, :, None])[..., 0]
    return mix * width[:, None]
