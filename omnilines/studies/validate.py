"""Rendered photos -> what the software makes of them, compared with the truth: `validate`."""

from dataclasses import replace

from camera_models.typed import typed
from omnilines.files import Photos
from omnilines.pipelines.arcs import extract
from omnilines.pipelines.calibrate_one import calibrate
from omnilines.pipelines.detect import detect
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.reconstruct import reconstruct
from omnilines.pipelines.rendered import RenderedScene, RenderedTargets
from omnilines.progress import ProgressCallback, silent
from omnilines.studies.scene_validation import RebuiltScene, SceneValidation, compare_scene
from omnilines.studies.validation import Validation, compare


@typed
def validate(
    rendered: RenderedTargets | RenderedScene, *, photos: Photos | None = None, progress: ProgressCallback = silent
) -> Validation | SceneValidation:
    """Check that the software recovers what it is given, from pixels to lines.

    Of a target: calibrate a camera of the model that rendered it, rebuild the rows and columns of the board, and compare both
    with the truth (`validate_targets`). Of a scene: rebuild its lines with the camera and poses that rendered it
    (`validate_scene`). `photos` are those that were rendered, unless others are given, such as the files that they were saved in.

    Raises GeometryError where the photos determine nothing.

        >>> checked = ol.validate(ol.render("checkerboard:8x6:30mm", views=8, size_px=(640, 480)))
        >>> checked.holds, [check.name for check in checked.checks if not check.holds]
        (True, [])
        >>> checked.bearings.rms_deg < 0.02, checked.calibration["cam0"].NAME
        (True, 'opencv-fisheye')
    """
    if isinstance(rendered, RenderedScene):
        return validate_scene(rendered, photos=photos, progress=progress)
    return validate_targets(rendered, photos=photos, progress=progress)


def validate_targets(
    rendered: RenderedTargets, *, photos: Photos | None = None, progress: ProgressCallback = silent
) -> Validation:
    """Calibrate from the photos, rebuild the rows and columns of the board as 3D lines with the calibrated camera and poses, and
    compare:

    - at most 5 percent of the photos (rounded up) are without a usable target;
    - the RMS angle between estimated and true bearings, uniform over the pixels as far out as boards were shown, after the best
      common rotation, is at most 0.02 degrees, or 0.1 px at the mean angular size of a pixel (`fov_deg` over the shorter side of
      the image) where that is more, as it is for small images;
    - the parameters agree with the truth within their covariance: jointly, by the 99.9 percent quantile, and each within 4.5
      standard deviations;
    - the lines agree with the rows and columns of the true board, after the best similarity, within what the accuracy that the
      detector states for each corner predicts, by the same quantile; at most 5 percent of the corners (rounded up) fit no line;
    - whatever is stated, their ends are within 0.25 px (RMS) where the board is, and its lines are not too long or too short by
      more than 0.1 px over the board.

    Raises GeometryError where the photos determine nothing.
    """
    found = detect(rendered.photos if photos is None else photos, rendered.pattern, progress=progress)
    result = calibrate(found, model=rendered.camera.NAME, progress=progress)
    progress("rebuilding lines", 0, 0)
    notes = (*result.warnings, *(detail.text for detail in result.details))
    return replace(compare(rendered, result.calibration, result.found.corners), notes=notes)


def validate_scene(
    rendered: RenderedScene, *, photos: Photos | None = None, progress: ProgressCallback = silent
) -> SceneValidation:
    """Rebuild the lines of a scene from its photos with the camera and poses they were rendered with, and compare.

    docs/scenes.md lists the checks. Raises GeometryError naming the stage where no line is left, or where no edge is seen by
    enough photos.
    """
    arcs = extract(rendered.photos if photos is None else photos, rendered.calibration, progress=progress)
    scene = reconstruct(arcs, rendered.poses, rendered.calibration, SceneOptions(seed=rendered.seed), progress=progress)
    progress("comparing with the truth", 0, 0)
    return compare_scene(rendered, RebuiltScene.of(scene))
