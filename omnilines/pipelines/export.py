"""A scene of lines for other tools: `export`."""

import fnmatch
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from camera_models import InputError
from camera_models.typed import typed
from omnilines.files.dxf import write_dxf
from omnilines.files.geojson import write_geojson
from omnilines.files.glb import write_glb
from omnilines.files.limap import LIMAP_FILES, write_limap
from omnilines.files.nerfstudio_scene import write_nerfstudio
from omnilines.files.orientation import turned_note
from omnilines.files.photos import PhotoRef, require_photos
from omnilines.files.scene_folder import SCENE_TABLES, SceneTables, read_scene
from omnilines.files.sets import claimed
from omnilines.geometry.geodetic import Origin
from omnilines.pipelines.scene import Scene
from omnilines.pipelines.splatting import splatting_files, write_splatting

HIGHEST_M = 1e6
"""Of an origin, above the ellipsoid or below."""


class SceneFormat(NamedTuple):
    """A format that scenes are written in."""

    name: str
    title: str
    files: tuple[str, ...]
    """Names that are written in this format, as shell patterns in lower case."""
    write: Callable[..., tuple[str, ...]]
    """(path, scene) -> what the format has no place for; after these the folder of photos or the origin, where it takes one."""
    parts: Callable[[SceneTables], tuple[str, ...]] | None = None
    """Files of a format that is a folder."""
    takes_photos: bool = False
    takes_origin: bool = False


SCENE_FORMATS = (
    SceneFormat("dxf", "DXF", ("*.dxf",), write_dxf),
    SceneFormat("glb", "GLB", ("*.glb",), write_glb),
    SceneFormat("geojson", "GeoJSON", ("*.geojson",), write_geojson, takes_origin=True),
    SceneFormat("nerfstudio", "Nerfstudio", ("*.json",), write_nerfstudio, takes_photos=True),
    SceneFormat("limap", "LIMAP", ("*limap*",), write_limap, lambda _: LIMAP_FILES),
    SceneFormat("colmap", "COLMAP", ("*colmap*",), write_splatting, splatting_files, takes_photos=True),
)


@dataclass(frozen=True, eq=False)
class SceneExport:
    """A scene as a format will hold it. Nothing is written before `save`."""

    scene: SceneTables
    writer: SceneFormat
    out: Path
    photos: Path | None
    """Folder of the photos, for a format that takes them."""
    origin: Origin | None
    """Where the scene stands on the earth, for a format that takes it."""
    read: tuple[Path, ...]
    """Files that the scene was read from."""

    def __repr__(self) -> str:
        return f"SceneExport({self.scene.lines}, format={self.writer.name!r}, out={str(self.out)!r})"

    def save(self) -> tuple[tuple[Path, ...], tuple[str, ...]]:
        """Write the file or folder; the files, and what is lost or fitted. Raises InputError where the format does not hold the
        scene, or a file cannot be written."""
        out = Path(os.path.realpath(self.out)) if self.out.is_dir() else self.out
        turned = (
            () if self.photos is None else turned_note([PhotoRef(self.photos / name, name) for name in self.scene.poses.images])
        )
        beside = (self.photos,) if self.writer.takes_photos else (self.origin,) if self.writer.takes_origin else ()
        if self.writer.parts is not None:
            parts = self.writer.parts(self.scene)
            read = self.read if self.photos is None else (*self.read, self.photos)
            with claimed(out, parts, read, by=f"export {self.writer.name}") as folder:
                lost = self.writer.write(folder, self.scene, *beside)
            return tuple(out / name for name in parts if (out / name).is_file()), (*lost, *turned)
        if self.out.is_dir():
            raise InputError(f"A file was expected for {self.writer.title}, found the folder {self.out}; name a file in it.")
        if not self.out.suffix:
            ending = self.writer.files[0].removeprefix("*")
            raise InputError(
                f"A file name ending in {ending} was expected for {self.writer.title}, found {self.out}; name it so."
            )
        with claimed(out.parent, [out.name], self.read, by=f"export {out.name}"):
            lost = self.writer.write(out, self.scene, *beside)
        return (out,), (*lost, *turned)


@typed
def export(
    scene: str | Path | Scene,
    out: str | Path,
    *,
    to_format: str | None = None,
    photos: str | Path | None = None,
    origin: tuple[float, float, float] | None = None,
) -> SceneExport:
    """A scene, or that of a folder that `reconstruct` or `adjust` wrote, for another tool. Nothing is written yet.

    The format is told by the name of `out` (`lines.dxf`, `scene.glb`, `transforms.json`, a folder with limap or colmap in its
    name) unless named: dxf, glb, geojson, nerfstudio, limap or colmap. `photos` is their folder: frames of nerfstudio name photos
    relative to `out`, and colmap has masks of the image circles that they show. `origin` is for geojson, and needed there:
    latitude and longitude (degrees) and height above WGS84's ellipsoid (m) of the scene's origin, whose x, y and z are metres
    east, north and up.
    Raises InputError where there is no such format, the folder holds no scene, there is no such folder of photos, or a photo with
    a pose is not in it.

        >>> files, lost = ol.export("scene", "lines.dxf").save()
        >>> [path.name for path in files]
        ['lines.dxf']
    """
    path = Path(out)
    writer = _format_of(path, to_format)
    if photos is not None and not writer.takes_photos:
        raise InputError(
            f"`photos` is for nerfstudio, whose frames name them, and for masks of colmap, found {writer.name}; leave it out."
        )
    if photos is not None and not Path(photos).is_dir():
        raise InputError(f"`photos` was expected to be the folder of the photos, found {photos}, which is none.")
    place = _origin(origin, writer)
    read: tuple[Path, ...] = ()
    if isinstance(scene, Scene):
        tables = SceneTables(scene.cameras, scene.poses, scene.segments, scene.lines, scene.up)
    else:
        tables, read = read_scene(Path(scene)), tuple(Path(scene) / name for name in SCENE_TABLES)
    if photos is not None:
        require_photos(Path(photos), tables.poses.images)
    return SceneExport(tables, writer, path, _path(photos), place, read)


def _origin(given: tuple[float, float, float] | None, writer: SceneFormat) -> Origin | None:
    if given is None and not writer.takes_origin:
        return None
    if given is None:
        raise InputError(
            f"{writer.title} needs `origin`, the latitude, longitude and height of the scene's origin whose axes are east, north "
            "and up, found none; give it."
        )
    if not writer.takes_origin:
        raise InputError(f"`origin` is for geojson, whose coordinates are those of the earth, found {writer.name}; leave it out.")
    latitude, longitude, height = given
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and abs(height) <= HIGHEST_M):
        raise InputError(
            f"`origin` must be a latitude of -90 to 90, a longitude of -360 to 360 degrees and a height of at most "
            f"{HIGHEST_M:g} m, found {latitude:g},{longitude:g},{height:g}; correct it."
        )
    return Origin(latitude, longitude, height)


def _path(given: str | Path | None) -> Path | None:
    return None if given is None else Path(given)


def _format_of(out: Path, name: str | None) -> SceneFormat:
    known = ", ".join(one.name for one in SCENE_FORMATS)
    for one in SCENE_FORMATS:
        if one.name == name or (name is None and any(fnmatch.fnmatchcase(out.name.lower(), pattern) for pattern in one.files)):
            return one
    if name is not None:
        raise InputError(f"A format of scenes is one of {known}, found '{name}'; choose one of these.")
    patterns = ", ".join(pattern for one in SCENE_FORMATS for pattern in one.files)
    raise InputError(
        f"A name that tells the format was expected ({patterns}), found '{out.name}'; name the format with `to_format`."
    )
