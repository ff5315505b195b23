"""What of a camera in a file is possible but seldom meant: sides or columns that were swapped, another size of the image."""

from camera_models._model import CameraModel
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.camera_check import seen_share

OFF_CENTRE = 0.1
"""Share of a side by which the principal point lies off the middle, from which on swapped numbers are looked for."""
FAR_OFF_CENTRE = 0.25
"""The same, from which on it is spoken of anyway: a cropped image has it there."""
FAR_BETTER = 4.0
"""Times as near to the middle as it has to be with the numbers swapped."""
OTHER_SIZE = 0.7
"""Times the size of the image (or the inverse) from which on an image of another size is likely."""
SAME_SHAPE = 0.1
OTHER_ASPECT = 2.0
"""Between the focal lengths along u and v: no chip has it."""
LITTLE_SEEN = 0.2
"""Share of the image that a camera sees: the circle of a fisheye fills more of it."""
FAR_APART_M = 20.0
"""Of two cameras of a rig; boards are often measured in millimetres."""


def camera_doubts(calibration: Calibration) -> tuple[str, ...]:
    """One sentence for each camera, and one for a rig, whose numbers are likely of another image, or swapped."""
    said = tuple(f"Camera {name}: {doubt}." for name, model in calibration.items() for doubt in model_doubts(model))
    for name, item in calibration.rig.items():
        apart = float(item.cam_from_rig.centre.norm())
        if apart > FAR_APART_M:
            far = f"camera {name} stands {apart:.3g} m from the frame of the rig: if lengths are in millimetres, divide by 1000"
            return (*said, f"The rig: {far}.")
    return said


def model_doubts(model: CameraModel, *, estimated: bool = False) -> tuple[str, ...]:
    """The same of one camera, each a sentence without its beginning and its end. Of an `estimated` one nobody can check numbers
    that a fit has found: what they mean is said instead."""
    values = model.named_parameters()
    said = []
    if "cx" in values:
        (width, height), cx, cy = model.image_size, values["cx"], values["cy"]
        off, swapped = _off(cx, cy, width, height), _off(cy, cx, width, height)
        wide, high = (2 * cx + 1) / width, (2 * cy + 1) / height
        where = f"the principal point ({cx:.1f}, {cy:.1f}) lies off the middle of its image of {width}x{height} px"
        if off > OFF_CENTRE and FAR_BETTER * swapped < off:
            said.append(f"{where} and would not if u and v, or width and height, were swapped; check their order")
        elif min(wide, high) > 0 and abs(wide / high - 1) < SAME_SHAPE and not OTHER_SIZE < wide < 1 / OTHER_SIZE:
            said.append(f"{where}, as that of an image of about {2 * cx + 1:.0f}x{2 * cy + 1:.0f} px would; check the size")
        elif off > FAR_OFF_CENTRE:
            cut = "as in photos that are cut out of larger ones, or of a chip beside the axis of its lens"
            said.append(f"{where}, {cut}" if estimated else f"{where}; check both, unless the photos are cut out of larger ones")
    if values.get("fx", 0) and values.get("fy", 0) and model.CALIBRATED:
        aspect = values["fx"] / values["fy"]
        if not 1 / OTHER_ASPECT < aspect < OTHER_ASPECT:
            said.append(f"the focal lengths {values['fx']:g} and {values['fy']:g} px differ by more than pixels do; check them")
    if model.CALIBRATED and (seen := seen_share(model)) < LITTLE_SEEN:
        said.append(f"it sees {100 * seen:.0f} percent of its image, beyond that its distortion folds; check the coefficients")
    if not 0.0 <= values.get("alpha", 0.0) <= 1.0:
        refused = "it is used all the same, but where another program refuses it, calibrate with another --model"
        said.append(f"alpha is meant to lie in 0 to 1, found {values['alpha']:g}; {refused if estimated else 'check it'}")
    return tuple(said)


def _off(cx: float, cy: float, width: int, height: int) -> float:
    """How far the principal point lies off the middle, as a share of the sides."""
    return max(abs(cx - (width - 1) / 2) / width, abs(cy - (height - 1) / 2) / height)
