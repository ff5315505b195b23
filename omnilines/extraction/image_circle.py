"""The image circle of a lens or mirror, found in the photo: beyond it all is dark."""

import functools
import math

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt

from camera_models import CameraModel
from omnilines.extraction.edgels import grey_unit
from omnilines.extraction.kernels.rim import Rays, first_light, light_outside
from omnilines.extraction.options import ImageCircleOptions

RAYS = 360
"""From the border inwards."""
LOOKED_AT = 1000
"""Rows and columns, about, whose pixels are looked at in a larger photo."""
MASK_MARGIN_PX = 3
"""Left out beside what a mask leaves out: the reach of the derivatives."""
_BESIDE_PX = 3.0
_TRIPLES = 500


def image_circle(
    image: UInt[np.ndarray, "h w *channels"], model: CameraModel, options: ImageCircleOptions = ImageCircleOptions()
) -> tuple[float, float, float] | None:
    """Centre (u, v) and radius (px) of the circle outside which a photo of this camera is dark, or None where there is none."""
    return None if model.PERIODIC else circle_around(image, model.centre_px.detach().numpy(), options)


def circle_around(
    image: UInt[np.ndarray, "h w *channels"], centre: Float[np.ndarray, "2"], options: ImageCircleOptions = ImageCircleOptions()
) -> tuple[float, float, float] | None:
    """Centre (u, v) and radius (px) of the circle around a pixel outside which a photo is dark, or None where there is none.

    From the border inwards along rays to that pixel, each finds its first light. Where most of those that begin
    in the dark find it on one circle (the best of random triples), and all is dark outside it, that is the rim; others met a dark
    part of the scene.
    """
    height, width = image.shape[:2]
    if not (0 < centre[0] < width - 1 and 0 < centre[1] < height - 1):
        return None
    turn = 2.0 * np.pi * np.arange(RAYS) / RAYS
    way = np.stack([np.cos(turn), np.sin(turn)], -1)
    room = np.where(way > 0, np.array([width, height]) - 1.0 - centre, centre) / np.maximum(np.abs(way), 1e-12)
    border = room.min(-1) - 1.0
    threshold = _least_light(_brightest(image, _outermost(centre, border, way, options)) / grey_unit(image), options)
    if threshold >= options.max_dark_grey:
        return None
    threshold *= grey_unit(image)
    depths = int(border.max())
    light = first_light(image.reshape(height, width, -1), Rays(centre, way, border), depths, threshold)
    begins_dark = (light >= options.min_dark_px) & (light < depths)
    if begins_dark.mean() < options.min_dark_rays:
        return None
    circle = _common_circle(centre + (border - light)[begins_dark, None] * way[begins_dark], options)
    return circle if circle is not None and _dark_outside(image, circle, options) else None


def _outermost(
    centre: Float[np.ndarray, "2"], border_px: Float[np.ndarray, " n"], way: Float[np.ndarray, "n 2"], options: ImageCircleOptions
) -> Float[np.ndarray, "n k 2"]:
    """Twice as many pixels of rays, from the border inwards, as are to be dark."""
    depth = np.arange(2 * max(2, options.min_dark_px))
    return centre + np.maximum(border_px[:, None] - depth, 0.0)[..., None] * way[:, None]


def _least_light(grey: Float[np.ndarray, "n k"], options: ImageCircleOptions) -> float:
    """Grey level from which on the outermost pixels of rays are light, of 255; infinite where too few rays begin in the dark.

    Noise in the dark is no light: it is how bright it gets on the darkest rays, in pixels that did not choose them. Rays that
    meet light soon are none of them: beside it, sharpening and JPEG make the dark darker.
    """
    depth_px, count = grey.shape[1] // 2, max(1, int(options.min_dark_rays * len(grey)))
    outer, inner = grey[:, : depth_px // 2], grey[:, depth_px // 2 : depth_px]
    rows = np.flatnonzero(grey.max(-1) < options.max_dark_grey)
    if len(rows) < count:
        return math.inf
    darkest = inner[rows[np.argsort(outer[rows].mean(-1), kind="stable")[:count]]]
    return max(float(np.percentile(outer, 2)) + options.min_step_grey, float(np.percentile(darkest, 98)))


def _brightest(image: UInt[np.ndarray, "h w *channels"], places: Float[np.ndarray, "*n 2"]) -> UInt[np.ndarray, "*n"]:
    """The largest of the channels at the pixels nearest to places (u, v); beyond the border that of the border."""
    column, row = (np.rint(places[..., k]).astype(np.int64) for k in (0, 1))
    height, width = image.shape[:2]
    grey = image.reshape(height * width, -1)[row.clip(0, height - 1) * width + column.clip(0, width - 1)]
    return functools.reduce(np.maximum, np.moveaxis(grey, -1, 0))


def _dark_outside(
    image: UInt[np.ndarray, "h w *channels"], circle: tuple[float, float, float], options: ImageCircleOptions
) -> bool:
    """Whether hardly any pixel outside the circle is light, and some are outside."""
    (u, v, radius), (height, width) = circle, image.shape[:2]
    step, threshold = max(1, max(height, width) // LOOKED_AT), options.max_dark_grey * grey_unit(image)
    beyond = radius * (1.0 + options.same_share)
    outside, light = light_outside(image.reshape(height, width, -1), step, u, v, beyond, threshold)
    return outside > 0 and light < options.max_light * outside


def _common_circle(points: Float[np.ndarray, "n 2"], options: ImageCircleOptions) -> tuple[float, float, float] | None:
    """The circle on which most of the points lie."""
    rng = np.random.default_rng(0)
    a, b, c = points[rng.integers(0, len(points), (3, _TRIPLES))]
    # |p|^2 = 2 p . m + k, differences of it.
    matrix = 2.0 * np.stack([b - a, c - a], -2)
    right = np.stack([(b * b - a * a).sum(-1), (c * c - a * a).sum(-1)], -1)
    proper = np.abs(np.linalg.det(matrix)) > 1.0
    if not proper.any():
        return None
    middle = np.linalg.solve(matrix[proper], right[proper][..., None])[..., 0]
    radius = np.linalg.norm(a[proper] - middle, axis=-1)
    off = np.abs(np.linalg.norm(points - middle[:, None], axis=-1) - radius[:, None])
    agreeing = off < options.same_share * radius[:, None]
    best = int(agreeing.sum(-1).argmax())
    if agreeing[best].mean() < options.min_agreeing:
        return None
    chosen = points[agreeing[best]]
    design = np.concatenate([2.0 * chosen, np.ones((len(chosen), 1))], -1)
    u, v, k = np.linalg.lstsq(design, (chosen**2).sum(-1), rcond=None)[0]
    return float(u), float(v), float(np.sqrt(k + u * u + v * v))


def usable_pixels(
    shape: tuple[int, int],
    circle: tuple[float, float, float] | None,
    mask: Bool[np.ndarray, "h w"] | None,
    options: ImageCircleOptions,
) -> Bool[np.ndarray, "h w"]:
    """Pixels at which an edge may be one of the scene: not near the rim of the image circle, nor near what `mask` leaves out."""
    height, width = shape
    allowed = np.ones((height, width), dtype=np.uint8)
    if circle is not None:
        u, v, radius = circle
        inner = radius - margin_px(radius, options)
        allowed[:] = (np.arange(width) - u) ** 2 + ((np.arange(height) - v) ** 2)[:, None] <= inner**2
    if mask is not None:
        side = 2 * MASK_MARGIN_PX + 1
        allowed *= cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8), borderValue=1).astype(np.uint8)
    return allowed.astype(bool)


def margin_px(radius: float, options: ImageCircleOptions) -> float:
    """What is left out inside the rim."""
    return max(options.margin_px, options.margin_share * radius)


def rim_width(image: UInt[np.ndarray, "h w *channels"], circle: tuple[float, float, float], options: ImageCircleOptions) -> float:
    """Pixels from the first light inwards over which the light rises: the median of all directions at each depth."""
    u, v, radius = circle
    turn = 2.0 * np.pi * np.arange(RAYS) / RAYS
    depth = np.arange(max(int(options.slope_share * radius), 2))
    place = (radius - depth)[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], -1) + np.array([u, v])
    height, width = image.shape[:2]
    inside = ((place >= 0) & (place <= np.array([width, height]) - 1.0)).all((0, 2))
    if not inside.any():
        return float(depth[-1])
    light = np.median(_brightest(image, place[:, inside]).astype(np.float64), axis=1)
    full = light >= options.full_light * light[-1]
    return float(full.argmax())


def follows_rim(
    image: UInt[np.ndarray, "h w *channels"],
    circle: tuple[float, float, float],
    points: Float[np.ndarray, "n 4"],
    min_cosine: float,
    options: ImageCircleOptions,
) -> Bool[np.ndarray, " n"]:
    """Which edge points (u, v, direction across) belong to the rim: near it, along it (the cosine of the
    direction across and the radius is more than `min_cosine`), and darker outside.

    The rim of many lenses is no step but a slope of many pixels, with edges of its own.
    """
    u, v, radius = circle
    rim = radius - margin_px(radius, options) - rim_width(image, circle, options)
    outwards = points[:, :2] - np.array([u, v])
    distance = np.maximum(np.linalg.norm(outwards, axis=-1), 1e-9)
    outwards /= distance[:, None]
    along = np.abs((outwards * points[:, 2:]).sum(-1)) > min_cosine
    rows = np.flatnonzero((distance > rim) & along)
    inner, outer = (_brightest(image, points[rows, :2] + side * _BESIDE_PX * outwards[rows]) for side in (-1, 1))
    result = np.zeros(len(points), dtype=bool)
    result[rows] = outer < inner
    return result
