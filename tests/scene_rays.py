"""Scenes without lamps and texture, and what plain rays hit in them."""

import numpy as np

from omnilines.scenes.polygon_scene import Lamps, PolygonScene, Texture

SIZE = (640, 480)
EVEN_LIGHT = Lamps(np.zeros((0, 3)), np.zeros(0), np.zeros(0), 1.0, 0.0, np.zeros(2))
PLAIN = Texture(np.zeros((0, 2)), np.zeros(0), np.zeros(0))


def brute_force(scene: PolygonScene, centre: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance to the first face along each ray and the face, by the intersection of Möller and Trumbore with all triangles."""
    corners = scene.corners_m[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    owner = np.repeat(np.arange(len(scene)), 2)
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    front = (np.cross(e1, e2) * (centre - corners[:, 0])).sum(-1) > 1e-12
    corners, owner, e1, e2 = corners[front], owner[front], e1[front], e2[front]
    s = centre - corners[:, 0]
    q = np.cross(s, e1)
    distance, face = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for k, ray in enumerate(rays):
        p = np.cross(ray, e2)
        determinant = (e1 * p).sum(-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v, t = (s * p).sum(-1) / determinant, (q @ ray) / determinant, (q * e2).sum(-1) / determinant
            hit = np.flatnonzero((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9))
        if len(hit):
            nearest = t[hit].min()
            at = hit[t[hit] < nearest * (1 + 1e-9)]
            distance[k], face[k] = nearest, owner[at[scene.layer[owner[at]].argmax()]]
    return distance, face
