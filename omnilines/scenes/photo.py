"""Photos of a scene of polygons through any camera model.

Tiles of the image are halved until a single face fills one or a single pixel is left; a tile is a cone of rays, and a face that
misses it, or lies behind one that covers it, is left out (`viewpoint.faces_in_cones`). No face is ever missed, however thin.
Pixels of one face take its colour at their centre; all others are shared among their faces by area (`coverage`). Grey levels
are mixed as they stand, without a tone curve, so that the middle of a step lies on the edge.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from camera_models import CameraModel, InputError
from camera_models.pose import Pose
from omnilines.scenes.appearance import colours
from omnilines.scenes.coverage import fragments
from omnilines.scenes.pixel_rays import PixelRays, pixel_rays, tile_cones, tile_grid, tile_sides
from omnilines.scenes.polygon_scene import PolygonScene
from omnilines.scenes.viewpoint import NO_FACE, Cones, Pairs, Viewpoint, faces_in_cones

DARK_GREY = 4.0
"""Where the lens sees nothing."""
_ROWS = 300_000
"""Pixels coloured at a time."""


@dataclass(frozen=True)
class Eye:
    """A camera and its rays, worked out once for all photos, with the cones of all tiles and which tiles see anything."""

    model: CameraModel
    largest_angle_rad: float
    """Half the angle across the image circle."""
    rays: PixelRays
    sides_px: tuple[int, ...]
    """Of the tiles, from the coarse ones to the fine ones."""
    tiles: tuple[tuple[Cones, np.ndarray], ...]

    def fine_tile(self, row: Int[np.ndarray, " n"], column: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
        """The fine tile of pixels."""
        side = self.sides_px[-1]
        return (row // side) * tile_grid(self.rays.shape, side)[1] + column // side


@lru_cache(maxsize=2)
def eye(model: CameraModel, largest_angle_rad: float) -> Eye:
    """The rays of a camera whose image circle ends at that angle off the bearing of its centre pixel."""
    rays = pixel_rays(model, largest_angle_rad)
    sides = tile_sides(model.image_size)
    return Eye(model, largest_angle_rad, rays, sides, tuple(tile_cones(rays, side) for side in sides))


@dataclass(frozen=True)
class TileFaces:
    """The face that fills each fine tile, row by row, or `NO_FACE`; and the faces that may be seen in each of those.

    Tiles inside a larger one that a face fills have no pairs.
    """

    pairs: Pairs
    whole: Int[np.ndarray, " n"]


def faces_of_tiles(view: Viewpoint, camera: Eye) -> TileFaces:
    """List what each tile may see, from the coarse tiles to the fine ones."""
    cones, seen = camera.tiles[0]
    cells = np.flatnonzero(seen)
    faces = view.front_faces
    pairs = Pairs(np.repeat(cells, len(faces)), np.tile(faces, len(cells)))
    pairs, whole = faces_in_cones(view, pairs, cones)
    for coarse, fine, (cones, _) in zip(camera.sides_px[:-1], camera.sides_px[1:], camera.tiles[1:], strict=True):
        rows, columns = tile_grid(camera.rays.shape, fine)
        i, j = np.divmod(np.arange(rows * columns), columns)
        parent = (i * fine // coarse) * tile_grid(camera.rays.shape, coarse)[1] + j * fine // coarse
        # A face that fills a tile fills its parts.
        filled = whole[parent]
        open_cells = np.flatnonzero(filled == NO_FACE)
        pairs = pairs.of_cells(parent[open_cells], len(whole))
        pairs, whole = faces_in_cones(view, pairs, Cones(cones.axis[open_cells], cones.sine[open_cells]))
        pairs = Pairs(open_cells[pairs.cell], pairs.face)
        filled[open_cells] = whole
        whole = filled
    return TileFaces(pairs, whole)


def render_clean(scene: PolygonScene, camera: Eye, cam_from_world: Pose) -> Float[np.ndarray, "h w 3"]:
    """RGB grey levels (single precision) before vignetting, blur and noise."""
    view = Viewpoint(scene, cam_from_world)
    tiles = faces_of_tiles(view, camera)
    height, width = camera.rays.shape
    image = np.full((height, width, 3), DARK_GREY, dtype=np.float32)
    row, column = np.nonzero(camera.rays.seen)
    tile = camera.fine_tile(row, column)
    face = tiles.whole[tile]
    for start in range(0, len(row), _ROWS):
        part = slice(start, start + _ROWS)
        image[row[part], column[part]] = _colour_pixels(view, camera, tiles, row[part], column[part], tile[part], face[part])
    return image


def _colour_pixels(
    view: Viewpoint,
    camera: Eye,
    tiles: TileFaces,
    row: Int[np.ndarray, " n"],
    column: Int[np.ndarray, " n"],
    tile: Int[np.ndarray, " n"],
    face: Int[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"]:
    """RGB grey levels of pixels in tiles, of which `face` fills the tile where it is one."""
    centre, right, down = camera.rays.of_pixels(row, column)
    pixel_rad = np.sqrt(0.5 * (np.einsum("ni,ni->n", right, right) + np.einsum("ni,ni->n", down, down)))
    face = face.copy()
    open_cells = np.flatnonzero(face == NO_FACE)
    pairs = tiles.pairs.of_cells(tile[open_cells], len(tiles.whole))
    length = np.linalg.norm(centre[open_cells], axis=-1)
    reach = 0.5 * (np.linalg.norm(right[open_cells], axis=-1) + np.linalg.norm(down[open_cells], axis=-1)) / length
    pairs, face[open_cells] = faces_in_cones(view, pairs, Cones(centre[open_cells] / length[:, None], np.minimum(reach, 1.0)))
    mixed = np.zeros(len(open_cells), dtype=bool)
    mixed[pairs.cell] = True
    mixed &= face[open_cells] == NO_FACE
    place = np.cumsum(mixed) - 1
    pairs = pairs.keep(mixed[pairs.cell])
    pairs = Pairs(place[pairs.cell], pairs.face)
    pixels = open_cells[mixed]
    result = np.empty((len(row), 3), dtype=np.float32)
    single = np.ones(len(row), dtype=bool)
    single[pixels] = False
    result[single] = colours(view, face[single], centre[single], pixel_rad[single])
    linear = (centre[pixels], right[pixels], down[pixels])
    result[pixels] = _shared(view, pairs, linear, pixel_rad[pixels])
    return result


def _shared(
    view: Viewpoint, pairs: Pairs, rays: tuple[np.ndarray, np.ndarray, np.ndarray], pixel_rad: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """RGB grey levels of pixels that show several faces, or one and the sky."""
    parts = fragments(view, pairs, rays)
    cell = parts.pairs.cell
    centre, right, down = (part[cell] for part in rays)
    middle = centre + parts.offset_px[:, :1] * right + parts.offset_px[:, 1:] * down
    colour = parts.share[:, None] * colours(view, parts.pairs.face, middle, pixel_rad[cell])
    count = len(pixel_rad)
    # bincount of nothing counts in whole numbers.
    total = np.stack([np.bincount(cell, colour[:, k], count) for k in range(3)], -1).astype(np.float64)
    left = 1.0 - np.bincount(cell, parts.share, count)
    open_sky = np.flatnonzero(left > 1e-9)
    sky = colours(view, np.full(len(open_sky), NO_FACE), rays[0][open_sky])
    total[open_sky] += left[open_sky, None] * sky
    return total


def vignette(camera: Eye, strength: float) -> Float[np.ndarray, "h w"]:
    """Share of the light that reaches each pixel: 1 at the centre, 1 - strength at the farthest corner, a parabola between."""
    height, width = camera.rays.shape
    cx, cy = camera.model.centre_px.detach().tolist()
    square = (np.arange(width) - cx) ** 2 + ((np.arange(height) - cy) ** 2)[:, None]
    return 1.0 - strength * square / camera.model.image_radius_px**2


def render_photo(
    scene: PolygonScene,
    camera: Eye,
    cam_from_world: Pose,
    *,
    blur_px: float = 0.0,
    noise_grey: float = 0.0,
    vignetting: float = 0.0,
    seed: int | list[int] = 0,
) -> UInt8[np.ndarray, "h w 3"]:
    """An 8-bit colour photo (BGR, as OpenCV has it). The same arguments give the same photo.

    `blur_px` and `noise_grey` are standard deviations of a Gaussian blur and of white noise in each channel, added after it;
    `vignetting` is the share of light lost at the farthest image corner. Raises InputError when an option is out of range.
    """
    if blur_px < 0 or noise_grey < 0 or not 0 <= vignetting <= 1:
        raise InputError(
            f"A blur and a noise of at least 0 and a vignetting of 0 to 1 were expected, found {blur_px:g}, {noise_grey:g} and "
            f"{vignetting:g}; change the one out of range."
        )
    image = render_clean(scene, camera, cam_from_world)[..., ::-1]
    image = image * vignette(camera, vignetting)[..., None].astype(np.float32)
    if blur_px > 0:
        image = cv2.GaussianBlur(image, (0, 0), blur_px, borderType=cv2.BORDER_REPLICATE)
    if noise_grey > 0:
        image += noise_grey * np.random.default_rng(seed).standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
