"""GeoJSON (RFC 7946): the known lines as LineStrings of longitude, latitude (degrees) and height above WGS84's ellipsoid (m).

The scene's x, y, z are metres east, north and up of an origin.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from camera_models import InputError
from camera_models.formats.disk import write_atomically
from camera_models.wording import rounded
from omnilines.files.scene_folder import Z_UP, SceneTables
from omnilines.geometry.geodetic import Origin, geodetic
from omnilines.records import LengthUnit

FARTHEST_M = 100_000.0
"""Of a line from the origin: what lies farther has coordinates of another kind."""
_DECIMALS = (9, 9, 4)
"""0.1 mm in degrees and in metres."""


def write_geojson(path: Path, scene: SceneTables, origin: Origin) -> tuple[str, ...]:
    """Write the lines that are known; what the file has no place for.

    Raises InputError where the length of the scene's unit is not known, or a line is not near the origin.
    """
    lines, segments = scene.lines, scene.segments
    if lines.unit is not LengthUnit.METRES:
        raise InputError(
            f"{path}: a scene in metres was expected, found {lines.unit.words}; give its scale when it is made, with reconstruct "
            "--scale-from."
        )
    rows = np.flatnonzero(lines.known)
    ends = lines.ends_m[rows]
    farthest = float(np.linalg.norm(ends, axis=-1).max()) if len(rows) else 0.0
    if farthest > FARTHEST_M:
        raise InputError(
            f"{path}: lines within {FARTHEST_M / 1000:g} km of `origin` were expected, in metres east, north and up of it, found "
            f"one {farthest / 1000:,.0f} km away; coordinates of another kind, such as UTM, have to be moved there first."
        )
    photos: dict[str, dict[str, None]] = {}
    for image, track in zip(segments.image.tolist(), segments.track.tolist(), strict=True):
        if track >= 0:
            photos.setdefault(segments.tracks[track], {})[segments.images[image]] = None
    features: list[dict[str, Any]] = []
    for row, (first, second), places in zip(rows.tolist(), ends, geodetic(ends, origin), strict=True):
        sigma = float(lines.sigma_m[row])
        properties = {
            "track": lines.tracks[row], "status": lines.status[row], "length_m": round(float(np.linalg.norm(second - first)), 4),
            "sigma_m": round(sigma, 5) if np.isfinite(sigma) else None, "photos": list(photos.get(lines.tracks[row], ())),
        }  # fmt: skip
        points = [[round(value, digits) for value, digits in zip(place, _DECIMALS, strict=True)] for place in places.tolist()]
        features.append({"type": "Feature", "geometry": {"type": "LineString", "coordinates": points}, "properties": properties})
    document = {"type": "FeatureCollection", "features": features}
    write_atomically(path, json.dumps(document, ensure_ascii=False, allow_nan=False, separators=(",", ":")) + "\n")
    off_deg = math.degrees(math.acos(min(1.0, max(-1.0, scene.up[2]))))
    tilted = f"the scene's own vertical, which is {rounded(off_deg)} degrees from z: z was taken for up, as `origin` says"
    lost = ("cameras and poses", "uncertainties but sigma_m", "heights above sea: they are above the ellipsoid")
    return lost if scene.up == Z_UP else (*lost, tilted)
