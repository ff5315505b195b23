"""What tells place, turn and size of a scene whose poses were refined: given ones as a whole, a prior on them, a rig."""

from dataclasses import replace

from camera_models.wording import listed
from omnilines.adjustment.prior import KnownPoses
from omnilines.adjustment.scene import AdjustedScene
from omnilines.pipelines.options import SceneOptions

OF_GIVEN = (
    "Place, turn and size of the scene are those of the given poses as a whole, which lines cannot improve. Uncertainties are "
    "stated in that frame."
)
OF_GIVEN_AND_RIG = (
    "Place and turn of the scene are those of the given poses as a whole, and its size is that of the rig: lines cannot improve "
    "these. Uncertainties are stated in that frame."
)
OF_PRIOR = (
    "The refined poses are held near the given ones by the standard deviations of the prior. Uncertainties hold that place, turn "
    "and size of the scene are only known so well."
)


def unplaced_notes(scene: AdjustedScene) -> tuple[str, ...]:
    """Photos whose lines do not tell where they were taken, where poses were refined."""
    if not scene.unplaced:
        return ()
    names = listed(scene.unplaced)
    if len(scene.unplaced) == 1:
        told = f"{names} shows too few lines to tell where it was taken, or parallel ones. Its pose stays"
    else:
        told = f"{names} show too few lines to tell where they were taken, or parallel ones. Their poses stay"
    return (f"{told} as given, and lines rest on the other photos.",)


def frame_notes(scene: AdjustedScene, prior: KnownPoses | None, options: SceneOptions) -> tuple[str, ...]:
    """Of poses that were refined from given ones, which a `prior` may hold; nothing where they were held."""
    if "poses" not in options.refine:
        return ()
    if prior is None:
        rig = scene.adjusted.state.rig
        sized = rig is not None and "rig" not in options.refine and rig.has_baseline(scene.table.arcs.image)
        return (OF_GIVEN_AND_RIG if sized else OF_GIVEN,)
    final = replace(scene.poses, covariance=None)
    near = prior.agreeing(final, options.adjustment.significance).poses.images
    drawn = listed(image for image in prior.poses.images if image not in near)
    if not drawn:
        return (OF_PRIOR,)
    return (
        OF_PRIOR,
        f"Lines draw {drawn} farther from the given poses than the prior lets expect, so that uncertainties are too small: the "
        "prior is too strict, or the calibration is off.",
    )
