"""Colour of faces: paint, light and a band-limited texture, which makes no edge where no face ends, or a photograph."""

import math

import numpy as np
from jaxtyping import Float, Int

from omnilines.scenes.photo_texture import photo_factor
from omnilines.scenes.polygon_scene import PhotoTexture, PolygonScene, Texture
from omnilines.scenes.viewpoint import NO_FACE, Viewpoint

_FOOTPRINT_SIGMA = 0.5
"""Standard deviation of the Gaussian that filters texture, in pixels: a wave of 2 px keeps 3 in 10 of its amplitude."""
_FAINT = 5e-4
"""Relative amplitude below which a filtered wave is left out: under a tenth of a grey level."""


def light(scene: PolygonScene, normal: Float[np.ndarray, "n 3"], points_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """The light on faces of those unit normals at those points (`Lamps`)."""
    lamps = scene.lamps
    total = lamps.ambient + normal @ np.append(lamps.side, lamps.up).astype(normal.dtype)
    for position, strength, reach in zip(lamps.position_m, lamps.strength, lamps.reach_m, strict=True):
        towards = position.astype(points_m.dtype) - points_m
        square = np.einsum("ni,ni->n", towards, towards)
        cosine = np.maximum(np.einsum("ni,ni->n", normal, towards), 0.0) / np.sqrt(square)
        total += float(strength) * cosine / (1.0 + square / float(reach) ** 2)
    return total


def sky_colour(scene: PolygonScene, up: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """RGB grey levels of the sky for unit rays of that vertical component."""
    height = np.clip(up, 0.0, 1.0)[:, None]
    return scene.sky[0] + height * (scene.sky[1] - scene.sky[0])


def colours(
    view: Viewpoint,
    faces: Int[np.ndarray, " n"],
    rays: Float[np.ndarray, "n 3"],
    pixel_rad: Float[np.ndarray, " n"] | None = None,
) -> Float[np.ndarray, "n 3"]:
    """RGB grey levels (single precision) that rays (camera frame) bring from faces, or from the sky for `NO_FACE`.

    `pixel_rad` is the angle of a pixel, for the texture; without it there is none.
    """
    scene = view.scene
    result = np.empty((len(faces), 3), dtype=np.float32)
    sky = np.flatnonzero(faces == NO_FACE)
    unit = rays[sky] / np.linalg.norm(rays[sky], axis=-1, keepdims=True)
    result[sky] = sky_colour(scene, unit @ view.world_from_cam[2])
    hit = np.flatnonzero(faces != NO_FACE)
    face, ray = faces[hit], rays[hit].astype(np.float32)
    points, scale = view.points_m(face, ray)
    normal = view.normal.astype(np.float32)[face]
    brightness = light(scene, normal, points)[:, None]
    if pixel_rad is not None:
        # The longer side of the pixel's footprint: across the face at its slant, which is n . ray / |ray|.
        square = np.einsum("ni,ni->n", ray, ray)
        slant = np.abs(np.einsum("ni,ni->n", normal, points - view.centre_m.astype(np.float32))) / scale
        footprint = pixel_rad[hit].astype(np.float32) * scale * square / np.maximum(slant, 0.02)
        brightness = brightness * _texture(scene, face, points, footprint)
    result[hit] = scene.albedo.astype(np.float32)[face] * brightness
    return np.clip(result, 0.0, 255.0, out=result)


def _texture(
    scene: PolygonScene,
    faces: Int[np.ndarray, " n"],
    points_m: Float[np.ndarray, "n 3"],
    footprint_m: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n channels"]:
    """1 + the waves of each face's texture at its points, each weakened as a pixel of that footprint sees it; or a photograph."""
    photographs = any(isinstance(texture, PhotoTexture) for texture in scene.textures)
    factor = np.ones((len(faces), 3 if photographs else 1), dtype=np.float32)
    axes = _texture_axes(scene)
    kind = scene.texture[faces]
    for index, texture in enumerate(scene.textures):
        rows = np.flatnonzero(kind == index)
        if len(rows):
            # A shift of each surface's own; small, since single precision has to tell a millimetre from the next.
            shift = np.float32(1.37) * (scene.surface[faces[rows]] % 8).astype(np.float32)
            plane = np.einsum("nki,ni->kn", axes[faces[rows]], points_m[rows]) + shift
            if isinstance(texture, PhotoTexture):
                factor[rows] = photo_factor(texture, plane, footprint_m[rows])
            else:
                factor[rows] += _waves(texture, plane, footprint_m[rows])[:, None]
    return factor


def _texture_axes(scene: PolygonScene) -> Float[np.ndarray, "p 2 3"]:
    """Unit vectors along the first side of each face and across it.

    Pieces of one surface have parallel sides: measured from the world's origin, their texture runs on across the seams.
    """
    first = scene.corners_m[:, 0]
    along = scene.corners_m[:, 1] - first
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    normal = np.cross(along, scene.corners_m[:, 2] - first)
    across = np.cross(normal / np.linalg.norm(normal, axis=-1, keepdims=True), along)
    return np.stack([along, across], 1).astype(np.float32)


def _waves(texture: Texture, plane_m: Float[np.ndarray, "2 n"], footprint_m: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    total = np.zeros(plane_m.shape[1], dtype=np.float32)
    for (along, across), amplitude, phase in zip(
        texture.frequency_per_m.tolist(), texture.amplitude.tolist(), texture.phase_rad.tolist(), strict=True
    ):
        spread = 2.0 * math.pi * math.hypot(along, across) * _FOOTPRINT_SIGMA
        sharp = spread * footprint_m < math.sqrt(2.0 * math.log(max(amplitude / _FAINT, 1.0)))
        rows = slice(None) if sharp.all() else np.flatnonzero(sharp)
        weight = amplitude * np.exp(-0.5 * (spread * footprint_m[rows]) ** 2)
        angle = 2.0 * math.pi * (along * plane_m[0, rows] + across * plane_m[1, rows]) + phase
        total[rows] += weight * np.sin(angle)
    return total


def texture(
    rng: np.random.Generator, contrast: float, coarsest_m: float, finest_m: float, stretch: float = 1.0, *, waves: int = 8
) -> Texture:
    """A texture of that root mean square contrast, of waves in all directions between two wavelengths, longer along s."""
    wavelength = np.geomspace(coarsest_m, finest_m, waves) * rng.uniform(0.9, 1.1, waves)
    # Directions spread over the half circle, in random order: no direction stands out.
    angle = math.pi * (rng.permutation(waves) + rng.uniform(0.2, 0.8, waves)) / waves
    frequency = np.stack([np.cos(angle) / stretch, np.sin(angle)], -1) / wavelength[:, None]
    amplitude = np.full(waves, contrast * math.sqrt(2.0 / waves))
    return Texture(frequency, amplitude, rng.uniform(0.0, 2.0 * math.pi, waves))
