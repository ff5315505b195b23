"""omnilines frames: videos -> the frames worth keeping, and frames.csv, which says why. Other commands take videos through it."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from calib_patterns import DetectionOptions
from omnilines.commands.result import CommandResult
from omnilines.files.folders import check_results
from omnilines.files.sets import claimed
from omnilines.files.videos import find_videos
from omnilines.footage.options import FrameOptions
from omnilines.pipelines.frames import TABLE, ChosenFrames
from omnilines.pipelines.frames import frames as pipeline
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Summary

FOLDER = "frames"
"""Of the frames, in the results of a command that was given a video."""


def frames(
    videos: Sequence[Path],
    out: Path,
    pattern_spec: str | None = None,
    *,
    mirror: bool = False,
    detection: DetectionOptions = DetectionOptions(),
    options: FrameOptions = FrameOptions(),
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Write the frames worth keeping into `out`, of several videos into a folder for each, and `out/frames.csv`.

    Frames of an earlier run that are not taken any more are removed. Raises InputError as `pipelines.frames.frames` does.
    """
    check_results(out, [TABLE], videos)
    chosen = pipeline(videos, pattern_spec, mirrored=mirror, detection=detection, options=options, progress=progress)
    with claimed(out, chosen.names, videos, by="frames") as folder:
        files = chosen.save(folder, progress)
    return CommandResult(tuple(_summaries(chosen, out)), _data(chosen), files=files, warnings=chosen.notes)


def with_frames(
    command: Callable[[list[Path]], CommandResult],
    paths: Sequence[Path],
    out: Path,
    pattern_spec: str | None = None,
    *,
    mirror: bool = False,
    detection: DetectionOptions = DetectionOptions(),
    options: FrameOptions = FrameOptions(),
    progress: ProgressCallback = silent,
) -> CommandResult:
    """The result of a command on photos; where videos are given, on their frames, which are written to `out/frames`."""
    if not find_videos(paths):
        return command(list(paths))
    folder = out / FOLDER
    made = frames(paths, folder, pattern_spec, mirror=mirror, detection=detection, options=options, progress=progress)
    taken, looked = made.data["taken"], made.data["looked_at"]
    note = f"{taken} of {looked} frames that were looked at closely were taken; {folder / TABLE} says why."
    result = command([folder])
    return replace(result, warnings=(note, *made.warnings, *result.warnings))


def _summaries(chosen: ChosenFrames, out: Path) -> list[Summary]:
    found = []
    for number, video in enumerate(chosen.videos):
        rows = [row for row in chosen.rows if row.video == number]
        taken = [row for row in rows if row.taken]
        left = Counter(row.reason for row in rows if not row.taken)
        lines = [
            ("video", f"{video.duration_s:.1f} s, {video.count} frames of {'x'.join(map(str, video.image_size))} px"),
            ("looked at closely", f"{len(rows)} frames"),
            (
                "taken",
                f"{len(taken)} frames, at {', '.join(f'{row.time_s:.1f}' for row in taken[:8])}{' ...' * (len(taken) > 8)} s",
            ),
            *((reason, f"{count} frames") for reason, count in left.most_common(4)),
        ]
        found.append(Summary(f"Frames of {video.path.name}", tuple(lines), (f"written to {out}",)))
    return found


def _data(chosen: ChosenFrames) -> dict[str, object]:
    return {
        "videos": [str(video.path) for video in chosen.videos],
        "looked_at": len(chosen.rows),
        "taken": len(chosen.taken),
        "frames": [
            {"image": row.image, "video": chosen.videos[row.video].path.name, "frame": row.index, "time_s": row.time_s,
             "motion_px": row.motion_px, "sharpness": row.sharpness, "corners": row.corners, "taken": row.taken,
             "reason": row.reason}
            for row in chosen.rows
        ],
    }  # fmt: skip
