"""Photos of a target through any camera model: for every pixel, where does its ray meet the board?

The ray of a pixel is `unproject`ed, cut with the board's plane (only forwards along the ray, which may point more than 90
degrees off the axis) and given the target's mean reflectance over the footprint of the sample. Each pixel that sees the board is
divided into a grid of samples, and each sample integrates the target exactly over a box of its own footprint, so that
edges are area-sampled to far below a hundredth of a pixel. Rays inside a pixel are the second-order expansion of those of
the neighbouring pixel centres, whose error (third order in one over the focal length in pixels) is far below that again.
"""

from functools import lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from calib_patterns._pattern import Pattern
from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.pose import Pose

BLACK_GREY, WHITE_GREY = 30.0, 215.0
"""Grey levels of the print: noise of a few levels does not clip."""
_PIXELS_PER_TILE = 400_000


def pixel_grid(rows: range, width: int) -> Float[np.ndarray, "h w 2"]:
    """(u, v) of the pixel centres of some rows."""
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(rows.start, rows.stop, dtype=np.float64))
    return np.stack([u, v], -1)


# A set of photos of one camera needs its rays once; eight tiles hold 3 megapixels (80 MB), larger photos are computed anew.
@lru_cache(maxsize=8)
def _rays_of_rows(model: CameraModel, top: int, bottom: int) -> tuple[np.ndarray, np.ndarray]:
    """Bearings (rows, w, 3) and validity (rows, w) of the pixel centres of rows top to bottom, inside the photo or not."""
    with torch.no_grad():
        rays, valid = model.unproject(pixel_grid(range(top, bottom), model.image_size[0]))
    return np.asarray(rays), np.asarray(valid)


def points_on_board(
    rays: Float[np.ndarray, "*batch 3"], cam_from_board: Pose
) -> tuple[Float[np.ndarray, "*batch 2"], Bool[np.ndarray, "*batch"]]:
    """Where rays (of any scale, camera frame) meet the plane z = 0 of the board, metres, and whether they do, going forwards."""
    # In the board frame: X = C + s d with C the camera centre; z = 0 at s = -C_z / d_z.
    directions = rays @ cam_from_board.rotation.detach().numpy()
    centre = cam_from_board.centre.detach().numpy()
    down = directions[..., 2]
    meets = np.abs(down) > 1e-12
    scale = -centre[2] / np.where(meets, down, 1.0)
    return centre[:2] + scale[..., None] * directions[..., :2], meets & (scale > 0)


def _near_print(pattern: Pattern, points: Float[np.ndarray, "h w 2"], hits: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels whose centre, or whose neighbour's centre, lies on the printed sheet."""
    low = np.array(pattern.top_left_m)
    inside = hits & ((points >= low) & (points <= low + np.array(pattern.size_m))).all(-1)
    return cv2.dilate(inside.astype(np.uint8), np.ones((3, 3), dtype=np.uint8)).astype(bool)


def _sheet_cover(
    pattern: Pattern, points: Float[np.ndarray, "*batch 2"], footprint: Float[np.ndarray, "*batch 2"]
) -> Float[np.ndarray, "*batch"]:
    """Share of each box that lies on the printed sheet."""
    low = np.array(pattern.top_left_m)
    high = low + np.array(pattern.size_m)
    overlap = np.minimum(points + 0.5 * footprint, high) - np.maximum(points - 0.5 * footprint, low)
    return np.clip(overlap / np.maximum(footprint, 1e-12), 0.0, 1.0).prod(-1)


def _rays_in_pixels(
    rays: Float[np.ndarray, "h w 3"], inner: Bool[np.ndarray, "h w"], supersample: int
) -> Float[np.ndarray, "n s s 3"]:
    """Rays of a grid of samples in each chosen pixel, none at the border of the array, by expansion to second order."""
    row, column = np.nonzero(inner)
    centre = rays[row, column]
    right, left, below, above = rays[row, column + 1], rays[row, column - 1], rays[row + 1, column], rays[row - 1, column]
    mixed = rays[row + 1, column + 1] - rays[row + 1, column - 1] - rays[row - 1, column + 1] + rays[row - 1, column - 1]
    terms = np.stack(
        [centre, (right - left) / 2, (below - above) / 2, (right + left) / 2 - centre, (below + above) / 2 - centre, mixed / 4]
    )
    offsets = (np.arange(supersample) + 0.5) / supersample - 0.5
    du, dv = np.meshgrid(offsets, offsets)
    return np.einsum("tij,tnk->nijk", np.stack([np.ones_like(du), du, dv, du**2, dv**2, du * dv]), terms, optimize=True)


def _mean_over_boxes(
    pattern: Pattern, cam_from_board: Pose, points: Float[np.ndarray, "*batch 2"], footprint: Float[np.ndarray, "*batch 2"]
) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
    """Reflectance of the part of each box that the sheet covers, times that part; and that part."""
    cover = _sheet_cover(pattern, points, footprint)
    seen_from_front = float(cam_from_board.centre[2]) < 0
    return (cover * pattern.reflectance(points, footprint) if seen_from_front else cover), cover


def _sample_pixels(
    pattern: Pattern, cam_from_board: Pose, rays: Float[np.ndarray, "n s s 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The same, as the mean over the samples of each pixel."""
    points, hits = points_on_board(rays, cam_from_board)
    # Sides of the sample's parallelogram on the board; the box of the same second moments stands for it.
    footprint = np.sqrt(np.gradient(points, axis=2) ** 2 + np.gradient(points, axis=1) ** 2)
    reflected, cover = _mean_over_boxes(pattern, cam_from_board, points, footprint)
    whole = hits.all((1, 2))
    return np.where(whole, reflected.mean((1, 2)), 0.0), np.where(whole, cover.mean((1, 2)), 0.0)


def graded_background(model: CameraModel, rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """A smooth scene of no straight edges: waves of random direction, from half the photo down to about 20 px, in grey levels."""
    width, height = model.image_size
    # Drawn at a quarter of the size: its shortest wave is then still 5 px long.
    pixels = 4.0 * pixel_grid(range(-(-height // 4)), -(-width // 4))
    scene = np.full(pixels.shape[:2], 105.0)
    for wavelength in np.geomspace(max(0.5 * width, 40.0), 20.0, 8):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        bend = rng.uniform(-1.0, 1.0)
        along = pixels @ np.array([np.cos(angle), np.sin(angle)]) / wavelength
        across = pixels @ np.array([-np.sin(angle), np.cos(angle)]) / (2.3 * wavelength)
        scene += 12.0 * np.sin(2 * np.pi * along + phase + 3.0 * bend * np.sin(2 * np.pi * across))
    return cv2.resize(scene, (width, height), interpolation=cv2.INTER_CUBIC)


def render_target(
    pattern: Pattern,
    model: CameraModel,
    cam_from_board: Pose,
    *,
    supersample: int = 4,
    blur_px: float = 0.0,
    noise_grey: float = 0.0,
    vignetting: float = 0.0,
    background: Float[np.ndarray, "h w"] | None = None,
    seed: int = 0,
) -> UInt8[np.ndarray, "h w"]:
    """An 8-bit grey photo of one target at one pose.

    `blur_px` and `noise_grey` are standard deviations of a Gaussian blur and of white noise added after it (clipped to 0 to 255);
    `vignetting` is the share of light lost at the farthest image corner, growing with the square of the distance from the
    centre; `background` holds grey levels, by default a graded scene drawn from `seed`. Pixels that the model cannot
    unproject are black; a target seen from behind is a blank sheet. The same arguments give the same photo.
    Raises InputError when an option is out of range.
    """
    width, height = model.image_size
    rng = np.random.default_rng(seed)
    scene = graded_background(model, rng) if background is None else background.astype(np.float64)
    if supersample < 2 or blur_px < 0 or noise_grey < 0 or not 0 <= vignetting <= 1 or scene.shape != (height, width):
        raise InputError(
            f"Expected supersample >= 2, blur_px and noise_grey >= 0, vignetting 0 to 1, background of {(height, width)}, found "
            f"{supersample}, {blur_px}, {noise_grey}, {vignetting} and {scene.shape}; change the one out of range."
        )
    image = np.empty((height, width))
    rows_per_tile = max(8, _PIXELS_PER_TILE // width)
    for top in range(0, height, rows_per_tile):
        bottom = min(top + rows_per_tile, height)
        image[top:bottom] = _tile(pattern, model, cam_from_board, scene, (top, bottom), supersample)
    return _exposed(image, model, blur_px, noise_grey, vignetting, rng)


def _tile(
    pattern: Pattern,
    model: CameraModel,
    cam_from_board: Pose,
    scene: Float[np.ndarray, "h w"],
    rows: tuple[int, int],
    supersample: int,
) -> Float[np.ndarray, "rows w"]:
    """Grey levels of some rows before blur and noise."""
    # A row more on either side: the expansion inside a pixel needs its neighbours.
    rays, valid = _rays_of_rows(model, rows[0] - 1, rows[1] + 1)
    points, hits = points_on_board(rays, cam_from_board)
    surrounded = cv2.erode(valid.astype(np.uint8), np.ones((3, 3), dtype=np.uint8), borderValue=0).astype(bool)
    near = _near_print(pattern, points, hits & valid) & surrounded
    near[[0, -1]] = False
    near[:, [0, -1]] = False
    reflected, cover = np.zeros(near.shape), np.zeros(near.shape)
    # Most pixels see one colour only, also in a box of three times their footprint: one sample tells it.
    footprint = 3.0 * np.sqrt(np.gradient(points, axis=1) ** 2 + np.gradient(points, axis=0) ** 2)[near]
    reflected[near], cover[near] = _mean_over_boxes(pattern, cam_from_board, points[near], footprint)
    mixed = near & ~((cover > 1 - 1e-9) & ((reflected < 1e-9) | (reflected > 1 - 1e-9)))
    reflected[mixed], cover[mixed] = _sample_pixels(pattern, cam_from_board, _rays_in_pixels(rays, mixed, supersample))
    grey = np.zeros(valid.shape)
    grey[1:-1] = np.where(valid[1:-1], scene[rows[0] : rows[1]], 0.0)
    grey = BLACK_GREY * cover + (WHITE_GREY - BLACK_GREY) * reflected + (1.0 - cover) * grey
    return grey[1:-1]


def _exposed(
    image: Float[np.ndarray, "h w"],
    model: CameraModel,
    blur_px: float,
    noise_grey: float,
    vignetting: float,
    rng: np.random.Generator,
) -> UInt8[np.ndarray, "h w"]:
    """Blur, vignetting, noise and rounding to 8 bits."""
    if blur_px > 0:
        image = cv2.GaussianBlur(image, (0, 0), blur_px, borderType=cv2.BORDER_REPLICATE)
    if vignetting > 0:
        height, width = image.shape
        radius = np.linalg.norm(pixel_grid(range(height), width) - model.centre_px.detach().numpy(), axis=-1)
        image = image * (1.0 - vignetting * (radius / radius.max()) ** 2)
    if noise_grey > 0:
        image = image + rng.normal(0.0, noise_grey, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
