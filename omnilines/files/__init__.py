"""The files of a scene folder: tables (CSV), covariances (NPZ), line drawings (PLY), photos."""

from omnilines.files.corners import is_corners_table, is_rig_table, read_corners, read_rig_corners, write_corners
from omnilines.files.lines import read_lines, write_covariance, write_lines
from omnilines.files.photos import (
    PHOTO_SUFFIXES,
    Photo,
    PhotoArray,
    PhotoRef,
    Photos,
    find_photos,
    of_one_range,
    photo_folder,
    photos_at_once,
    photos_of,
    write_png,
)
from omnilines.files.ply import write_ply
from omnilines.files.poses import read_poses, write_poses
from omnilines.files.segments import read_segments, write_segments
from omnilines.files.vgg_house import read_vgg_lines, read_vgg_points
from omnilines.photo_file import read_photo

__all__ = [
    "PHOTO_SUFFIXES",
    "Photo",
    "PhotoArray",
    "PhotoRef",
    "Photos",
    "find_photos",
    "is_corners_table",
    "is_rig_table",
    "of_one_range",
    "photo_folder",
    "photos_at_once",
    "photos_of",
    "read_corners",
    "read_lines",
    "read_photo",
    "read_poses",
    "read_rig_corners",
    "read_segments",
    "read_vgg_lines",
    "read_vgg_points",
    "write_corners",
    "write_covariance",
    "write_lines",
    "write_ply",
    "write_png",
    "write_poses",
    "write_segments",
]
