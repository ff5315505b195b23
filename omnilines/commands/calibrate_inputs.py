"""omnilines calibrate: which of its ways goes with what is given: photos, videos or a table, of one camera or a rig."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from pathlib import Path

from calib_patterns import DetectionOptions
from camera_models import InputError, load
from omnilines.calibration.options import CalibrationOptions
from omnilines.commands.calibrate import calibrate_corners, calibrate_photos
from omnilines.commands.calibrate_lines import calibrate_line_photos
from omnilines.commands.calibrate_rig import calibrate_rig_corners, calibrate_rig_photos
from omnilines.commands.camera_videos import Sizes
from omnilines.commands.frames import with_frames
from omnilines.commands.result import CommandResult
from omnilines.footage.options import FrameOptions
from omnilines.pipelines.calibrate_one import shown_by
from omnilines.pipelines.calibrate_rig import RigSetup
from omnilines.pipelines.detect_rig import is_rig, table_without_photos
from omnilines.pipelines.line_delay import CAMERA
from omnilines.pipelines.line_options import LinesOptions
from omnilines.progress import ProgressCallback


@dataclass(frozen=True)
class CalibrationInputs:
    """What is given to `calibrate`. Raises InputError where parts of it are missing or do not go together."""

    photos: Sequence[Path]
    """Photos, folders and videos, or one corners.csv."""
    pattern: str | None = None
    image_sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    """By camera, "" standing for all others; of a table only."""
    models: Mapping[str, str] = field(default_factory=dict)
    """As `image_sizes`."""
    boards: str = "fixed"
    calibration: Path | None = None
    hold: bool = False
    time_offsets: bool = False
    split: str | None = None
    mask: Path | None = None
    """Of lines: an image or a folder of masks."""

    def __post_init__(self) -> None:
        given = " ".join(map(str, self.photos))
        if self.table and len(self.photos) > 1:
            raise InputError(
                f"One table of corners alone was expected, found {given}; put the corners of all cameras into one table with a "
                "column camera, or calibrate each camera alone."
            )
        if self.table and not self.image_sizes:
            raise InputError(
                f"`image_size` beside corners.csv was expected, found {given}; a table does not hold the size of the photos."
            )
        if table := table_without_photos(self.photos):
            raise InputError(f"Photos were expected in {given}, found a table of corners and no photo; give {table} itself.")
        if self.lines and self.rig:
            raise InputError(
                "Photos of one camera were expected with `pattern` lines, found a rig: lines do not tell how its cameras stand "
                "to one another; calibrate each camera alone with its own photos, or the rig with a board."
            )
        if not self.table and self.pattern is None:
            raise InputError(
                "`pattern` was expected with photos, found none; give the target, such as checkerboard:8x6:32.5mm, or lines "
                "where photos show a room or a building."
            )

    @property
    def table(self) -> Path | None:
        """The corners.csv, where one is given."""
        return next((path for path in self.photos if path.suffix.lower() == ".csv"), None)

    @property
    def targets(self) -> tuple[str, ...]:
        """The targets, without lines."""
        return shown_by(self.pattern or "")[0]

    @property
    def lines(self) -> bool:
        """Whether straight lines of the world stand in the place of a target, or beside one."""
        return self.table is None and shown_by(self.pattern or "")[1]

    @property
    def rig(self) -> bool:
        """Whether they are of several cameras, or of one that sees several boards."""
        return self.several_cameras or len(self.targets) > 1

    @property
    def several_cameras(self) -> bool:
        """Whether they are of several cameras, or a table of several boards."""
        return is_rig(self.photos) or self.split is not None

    @property
    def named_cameras(self) -> set[str]:
        """Cameras that have a model or an image size of their own."""
        return {*self.models, *self.image_sizes} - {""}


def calibrate_inputs(
    given: CalibrationInputs,
    out: Path,
    options: CalibrationOptions,
    *,
    frames: FrameOptions,
    detection: DetectionOptions,
    lines: LinesOptions = LinesOptions(),
    executor: Executor | None = None,
    progress: ProgressCallback,
) -> CommandResult:
    """Calibrate from what is given and write the results into `out`; videos through their frames, which are written too.
    `executor` as in `detect`."""
    # Of one video too, a rolling shutter is told by frames that follow one another.
    frames = replace(frames, follow=frames.follow or options.rolling_shutter)
    patterns = list(given.targets)

    def from_frames(
        command: Callable[[list[Path]], CommandResult], target: str | None, check: Callable[[Sizes], None]
    ) -> CommandResult:
        """On the frames of videos, where photos are videos."""
        return with_frames(
            command, given.photos, out, target, check=check, split=given.split, mirror=options.mirror, detection=detection,
            options=frames, progress=progress,
        )  # fmt: skip

    if given.rig:
        cameras = {} if given.calibration is None else load(given.calibration)
        read = [] if given.calibration is None else [given.calibration]
        setup = RigSetup(options, given.models, given.boards, cameras, given.hold, given.time_offsets)
        if given.table is not None:
            return calibrate_rig_corners(given.table, given.image_sizes, out, setup, read=read, progress=progress)
        return from_frames(
            lambda paths: calibrate_rig_photos(
                paths,
                patterns,
                out,
                setup,
                camera=None if given.several_cameras else CAMERA,
                detection=detection,
                read=read,
                executor=executor,
                progress=progress,
            ),
            given.pattern,
            lambda sizes: setup.require(sizes if given.several_cameras else {CAMERA: next(iter(sizes.values()))}),
        )
    options = replace(options, model=given.models.get("", options.model))

    def require_model(_: Sizes) -> None:
        options.require_of_models([options.model])

    if given.lines:
        return from_frames(
            lambda paths: calibrate_line_photos(
                paths, given.pattern or "", out, options, lines, mask=given.mask, detection=detection, progress=progress
            ),
            None,
            require_model,
        )
    if given.table is not None:
        return calibrate_corners(given.table, given.image_sizes[""], out, options, progress=progress)
    return from_frames(
        lambda paths: calibrate_photos(
            paths, given.pattern or "", out, options, detection=detection, executor=executor, progress=progress
        ),
        given.pattern or "",
        require_model,
    )
