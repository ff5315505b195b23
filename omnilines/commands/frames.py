"""omnilines frames: videos and bags -> the frames worth keeping, and frames.csv, which says why. Other commands take them through
it."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from calib_patterns import DetectionOptions
from camera_models import Calibration, InputError
from omnilines.commands.camera_videos import Sizes
from omnilines.commands.result import CommandResult
from omnilines.files import PhotoRef, find_photos, write_png
from omnilines.files.folders import WORK, alone_in, check_output_folder, check_results, check_work_folder, way_out
from omnilines.files.frames import TABLE
from omnilines.files.photos import require_distinct_stems
from omnilines.files.sets import claimed, withdrawn_where_refused
from omnilines.files.split import Split
from omnilines.files.videos import find_videos, open_videos
from omnilines.footage.options import FrameOptions
from omnilines.pipelines.chosen_frames import ChosenFrames
from omnilines.pipelines.frames import frames as pipeline
from omnilines.pipelines.instants import lenses_of
from omnilines.pipelines.recognise import OTHERWISE
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Summary

FOLDER = "frames"
"""Of the frames, in the results of a command that was given a video."""


def frames(
    videos: Sequence[Path],
    out: Path,
    pattern_spec: str | None = None,
    *,
    split: str | None = None,
    mirror: bool = False,
    work: Path | None = None,
    detection: DetectionOptions = DetectionOptions(),
    options: FrameOptions = FrameOptions(),
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Write the frames worth keeping into `out`, of several videos into a folder for each, and `out/frames.csv`. What frames show
    of a target is kept in the folder `work`, or in `out/work`.

    Frames of an earlier run that are not taken any more are removed. Raises InputError as `pipelines.frames.frames` does.
    """
    check_results(out, [TABLE], videos)
    work = out / WORK if work is None else work
    check_work_folder(work, videos)
    chosen = pipeline(
        videos,
        pattern_spec,
        split=split,
        mirrored=mirror,
        work=work,
        detection=detection,
        options=options,
        progress=progress,
    )
    files = chosen.save(out, progress)
    then = () if pattern_spec is None else ("calibrate", str(out), "--pattern", pattern_spec, "--out", "result")
    return CommandResult(tuple(_summaries(chosen, out)), _data(chosen), files=files, warnings=chosen.notes, then=then)


def with_frames(
    command: Callable[[list[Path]], CommandResult],
    paths: Sequence[Path],
    out: Path,
    pattern_spec: str | None = None,
    *,
    check: Callable[[Sizes], Calibration | None] = lambda _: None,
    split: str | None = None,
    mirror: bool = False,
    detection: DetectionOptions = DetectionOptions(),
    options: FrameOptions = FrameOptions(),
    progress: ProgressCallback = silent,
) -> CommandResult:
    """The result of a command on photos; where videos are given, on their frames, which are written to `out/frames`, and with
    `split` on what each lens sees of the photos, written there too.

    `check` is asked before any frame is read: it refuses videos, and options, by the width and height that each camera sees, and
    returns the calibration that the command goes by. Of one video of a calibrated rig the frames lie in a folder of its camera.
    """
    folder = out / FOLDER
    check_output_folder(out)
    if (why := way_out(out, f"{FOLDER}/{TABLE}")) is not None:
        raise InputError(f"Frames were expected inside {out}, found {why}.")
    if not find_videos(paths):
        if split is None:
            return command(list(paths))
        lenses, photos = Split.of(split), find_photos(paths)
        with withdrawn_where_refused(folder), alone_in(out / WORK):
            _cut(paths, photos, folder, lenses, progress)
            return command([folder])
    # What the command would refuse is refused before anything is made.
    seen = {lens.name: lens.image_size for lens in lenses_of(open_videos(paths), None if split is None else Split.of(split))}
    cameras = check(seen)
    if len(seen) == 1 and cameras is not None and len(cameras) > 1:
        folder = folder / next(iter(seen))
    # Another run would put its frames in the place of those that are about to be read.
    with withdrawn_where_refused(folder), alone_in(out / WORK):
        made = frames(
            paths,
            folder,
            pattern_spec,
            split=split,
            mirror=mirror,
            work=out / WORK,
            detection=detection,
            options=options,
            progress=progress,
        )
        result = command([folder])
    taken, looked = made.data["taken"], made.data["looked_at"]
    note = f"{taken} of {looked} frames that were looked at closely were taken; {folder / TABLE} says why."
    # What the command says of the board from all photos, frames said from a few of them.
    again = any(OTHERWISE in said for said in result.warnings)
    of_frames = (said for said in made.warnings if not (again and said.startswith(OTHERWISE)))
    return replace(result, warnings=(note, *of_frames, *result.warnings))


def _cut(paths: Sequence[Path], photos: Sequence[PhotoRef], folder: Path, split: Split, progress: ProgressCallback) -> None:
    """Write what each lens sees of photos into a folder for each."""
    require_distinct_stems(photos)
    names = {photo.name: str(PurePosixPath(photo.name).with_suffix(".png")) for photo in photos}
    results = [f"{lens}/{name}" for lens in split.names for name in names.values()]
    with claimed(folder, results, [*paths, *(photo.path for photo in photos)], by="split"):
        for done, photo in enumerate(photos, 1):
            for lens, pixels in zip(split.names, split.parts(photo.read()), strict=True):
                path = folder / lens / names[photo.name]
                write_png(path, pixels)
            progress("cutting photos", done, len(photos))


def _summaries(chosen: ChosenFrames, out: Path) -> list[Summary]:
    found = []
    for number, lens in enumerate(chosen.lenses):
        rows = [row for row in chosen.rows if row.lens == number]
        taken = [row for row in rows if row.taken]
        left = Counter(row.reason for row in rows if not row.taken)
        lines = [
            ("video", f"{lens.video.duration_s:.1f} s, {lens.video.count} frames of {'x'.join(map(str, lens.image_size))} px"),
            ("looked at closely", _frames(len(rows))),
            ("taken", _frames(len(taken))),
            *(("left out", f"{_frames(count)}: {reason}") for reason, count in left.most_common(4)),
        ]
        title = f"Frames of {lens.video.title}" + (f", {lens.name}" if lens.split else "")
        found.append(Summary(title, tuple(lines), (f"written to {out}",)))
    return found


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"


def _data(chosen: ChosenFrames) -> dict[str, object]:
    return {
        "videos": list(dict.fromkeys(lens.video.location for lens in chosen.lenses)),
        "looked_at": len(chosen.rows),
        "taken": len(chosen.taken),
        "frames": [
            {"image": row.image, "video": chosen.lenses[row.lens].video.title, "frame": row.index, "time_s": row.time_s,
             "stamp_ns": row.stamp_ns, "motion_px": row.motion_px, "sharpness": row.sharpness, "corners": row.corners,
             "taken": row.taken, "reason": row.reason}
            for row in chosen.rows
        ],
    }  # fmt: skip
