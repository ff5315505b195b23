"""Photos of targets, rooms, flats, streets and a table through a camera that is known, with the truth behind them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypedDict, Unpack

from calib_patterns import Pattern
from calib_patterns import pattern as parse_pattern
from calib_patterns.board_poses import random_board_poses
from calib_patterns.rendering import render_target
from camera_models import CameraModel, InputError
from camera_models.pose import Pose
from camera_models.typed import require_fields, typed
from omnilines.files import find_photos, read_photo
from omnilines.files.true_edges import TrueEdges
from omnilines.pipelines.rendered import Photo, RenderedPhotos, RenderedScene, RenderedTargets
from omnilines.progress import ProgressCallback, silent
from omnilines.records import ImagePoses
from omnilines.scenes import (
    PHOTO_WIDTH_M,
    PLACES,
    PolygonScene,
    build_scene,
    default_fov_deg,
    eye,
    largest_angle,
    render_photo,
    scene_camera,
    scene_edges,
    scene_poses,
    stretches_of_photos,
    visible_stretches,
    with_photographs,
)
from omnilines.synthetic.targets import board_angle_rad, example_camera, integer_seed

MODEL = "opencv-fisheye"
"""Of the camera, unless one is named."""


@dataclass(frozen=True)
class RenderOptions:
    """How photos are rendered, of whatever they show. The same options give the same photos."""

    fov_deg: float | None = None
    """Angle across the largest image circle; None for 190, of a pinhole camera 80, of a cylinder 360, all of a given one."""
    views: int = 20
    """Number of photos."""
    size_px: tuple[int, int] = (1280, 960)
    """Width and height of the photos, where the camera is not given."""
    noise_grey: float = 2.0
    """Standard deviation of the white noise of each channel, grey levels of 255."""
    blur_px: float = 0.5
    """Standard deviation of the blur."""
    vignetting: float = 0.3
    """Share of the light lost at the farthest image corner."""
    mirror: bool = False
    """Whether the camera looks into a mirror, along -z; of the model scaramuzza."""
    seed: int = 0
    """What camera, poses, scene and noise are drawn from."""

    def __post_init__(self) -> None:
        """Refuse what no photo can have before any is rendered."""
        require_fields(self)
        if self.views < 1:
            raise InputError(f"At least 1 view was expected, found {self.views}; give more.")
        if self.blur_px < 0 or self.noise_grey < 0 or not 0 <= self.vignetting <= 1:
            raise InputError(
                f"A blur and a noise of at least 0 and a vignetting of 0 to 1 were expected, found {self.blur_px:g}, "
                f"{self.noise_grey:g} and {self.vignetting:g}; change the one out of range."
            )


class RenderFields(TypedDict, total=False):
    """Fields of `RenderOptions` that a call may give by name."""

    fov_deg: float | None
    views: int
    size_px: tuple[int, int]
    noise_grey: float
    blur_px: float
    vignetting: float
    mirror: bool
    seed: int


@typed
def render(
    shown: str | Pattern | PolygonScene,
    model: str | CameraModel = MODEL,
    options: RenderOptions = RenderOptions(),
    *,
    poses: Pose | None = None,
    progress: ProgressCallback = silent,
    **fields: Unpack[RenderFields],
) -> RenderedTargets | RenderedScene:
    """Photos of a target (`checkerboard:8x6:30mm`, or a pattern) or of a scene (`room`, `plain-room`, `flat`, `street`, `books`,
    or polygons), with the camera, the poses and the truth; nothing is written before `save`.

    `model` is the name of a camera model, of which a camera with the imperfections of a real one is drawn, or a camera. `poses`,
    cam_from_world of each photo with a target as the world, are drawn unless given. Fields of the options may be given by name.

    Raises InputError for options out of range and GeometryError where the camera cannot see the target or the scene has no room.

        >>> rendered = ol.render("checkerboard:8x6:30mm", "scaramuzza", fov_deg=190.0, views=3, size_px=(640, 480))
        >>> {name: photo.shape for name, photo in rendered.photos.items()}
        {'view00.png': (480, 640), 'view01.png': (480, 640), 'view02.png': (480, 640)}
        >>> rendered.camera.NAME, len(rendered.corners), tuple(rendered.poses.cam_from_world.translation.shape)
        ('scaramuzza', 144, (3, 3))
        >>> room = ol.render("room", views=1, size_px=(160, 120))
        >>> room.edges.ends_m.shape[1:], len(room.stretches) > 100
        ((2, 3), True)
    """
    options = replace(options, **fields)
    idle = ["mirror"] if isinstance(model, CameraModel) else []
    if isinstance(model, CameraModel) and options.size_px != model.image_size:
        idle.append("size_px")
    for name in [*idle, *(["views"] if poses is not None else [])]:
        if getattr(options, name) != getattr(RenderOptions, name):
            given = "poses" if name == "views" else "a camera"
            raise InputError(f"`{name}` counts only where it is not given otherwise, found {given}; leave it out.")
    if isinstance(shown, Pattern) or (isinstance(shown, str) and ":" in shown):
        return render_targets(shown, model, options, poses=poses)
    return render_scene(shown, model, options, poses=poses, progress=progress)


def render_targets(
    target: str | Pattern,
    model: str | CameraModel = MODEL,
    options: RenderOptions = RenderOptions(),
    *,
    poses: Pose | None = None,
    max_angle_deg: float | None = None,
) -> RenderedTargets:
    """Grey photos of a target. Unless poses are given, its corners lie out to `max_angle_deg` off axis: to 85 / 95 of the image
    circle unless that is given. Raises as `render`."""
    if options.mirror:
        raise InputError("A mirror was expected with a scene only, found it with a target; leave it out.")
    pattern = parse_pattern(target) if isinstance(target, str) else target
    seed = options.seed
    if isinstance(model, str):
        fov_deg = default_fov_deg(model) if options.fov_deg is None else options.fov_deg
        camera = example_camera(model, fov_deg, options.size_px, seed)
    else:
        camera = model
        fov_deg = 2.0 * math.degrees(largest_angle(camera, math.pi)) if options.fov_deg is None else options.fov_deg
    reach = board_angle_rad(fov_deg) if max_angle_deg is None else math.radians(max_angle_deg)
    if not 0 < reach <= 0.5 * math.radians(fov_deg):
        raise InputError(
            f"Boards out to at most half the field of view of {fov_deg:g} degrees were expected, found {math.degrees(reach):g} "
            "degrees off axis; give a smaller angle."
        )
    if poses is None:
        poses = random_board_poses(pattern, camera, options.views, reach, seed=integer_seed(seed, "poses"))

    def photo(k: int) -> Photo:
        """What the camera sees from a pose."""
        return render_target(
            pattern,
            camera,
            poses[k],
            blur_px=options.blur_px,
            noise_grey=options.noise_grey,
            vignetting=options.vignetting,
            seed=integer_seed(seed, "photo", k),
        )

    table = _table(poses)
    inputs = {"pattern": pattern.specification, **_inputs(camera, fov_deg, options)}
    return RenderedTargets(RenderedPhotos(table.images, photo), camera, table, seed, inputs, pattern, fov_deg, reach)


def render_scene(
    scene: str | PolygonScene = "room",
    model: str | CameraModel = MODEL,
    options: RenderOptions = RenderOptions(),
    *,
    poses: Pose | None = None,
    textures: str | Path | None = None,
    texture_m: float = PHOTO_WIDTH_M,
    textured: Sequence[str] = PLACES,
    progress: ProgressCallback = silent,
) -> RenderedScene:
    """Colour photos of a scene. Photographs of the folder `textures`, `texture_m` wide on a face, cover the surfaces that
    `textured` names (`PLACES`). Raises as `render`."""
    seed = options.seed
    name = scene if isinstance(scene, str) else "scene"
    world = build_scene(scene, seed) if isinstance(scene, str) else scene
    inputs: dict[str, Any] = {}
    if textures is None and (texture_m != PHOTO_WIDTH_M or tuple(textured) != PLACES):
        raise InputError(
            "`texture_m` and `textured` count only with `textures`, found none; give photographs, or leave them out."
        )
    if textures is not None:
        photographs = [read_photo(photo.path) for photo in find_photos([textures])]
        world = with_photographs(world, photographs, seed, texture_m, textured)
        inputs = {"textures": str(textures), "texture_m": texture_m, "textured": ",".join(textured)}
    if isinstance(model, str):
        camera, circle_rad = scene_camera(model, options.size_px, seed, options.fov_deg, options.mirror)
    else:
        camera, circle_rad = model, math.pi if options.fov_deg is None else 0.5 * math.radians(options.fov_deg)
    poses = scene_poses(world, options.views, seed, camera) if poses is None else poses
    ends = scene_edges(world)
    edges = TrueEdges(tuple(f"e{k:0{len(str(len(ends)))}d}" for k in range(len(ends))), ends)
    look, table, found = eye(camera, circle_rad), _table(poses), []
    for k in range(len(poses)):
        progress("looking for visible edges", k, len(poses))
        found.append(visible_stretches(world, look, poses[k], ends, options.vignetting))

    def photo(k: int) -> Photo:
        """What the camera sees from a pose."""
        return render_photo(
            world,
            look,
            poses[k],
            blur_px=options.blur_px,
            noise_grey=options.noise_grey,
            vignetting=options.vignetting,
            seed=[seed, k],
        )

    stretches = stretches_of_photos(table.images, found)
    inputs = {"scene": name, **_inputs(camera, options.fov_deg, options), "mirror": options.mirror, **inputs}
    photos = RenderedPhotos(table.images, photo)
    return RenderedScene(photos, camera, table, seed, inputs, name, world, circle_rad, edges, stretches)


def _table(poses: Pose) -> ImagePoses:
    """Poses with the names of their photos."""
    count = len(poses)
    names = tuple(f"view{k:0{max(2, len(str(count - 1)))}d}.png" for k in range(count))
    return ImagePoses(names, poses, ("cam0",) * count)


def _inputs(camera: CameraModel, fov_deg: float | None, options: RenderOptions) -> dict[str, Any]:
    known = {"model": camera.NAME, "fov_deg": fov_deg, "noise": options.noise_grey, "blur": options.blur_px}
    return known if options.vignetting == RenderOptions.vignetting else {**known, "vignetting": options.vignetting}
