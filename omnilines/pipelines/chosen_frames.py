"""Which of the frames that were looked at are taken, and why: what `frames` returns."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib_patterns import Pattern
from camera_models import GeometryError, InputError
from camera_models.typed import typed
from omnilines.calibration.single import calibrate_camera
from omnilines.calibration.telling import ViewInformation, telling_instants, view_information
from omnilines.files import PhotoArray, write_png
from omnilines.files.frames import TABLE, FrameRow, write_frames
from omnilines.files.sets import claimed
from omnilines.footage.options import FrameOptions
from omnilines.footage.stillness import Instant, spaced
from omnilines.pipelines.instants import Lens
from omnilines.pipelines.looked_frames import LookedInstant, not_looked_at
from omnilines.pipelines.photo_corners import corner_table
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Corners

GUIDE = "scaramuzza"
"""The model by which views are compared: it fits lenses of every width."""
BESIDE = "it shows how the board moves beside one that tells much"


@dataclass(frozen=True)
class ChosenFrames:
    """The frames of one or more videos that were looked at closely, and which of them were taken."""

    lenses: tuple[Lens, ...]
    """The cameras."""
    rows: tuple[FrameRow, ...]
    """Of every frame that was looked at, with why it was taken or not."""
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"ChosenFrames(taken={len(self.taken)} of {len(self.rows)})"

    @property
    def taken(self) -> tuple[FrameRow, ...]:
        """The frames that were taken."""
        return tuple(row for row in self.rows if row.taken)

    @property
    def names(self) -> tuple[str, ...]:
        """Files that `save` writes."""
        return (*(row.image for row in self.taken), TABLE)

    def read(self) -> Iterator[PhotoArray]:
        """The frames taken, as photos; the videos are decoded once more."""
        for video in dict.fromkeys(lens.video for lens in self.lenses):
            wanted: dict[int, list[FrameRow]] = {}
            for row in self.taken:
                if self.lenses[row.lens].video == video:
                    wanted.setdefault(row.index, []).append(row)
            for frame in video.frames(wanted.keys()):
                for row in wanted[frame.index]:
                    yield PhotoArray(row.image, self.lenses[row.lens].of(frame.pixels), row.time_s)

    def photos(self) -> list[PhotoArray]:
        """`read`, all in memory: for `detect`, `extract` and the like."""
        return list(self.read())

    @typed
    def save(self, folder: str | Path, progress: ProgressCallback = silent) -> tuple[Path, ...]:
        """Write the frames as PNG, of several cameras a folder for each, and `frames.csv`, which says why; returns the files."""
        inputs = [lens.video.path for lens in self.lenses]
        with claimed(folder, self.names, inputs, by="frames") as out:
            for done, photo in enumerate(self.read(), 1):
                write_png(out / photo.name, photo.pixels)
                progress("writing frames", done, len(self.taken))
            write_frames(out / TABLE, self.rows, [lens.video.title for lens in self.lenses])
        return tuple(Path(folder) / name for name in self.names)


def with_runs(chosen: ChosenFrames, instants: Sequence[Instant], run: int) -> tuple[FrameRow, ...]:
    """The rows with the frames beside those taken, which are taken too."""
    place = {instant.index: k for k, instant in enumerate(instants)}
    by_instant: dict[int, list[FrameRow]] = {}
    rows = iter(chosen.rows)
    while own := list(itertools.islice(rows, len(chosen.lenses))):
        by_instant[place[tuple(row.index for row in own)]] = own
    for k in [k for k, own in by_instant.items() if own[0].taken]:
        low = max(0, min(k - run // 2, len(instants) - run))
        for beside in range(low, min(low + run, len(instants))):
            if beside not in by_instant:
                reasons = [[BESIDE] * len(chosen.lenses)]
                by_instant[beside] = list(_rows(chosen.lenses, [not_looked_at(instants[beside])], {0}, reasons))
            elif not by_instant[beside][0].taken:
                by_instant[beside] = [replace(row, taken=True, reason=BESIDE) for row in by_instant[beside]]
    return tuple(row for k in sorted(by_instant) for row in by_instant[k])


def frames_of_scene(lenses: Sequence[Lens], looked: Sequence[LookedInstant], options: FrameOptions) -> tuple[FrameRow, ...]:
    """Those between which what the first camera sees has moved."""
    way = [instant.looks[0].travelled_px for instant in looked]
    kept = set(spaced(way, options.step_share * lenses[0].image_size[0], options.most_of_scene))
    reasons = ["the scene has moved since the frame before" if place in kept else "it shows what another frame shows"
               for place in range(len(looked))]  # fmt: skip
    return _rows(lenses, looked, kept, [[reason] * len(lenses) for reason in reasons])


def frames_of_targets(
    lenses: tuple[Lens, ...], looked: Sequence[LookedInstant], targets: Sequence[Pattern], most: int, doubts: Sequence[str]
) -> ChosenFrames:
    """Those that tell most of the cameras. Raises InputError where the only camera sees no target; `doubts` about its video are
    said then."""
    instants: dict[str, int] = {}
    cameras: list[ViewInformation] = []
    notes: list[str] = []
    names = " or ".join(target.specification for target in targets)
    for number, lens in enumerate(lenses):
        tables = []
        for k, target in enumerate(targets):
            views = [_view(image_name(lenses, number, one), k) for one in looked]
            instants |= {view: place for place, view in enumerate(views)}
            named = [(view, one.seen[number][k]) for view, one in zip(views, looked, strict=True) if len(one.seen[number][k])]
            tables += [corner_table(named, target)] if named else []
        if not tables:
            why = (looked[0].reasons[number] or "").rstrip(".")
            if len(lenses) == 1:
                raise InputError(
                    f"The pattern {names} was expected in at least one of the {len(looked)} stillest frames "
                    f"of {lens.video.location}, found in none (first reason: {why})"
                    + (f". {' '.join(doubts)}" if doubts else "; check its counts of inner corners.")
                )
            notes.append(f"{lens.name}: the pattern {names} was found in none of {len(looked)} frames.")
            continue
        corners = _joined(tables)
        try:
            cameras.append(view_information(corners, calibrate_camera(corners, lens.image_size, GUIDE)))
        except (InputError, GeometryError) as error:
            notes.append(f"{lens.name}: its frames are not compared by what they tell of the camera: {error}")
    seen = [place for place, one in enumerate(looked) if any(one.corners)]
    if cameras:
        kept = set(telling_instants(cameras, instants, len(looked), most))
        known = {name for camera in cameras for name in camera.names}
    else:
        kept = {seen[place] for place in np.linspace(0, len(seen) - 1, min(len(seen), most)).round().astype(int)}
        known = set()

    def reason(place: int, number: int) -> str:
        """Why the frame of a camera was taken, or was not."""
        one = looked[place]
        if place in kept:
            return "it tells much of the camera" if one.corners[number] else "another camera sees the target"
        if not one.corners[number]:
            return one.reasons[number] or "no corner was found"
        fits = not cameras or any(_view(image_name(lenses, number, one), k) in known for k in range(len(targets)))
        return "others tell more of the camera" if fits else "its corners do not fit the camera"

    reasons = [[reason(place, number) for number in range(len(lenses))] for place in range(len(looked))]
    return ChosenFrames(lenses, _rows(lenses, looked, kept, reasons), tuple(notes))


def image_name(lenses: Sequence[Lens], number: int, looked: LookedInstant) -> str:
    """The name of a frame as a photo; of several cameras those of one instant have the same in folders of their own."""
    if len(lenses) == 1:
        return f"{looked.index[0]:06d}.png"
    return f"{lenses[number].name}/{looked.index[0]:06d}.png"


def _view(image: str, target: int) -> str:
    """What a target in a frame is called."""
    return f"{image}, target {target + 1}" if target else image


def _joined(tables: Sequence[Corners]) -> Corners:
    """One table of views of several targets."""
    starts = np.cumsum([0, *(len(table.images) for table in tables)])
    names = tuple(name for table in tables for name in table.view_names)
    sigma_px = [table.sigma_px for table in tables if table.sigma_px is not None]
    return Corners(
        np.concatenate([table.view + start for table, start in zip(tables, starts[:-1], strict=True)]),
        names,
        names,
        np.concatenate([table.board_m for table in tables]),
        np.concatenate([table.pixels for table in tables]),
        np.concatenate(sigma_px),
    )


def _rows(
    lenses: Sequence[Lens], looked: Sequence[LookedInstant], kept: set[int], reasons: Sequence[Sequence[str]]
) -> tuple[FrameRow, ...]:
    return tuple(
        FrameRow(
            image=image_name(lenses, number, one),
            lens=number,
            index=one.index[number],
            time_s=one.time_s[number],
            stamp_ns=_stamp_ns(lenses[number].video.begins_ns, one.time_s[number]),
            motion_px=one.looks[number].motion_px,
            sharpness=one.looks[number].sharpness,
            corners=one.corners[number],
            taken=place in kept,
            reason=reasons[place][number],
        )
        for place, one in enumerate(looked)
        for number in range(len(lenses))
    )


def _stamp_ns(begins_ns: int | None, time_s: float) -> int | None:
    return None if begins_ns is None else begins_ns + round(1e9 * time_s)
