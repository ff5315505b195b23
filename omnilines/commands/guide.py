"""omnilines guide: a camera, a video or a growing folder -> frames, calibration.yaml, report.html, with a page that says how to
hold the board next."""

import contextlib
import itertools
from collections.abc import Callable
from pathlib import Path

from calib_patterns import DetectionOptions
from calib_patterns import pattern as parse_pattern
from omnilines.calibration.options import CalibrationOptions
from omnilines.commands.result import CommandResult
from omnilines.files.sets import withdrawn_where_refused
from omnilines.guide.follow import follow
from omnilines.guide.options import GuideOptions
from omnilines.guide.server import served
from omnilines.guide.session import RESULTS, Session
from omnilines.guide.source import Source
from omnilines.pages.calibration import calibration_data, calibration_summaries
from omnilines.progress import ProgressCallback, silent


def guide(
    source: str,
    pattern_spec: str,
    out: Path,
    options: GuideOptions = GuideOptions(),
    *,
    calibration: CalibrationOptions = CalibrationOptions(),
    detection: DetectionOptions = DetectionOptions(),
    port: int = 0,
    announce: Callable[[str], None] = print,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Calibrate one camera while it is shown the board; `announce` is told the address of the page.

    Raises InputError where source, pattern or folder cannot be used, or too little was shown.
    """
    given = Source(source, options.frames_per_s)
    inputs = [] if given.path is None else [given.path]
    pattern, coming = parse_pattern(pattern_spec), given.frames()
    # A source that gives nothing is refused before anything is made.
    first = next(coming)
    session = Session(pattern, out, options, calibration, detection, inputs=inputs)
    # A video is the same the next time; a camera and a folder give more, and the frames that were kept count then.
    with withdrawn_where_refused(out) if given.ends else contextlib.nullcontext(), served(session, port) as address:
        announce(address)
        follow(session, itertools.chain([first], coming), waits=not given.live, progress=progress)
        progress("calibrating from all frames", 0, 0)
        result = session.finish()
    files = (*(out / name for name in session.names), *(out / name for name in RESULTS))
    data = {**calibration_data(result), "frames": {"looked_at": session.offered, "kept": len(session.kept)}}
    return CommandResult(calibration_summaries(result), data, files=files, report=out / RESULTS[-1], warnings=result.warnings)
