"""Photographs as textures of faces, so that real foliage, gravel, carpet, brick or prints are seen with known edges.

One photograph is repeated over a face at a stated size, every second time mirrored, so that it has no seams. Seen from afar, or
at a slant, it is taken from its halvings (L. Williams, Pyramidal parametrics, SIGGRAPH 1983): between the two whose pixels are
next to the longer side of the footprint of the photo's pixel.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt

from camera_models import InputError
from omnilines.scenes.polygon_scene import PhotoTexture, PolygonScene
from omnilines.synthetic.targets import generator

PLACES = ("walls", "floors", "ceilings", "furniture")
PHOTO_WIDTH_M = 1.5
SMALLEST_PX = 16
_LARGEST_PX = 2048
_WALL_M2, _LEAST_M2 = 3.0, 0.05
"""Surfaces from the first size on are walls, floors and ceilings; from the second on furniture; smaller ones stay as they are."""
_LEVEL_Z = 0.9


def photo_texture(photo: UInt[np.ndarray, "h w *channels"], width_m: float) -> PhotoTexture:
    """A photograph (grey or BGR, 8 or 16 bits) of that width on a face. Raises InputError where either is too small."""
    height, width = photo.shape[:2]
    if min(height, width) < SMALLEST_PX or not width_m > 0:
        raise InputError(
            f"A photograph of {SMALLEST_PX}x{SMALLEST_PX} px or more and a width above 0 m were expected for a texture, found "
            f"{width}x{height} px and {width_m:g} m; change the one that is too small."
        )
    colour = photo if photo.ndim == 3 else np.repeat(photo[..., None], 3, 2)
    pixels = colour[..., ::-1].astype(np.float32) / np.float32(257.0 if photo.dtype == np.uint16 else 1.0)
    shrink = min(1.0, _LARGEST_PX / max(height, width))
    levels = [cv2.resize(pixels, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1 else pixels]
    pixel_m = width_m / levels[0].shape[1]
    mean = np.maximum(levels[0].mean((0, 1)), 1.0)
    levels[0] = levels[0] / mean
    while min(levels[-1].shape[:2]) >= 2:
        half = levels[-1].shape[1] // 2, levels[-1].shape[0] // 2
        levels.append(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA))
    return PhotoTexture(tuple(levels), pixel_m, mean.astype(np.float64))


def with_photographs(
    scene: PolygonScene,
    photos: Sequence[UInt[np.ndarray, "..."]],
    seed: int,
    width_m: float = PHOTO_WIDTH_M,
    places: Sequence[str] = PLACES,
) -> PolygonScene:
    """The scene with a photograph, drawn from the seed, on every surface of some of PLACES; its edges stay as they are.

    The colour of such a face in tables of contrast is the mean of its photograph. Raises InputError for an unknown place,
    without photographs, and for one that is too small.
    """
    unknown = [place for place in places if place not in PLACES]
    if unknown or not places or not photos:
        found = f"'{unknown[0]}'" if unknown else "none"
        raise InputError(f"Photographs for some of {', '.join(PLACES)} were expected, found {found}; give both.")
    textures = [photo_texture(photo, width_m) for photo in photos]
    surfaces = int(scene.surface.max()) + 1
    choice = generator(seed, "photographs").integers(len(textures), size=surfaces)
    chosen = np.isin(_places_of(scene), [PLACES.index(place) for place in places])
    rows = np.flatnonzero(chosen[scene.surface])
    texture, albedo = scene.texture.copy(), scene.albedo.copy()
    which = choice[scene.surface[rows]]
    texture[rows] = len(scene.textures) + which
    albedo[rows] = np.stack([texture.mean for texture in textures])[which]
    return replace(scene, textures=(*scene.textures, *textures), texture=texture, albedo=albedo)


def _places_of(scene: PolygonScene) -> Int[np.ndarray, " surfaces"]:
    """Index of each surface into PLACES, by its size and where it faces, or -1."""
    first = scene.corners_m[:, 0]
    # Half the cross product of the diagonals of a quadrangle is its area.
    across = np.cross(scene.corners_m[:, 2] - first, scene.corners_m[:, 3] - scene.corners_m[:, 1])
    area = 0.5 * np.linalg.norm(across, axis=-1)
    total = np.bincount(scene.surface, area)
    upward = np.bincount(scene.surface, 0.5 * across[:, 2]) / np.maximum(total, 1e-12)
    large = np.where(upward > _LEVEL_Z, 1, np.where(upward < -_LEVEL_Z, 2, 0))
    return np.where(total >= _WALL_M2, large, np.where(total >= _LEAST_M2, 3, -1))


def photo_factor(
    texture: PhotoTexture, plane_m: Float[np.ndarray, "2 n"], footprint_m: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Colour of the photograph, relative to its mean, at points of a face, for pixels of that footprint."""
    level = np.log2(np.maximum(footprint_m / texture.pixel_m, 1.0)).clip(max=len(texture.levels) - 1)
    lower = np.floor(level).astype(np.int64)
    result = np.empty((len(level), 3), dtype=np.float32)
    for k in np.unique(lower).tolist():
        rows = np.flatnonzero(lower == k)
        share = (level[rows] - k)[:, None].astype(np.float32)
        upper = min(k + 1, len(texture.levels) - 1)
        near, far = (_bilinear(texture, j, plane_m[:, rows]) for j in (k, upper))
        result[rows] = near + share * (far - near)
    return result


def _bilinear(texture: PhotoTexture, level: int, plane_m: Float[np.ndarray, "2 n"]) -> Float[np.ndarray, "n 3"]:
    pixels = texture.levels[level]
    lows, highs, shares = [], [], []
    for position, size, finest in zip(plane_m, (pixels.shape[1], pixels.shape[0]), texture.levels[0].shape[1::-1], strict=True):
        # From 0 to 2 sizes and back: mirrored at each end. The pixels' centres lie at halves.
        turn = np.mod(position / (texture.pixel_m * finest), 2.0) * size
        at = np.minimum(turn, 2 * size - turn) - 0.5
        low = np.floor(at)
        shares.append((at - low).astype(np.float32)[:, None])
        lows.append(low.astype(np.int64).clip(0, size - 1))
        highs.append((low.astype(np.int64) + 1).clip(0, size - 1))
    top = pixels[lows[1], lows[0]] * (1 - shares[0]) + pixels[lows[1], highs[0]] * shares[0]
    bottom = pixels[highs[1], lows[0]] * (1 - shares[0]) + pixels[highs[1], highs[0]] * shares[0]
    return top * (1 - shares[1]) + bottom * shares[1]
