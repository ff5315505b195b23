"""Rooms, flats, streets and a table made of polygons: built from a seed, rendered through any camera, with every edge known.

scene = build_scene("room", seed=0)
camera, circle = scene_camera("opencv-fisheye", (1280, 960), seed=0, fov_deg=190.0)
poses = scene_poses(scene, views=8, seed=0, camera=camera)
photo = render_photo(scene, eye(camera, circle), poses[0], noise_grey=2.0)          # (h, w, 3) BGR
edge, t, length_px, contrast = visible_stretches(scene, eye(camera, circle), poses[0], scene_edges(scene))
"""

from camera_models import InputError
from omnilines.scenes.books import books, sheet_from_world
from omnilines.scenes.cameras import default_fov_deg, largest_angle, scene_camera
from omnilines.scenes.edges import scene_edges
from omnilines.scenes.flat import flat
from omnilines.scenes.photo import Eye, eye, render_clean, render_photo
from omnilines.scenes.photo_texture import PHOTO_WIDTH_M, PLACES, with_photographs
from omnilines.scenes.plain_room import plain_room
from omnilines.scenes.polygon_scene import PolygonScene
from omnilines.scenes.poses import scene_poses
from omnilines.scenes.room import furnished_room
from omnilines.scenes.street import street
from omnilines.scenes.visibility import stretches_of_photos, visible_stretches

_BUILDERS = {"room": furnished_room, "plain-room": plain_room, "flat": flat, "street": street, "books": books}
SCENES = tuple(_BUILDERS)

__all__ = [
    "PHOTO_WIDTH_M",
    "PLACES",
    "SCENES",
    "Eye",
    "PolygonScene",
    "books",
    "build_scene",
    "default_fov_deg",
    "eye",
    "flat",
    "furnished_room",
    "largest_angle",
    "plain_room",
    "render_clean",
    "render_photo",
    "scene_camera",
    "scene_edges",
    "scene_poses",
    "sheet_from_world",
    "street",
    "stretches_of_photos",
    "visible_stretches",
    "with_photographs",
]


def build_scene(name: str, seed: int) -> PolygonScene:
    """The scene of a name; raises InputError on an unknown one."""
    if name not in SCENES:
        raise InputError(f"A scene is one of {', '.join(SCENES)}, found '{name}'; choose one of these.")
    return _BUILDERS[name](seed)
