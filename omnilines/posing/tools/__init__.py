"""Poses of photos in the files of other tools, one module a format. New ones go into `POSE_FILES`, in the order of asking."""

from pathlib import Path

from camera_models.formats import HEAD
from camera_models.formats.disk import read_bytes
from omnilines.posing.tools.contract import Keys, PoseFile, ToolPoses
from omnilines.posing.tools.kitti import KittiPoses
from omnilines.posing.tools.metashape import MetashapePoses
from omnilines.posing.tools.nerfstudio import NerfstudioPoses
from omnilines.posing.tools.omega_phi_kappa import OmegaPhiKappaPoses
from omnilines.posing.tools.openmvg import OpenMVGPoses
from omnilines.posing.tools.opensfm import OpenSfMPoses
from omnilines.posing.tools.timed import TimedPoses

__all__ = ["POSE_FILES", "TITLES", "Keys", "PoseFile", "ToolPoses", "pose_file_of"]

POSE_FILES: tuple[PoseFile, ...] = (
    MetashapePoses(),
    NerfstudioPoses(),
    OpenMVGPoses(),
    OpenSfMPoses(),
    OmegaPhiKappaPoses(),
    TimedPoses(),
    KittiPoses(),
)

TITLES = ", ".join(one.TITLE for one in POSE_FILES)


def pose_file_of(path: Path) -> PoseFile | None:
    """The format of a file, by its contents; None where it is of none of these tools."""
    if not path.is_file():
        return None
    head = read_bytes(path, HEAD).decode("latin-1")
    return next((one for one in POSE_FILES if one.recognises(path, head)), None)
