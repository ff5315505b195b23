"""Corners of a target, or photos with what they show -> one calibrated camera: `calibrate`."""

from collections.abc import Iterable, Mapping, Sequence, Set
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Unpack, overload

from calib_patterns import DetectionOptions, Pattern
from camera_models import InputError
from camera_models.typed import typed
from omnilines.calibration.options import CalibrationFields, CalibrationOptions
from omnilines.files import Photos, find_photos
from omnilines.files.masks import Mask
from omnilines.options import require_ranges
from omnilines.pipelines.calibrate import CalibrationResult, calibrate_corners
from omnilines.pipelines.calibrate_lines import LineFields, LineResult, calibrate_lines
from omnilines.pipelines.detect import detect
from omnilines.pipelines.detect_rig import shared_frames
from omnilines.pipelines.line_options import LinesOptions
from omnilines.pipelines.photo_corners import PhotoCorners
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Corners

LINES = "lines"
"""In the place of a target, or beside one."""


@overload
def calibrate(
    corners: PhotoCorners | Corners | Mapping[str, tuple[Any, Any]],
    image_size: tuple[int, int] | None = None,
    options: CalibrationOptions = ...,
    /,
    *,
    executor: Executor | None = None,
    progress: ProgressCallback = ...,
    **fields: Unpack[CalibrationFields],
) -> CalibrationResult: ...


@overload
def calibrate(
    corners: PhotoCorners | Corners | Mapping[str, tuple[Any, Any]],
    /,
    *,
    image_size: tuple[int, int] | None = None,
    options: CalibrationOptions = ...,
    executor: Executor | None = None,
    progress: ProgressCallback = ...,
    **fields: Unpack[CalibrationFields],
) -> CalibrationResult: ...


@overload
def calibrate(
    photos: Photos,
    /,
    pattern: Literal["lines"],
    options: CalibrationOptions = ...,
    *,
    lines: LinesOptions = ...,
    boards: CalibrationResult | None = None,
    mask: Mask | None = None,
    work: str | Path | None = None,
    progress: ProgressCallback = ...,
    **fields: Unpack[LineFields],
) -> LineResult: ...


@overload
def calibrate(
    photos: Photos,
    /,
    pattern: Pattern,
    options: CalibrationOptions = ...,
    *,
    work: str | Path | None = None,
    detection: DetectionOptions = ...,
    executor: Executor | None = None,
    progress: ProgressCallback = ...,
    **fields: Unpack[CalibrationFields],
) -> CalibrationResult: ...


@overload
def calibrate(
    photos: Photos,
    /,
    pattern: str,
    options: CalibrationOptions = ...,
    *,
    lines: LinesOptions = ...,
    mask: Mask | None = None,
    work: str | Path | None = None,
    detection: DetectionOptions = ...,
    executor: Executor | None = None,
    progress: ProgressCallback = ...,
    **fields: Unpack[CalibrationFields],
) -> CalibrationResult | LineResult: ...


@typed
def calibrate(
    given: Any,
    /,
    pattern: Pattern | str | tuple[int, int] | None = None,
    options: CalibrationOptions = CalibrationOptions(),
    *,
    image_size: tuple[int, int] | None = None,
    lines: LinesOptions = LinesOptions(),
    boards: CalibrationResult | None = None,
    mask: Mask | None = None,
    work: str | Path | None = None,
    detection: DetectionOptions = DetectionOptions(),
    executor: Executor | None = None,
    progress: ProgressCallback = silent,
    **fields: Any,
) -> CalibrationResult | LineResult:
    """Calibrate one camera without any guess of focal length or centre: from photos of a target, from straight lines, or both.

    Photos (a folder, files, or arrays) stand before a `pattern`, which says what they show: a target
    ("checkerboard:8x6:30mm"), straight lines of buildings or rooms ("lines"), or both ("checkerboard:8x6:30mm,lines"), in one
    adjustment. Corners need none: what `detect` found, a table as `read_corners` returns it, or by view two arrays, points of
    the board (n, 3) in metres and pixels (n, 2); behind the latter two stands `image_size` (width, height).

    Fields of the options may be given by name: `model="auto"` fits all camera models and takes the one that predicts held-out
    views best. With `rolling_shutter` the line delay is estimated. With lines alone `model`, `degree`, `coefficients` and
    `mirror` count; `boards` is a calibration of the same camera from a target, of some of the photos or of others: its model is
    kept, and its corners count beside the lines. Edges are followed where `mask` says, as in `extract`. What each photo shows is
    kept in the folder `work`, where one is given, and read from there by another run that would find the same. `detection` has
    the options of targets, `lines` those of lines. Photos are searched for a target, and models fitted to it, by the workers of
    an `executor`, where one is given.

    Returns a CalibrationResult of corners or a target, a LineResult where lines count. Raises InputError for what does not go
    together, options out of range, photos that show too little and corners outside the image, and GeometryError where the data
    cannot determine the camera.

        >>> result = ol.calibrate("board/", "checkerboard:8x6:30mm", model="opencv-fisheye")
        >>> result.camera.NAME, result.rms_px_per_axis < 0.1, len(result.views)
        ('opencv-fisheye', True, 8)
        >>> result.sigma["fx"] < 0.1, result.covariance.shape
        (True, (8, 8))
        >>> [path.name for path in result.save("result")]
        ['calibration.yaml', 'corners.csv']
    """
    if pattern is not None and image_size is not None:
        raise InputError(
            "`image_size` was expected with a table of corners alone, found it beside another argument; leave it out."
        )
    for one in (replace(options, **fields), detection, lines):
        require_ranges(one)
    known = {
        "boards": boards is not None,
        "mask": mask is not None,
        "lines": lines != LinesOptions(),
        "detection": detection != DetectionOptions(),
    }
    asked = {name for name, is_given in known.items() if is_given}
    if not isinstance(pattern, str | Pattern):
        _require_corners(given)
        _refuse(asked | ({"work"} if work is not None else set()), "corners")
        return calibrate_corners(given, image_size or pattern, options, executor=executor, progress=progress, **fields)
    targets, has_lines = ((pattern,), False) if isinstance(pattern, Pattern) else shown_by(pattern)
    _require_photos(given, targets)
    _require_counting(bool(targets), has_lines, asked | fields.keys(), replace(options, **fields))
    if not targets:
        return calibrate_lines(given, options, lines, boards=boards, mask=mask, work=work, progress=progress, **fields)
    options = replace(options, **fields)
    options.require_of_models([options.model])
    # Which side of the board is seen decides only the sense of the numbering, which the pose of a plain board absorbs.
    found = detect(given, targets[0], mirrored=options.mirror, work=work, options=detection, executor=executor, progress=progress)
    result = calibrate_corners(found, options=options, executor=executor, progress=progress)
    return calibrate_lines(given, options, lines, boards=result, mask=mask, work=work, progress=progress) if has_lines else result


def shown_by(pattern: str) -> tuple[tuple[str, ...], bool]:
    """The targets that a pattern names, and whether lines stand in their place or beside them. Raises InputError where lines are
    named twice."""
    names = [name.strip() for name in pattern.split(",")]
    if names.count(LINES) > 1:
        raise InputError(f"`pattern` was expected to name {LINES} once, found {pattern!r}; leave the others out.")
    return tuple(name for name in names if name != LINES), LINES in names


def _require_counting(has_target: bool, has_lines: bool, asked: Set[str], options: CalibrationOptions) -> None:
    """Raises InputError where something is asked for that does not count with what photos show."""
    if not has_lines:
        _refuse(asked & {"boards", "lines", "mask"}, "a target alone")
    elif has_target:
        unknown = {name for name in ("mirror", "rolling_shutter") if getattr(options, name)}
        _refuse(unknown | (asked & {"boards"}), "lines beside a target")
    else:
        of_boards = CalibrationFields.__annotations__.keys() - LineFields.__annotations__.keys()
        _refuse(asked & (of_boards | {"detection"}), "lines alone")


def _refuse(names: Iterable[str], what: str) -> None:
    for name in sorted(names):
        raise InputError(f"`{name}` does not count with {what}, and was given; leave it out.")


def _pairs(given: Any) -> bool:
    """Whether these are not photos by name, of which each is one array."""
    return isinstance(given, Mapping) and any(isinstance(one, tuple | list) for one in given.values())


def _require_corners(given: Any) -> None:
    """Raises InputError for photos, of which nobody said what they show, and for what is neither."""
    if isinstance(given, PhotoCorners | Corners) or _pairs(given) or (isinstance(given, Mapping) and not given):
        return
    if isinstance(given, str | Path | Sequence | Mapping):
        raise InputError(
            "`pattern` was expected with photos, found none; give the target, such as checkerboard:8x6:32.5mm, or lines, or both "
            "with a comma between (a table of corners is read by `read_corners`)."
        )
    raise InputError(
        f"Corners of one camera, or photos and a pattern, were expected, found {type(given).__name__}; of a rig `calibrate_rig` "
        "takes the corners."
    )


def _require_photos(given: Any, targets: Sequence[Pattern | str]) -> None:
    """Raises InputError for corners, and for photos of several cameras or targets."""
    if _pairs(given) or not isinstance(given, str | Path | Sequence | Mapping):
        found = "several arrays for one name" if _pairs(given) else type(given).__name__
        raise InputError(
            f"Photos of one camera were expected with a pattern, found {found}; give the photos, or leave the pattern of corners "
            "out."
        )
    if len(targets) > 1:
        raise InputError(
            f"One target was expected, found {' and '.join(map(str, targets))}; calibrate a camera that sees several by "
            '`calibrate_rig(detect_rig(photos, targets, camera="cam0"))`.'
        )
    paths = [Path(one) for one in ([given] if isinstance(given, str | Path) else given) if isinstance(one, str | Path)]
    if isinstance(given, Mapping) or not paths or not all(path.is_dir() for path in paths):
        return
    if cameras := shared_frames(find_photos(paths)):
        raise InputError(
            f"Photos of one camera were expected, found photos of the same names in {' and '.join(cameras[:2])}; calibrate a rig "
            "from boards by `calibrate_rig`, each of its cameras from lines by its own folder; of one camera give the files."
        )
