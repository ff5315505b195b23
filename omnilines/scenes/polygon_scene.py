"""What a scene of polygons is: faces, how they reflect, where the lamps are, and where no camera can stand."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

GREY_WEIGHTS = np.array([0.299, 0.587, 0.114])
"""Grey level of an RGB colour (ITU-R BT.601, as cv2.cvtColor)."""


@dataclass(frozen=True)
class Texture:
    """A band-limited pattern of k plane waves on a face: 1 + sum a_i sin(2 pi f_i . (s, t) + phase_i)."""

    frequency_per_m: Float[np.ndarray, "k 2"]
    amplitude: Float[np.ndarray, " k"]
    phase_rad: Float[np.ndarray, " k"]


@dataclass(frozen=True)
class PhotoTexture:
    """A photograph on a face: its colour relative to its mean, and its halvings (`photo_texture`)."""

    levels: tuple[Float[np.ndarray, "_ _ 3"], ...]
    """RGB; rows along the second axis of the face, columns along its first side."""
    pixel_m: float
    """Size on the face of a pixel of the first level."""
    mean: Float[np.ndarray, "3"]
    """RGB grey levels."""


@dataclass(frozen=True)
class Lamps:
    """l lamps over a hemisphere of ambient light. Of a face with unit normal n at X, with v = lamp - X, the light is

    ambient + side (n . horizon) + up n_z + sum of strength max(0, n . v / |v|) / (1 + |v|^2 / reach^2).
    """

    position_m: Float[np.ndarray, "l 3"]
    strength: Float[np.ndarray, " l"]
    reach_m: Float[np.ndarray, " l"]
    ambient: float
    up: float
    side: Float[np.ndarray, "2"]
    """Along world x and y: sides of a box differ in brightness wherever it stands."""


@dataclass(frozen=True)
class Boxes:
    """b boxes in which, or nearer to which than the clearance of a camera, no camera stands."""

    centre_m: Float[np.ndarray, "b 3"]
    axes: Float[np.ndarray, "b 3 3"]
    """Rows are the unit axes of each box in the world."""
    half_m: Float[np.ndarray, "b 3"]

    def near(self, points_m: Float[np.ndarray, "n 3"], clearance_m: float) -> Bool[np.ndarray, " n"]:
        """Which points lie in a box or within the clearance of one."""
        local = np.einsum("bij,nbj->nbi", self.axes, points_m[:, None] - self.centre_m)
        outside = np.maximum(np.abs(local) - self.half_m, 0.0)
        return (np.linalg.norm(outside, axis=-1) < clearance_m).any(-1)


@dataclass(frozen=True)
class Dome:
    """Places round the world's origin, which photos from there look at."""

    distance_m: tuple[float, float]
    height_deg: tuple[float, float]
    """Of the camera above the horizontal, seen from the origin."""
    aside_deg: float
    """To either side of -y."""


@dataclass(frozen=True)
class PolygonScene:
    """p convex faces of four corners (a triangle repeats one), each seen from its front only; +z is up."""

    corners_m: Float[np.ndarray, "p 4 3"]
    """Counter-clockwise as seen from the front."""
    plane: Int[np.ndarray, " p"]
    """Faces of one plane share its number; their depths are compared exactly."""
    layer: Int[np.ndarray, " p"]
    """Of two faces in one plane the one of the higher layer is seen: paint."""
    surface: Int[np.ndarray, " p"]
    """Pieces of one surface share its number: where they meet there is no edge."""
    shows: Bool[np.ndarray, "p 4"]
    """Which sides (corner k to k + 1) are edges of the surface, not seams between its pieces."""
    albedo: Float[np.ndarray, "p 3"]
    """RGB grey levels under light of 1."""
    texture: Int[np.ndarray, " p"]
    """Index into `textures`."""
    textures: tuple[Texture | PhotoTexture, ...]
    lamps: Lamps
    sky: Float[np.ndarray, "2 3"]
    """RGB grey levels at the horizon and at the zenith where a ray meets nothing."""
    boxes: Boxes
    low_m: Float[np.ndarray, "3"]
    high_m: Float[np.ndarray, "3"]
    """Cameras stand between these corners."""
    walk_m: Float[np.ndarray, "k 3"] | None = None
    """Corners of the way along which photos are taken, at the height of the eye; without one cameras stand anywhere."""
    dome: Dome | None = None
    """Photos are taken from there, where it is given."""

    def __len__(self) -> int:
        return len(self.corners_m)
