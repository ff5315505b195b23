"""Which options count where: one that does nothing in the mode that a command runs in is refused, not ignored.

`RULES` has a line for options that count only in some modes of a command; all others count always. An option is the parameter
of its flag; of those for --set it is the name, or its beginning up to a dot. `--set scene.min_views=3` gives `min_views`, as its
flag does. A rule is of what the user gave, whatever the value: a default given by name is no exception.
"""

from collections import Counter
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from camera_models.errors import InputError

PARTS = ("posing.", "matching.", "adjustment.", "structure.")
"""Options of a scene that are also known without its name before them."""


class Call(NamedTuple):
    """A command as it was called."""

    values: Mapping[str, Any]
    """Of all parameters, defaults too."""
    given: Collection[str]
    """Parameters and options for --set that the user gave."""

    def has(self, name: str) -> bool:
        """Whether a parameter was given, or is a flag that is on."""
        return name in self.given and self.values.get(name) is not False


class Rule(NamedTuple):
    """Options that count only where `counts` says so."""

    options: tuple[str, ...]
    counts: Callable[[Call], bool]
    where: str
    """The same in words, after "counts only"."""


def _of_photos(call: Call) -> bool:
    return bool(call.values["photos"])


def _of_segments(call: Call) -> bool:
    return not _of_photos(call)


def of_table(call: Call) -> bool:
    """Whether corners are given in place of photos."""
    return any(Path(path).suffix.lower() == ".csv" for path in call.values["photos"])


def _of_video(call: Call) -> bool:
    from omnilines.files.videos import find_videos

    return bool(find_videos(call.values["photos"]))


def _of_rig(call: Call) -> bool:
    from omnilines.pipelines.detect_rig import is_rig

    return is_rig(call.values["photos"]) or call.has("split") or len(_targets(call)) > 1


def _of_table_or_its_folder(call: Call) -> bool:
    """Whether corners are given, or a folder of nothing else, which the command refuses."""
    from omnilines.pipelines.detect_rig import table_without_photos

    return of_table(call) or table_without_photos(call.values["photos"]) is not None


def _of_board_photos(call: Call) -> bool:
    data = Path(call.values["data"])
    return data.suffix != ".csv" and not (data / "corners.csv").is_file()


def _patterns(call: Call) -> list[str]:
    return [text.strip() for text in (call.values["pattern"] or "").split(",")]


def _targets(call: Call) -> list[str]:
    return [spec for spec in _patterns(call) if spec != "lines"]


def of_lines(call: Call) -> bool:
    """Whether a camera is calibrated from lines."""
    return "lines" in _patterns(call)


def of_target(call: Call) -> bool:
    """Whether a target is looked for."""
    return bool(_targets(call))


def _of_tags(call: Call) -> bool:
    return any(spec.split(":")[0] != "checkerboard" for spec in _targets(call))


def _found_here(call: Call) -> bool:
    """Whether poses are found in the photos, or may be."""
    return call.values["poses"] == "sfm" or _refined(call) or call.values["poses"].startswith("rectangle:")


def _refined(call: Call) -> bool:
    """Whether poses are refined, those of sfm unless it is said otherwise."""
    refine = call.values.get("refine") or ("lines,poses" if call.values["poses"] == "sfm" else "lines")
    return "poses" in refine or "scene.refine" in call.given


IN_RIG = (
    "with a rig: a folder with one sub-folder per camera and equal file names, a corners.csv with a column camera, or several "
    "patterns"
)
WITH_PHOTOS = "with photos, found `segments` without them"
OF_SCENE = ("matching.", "posing.", "structure.", "rough_poses.", "rounds.", "kept_lines.", "frame.", "advice.", "bow_share")

OF_TARGET = tuple(
    f"calibration.{part}"
    for part in (
        *("views.", "screening.", "start.", "robust.", "degeneracy.", "doubt.", "noise.", "duplicates.", "shooting."),
        *("rig.", "clocks.", "loss", "refine_board", "searches"),
    )
)

RULES: dict[str, tuple[Rule, ...]] = {
    "frames": (
        Rule(("mirror", "detection.", "frames.most_of_target"), lambda call: call.has("pattern"), "with `pattern`"),
        Rule(("frames.most_of_scene", "frames.step_share"), lambda call: not call.has("pattern"), "without `pattern`"),
        Rule(("detection.tags.", "detection.appearance."), _of_tags, "with a target of tags"),
    ),
    "detect": (
        Rule(("detection.tags.", "detection.appearance."), _of_tags, "with a target of tags"),
    ),
    "calibrate": (
        Rule(("lines.", "mask"), of_lines, "with `pattern` lines"),
        Rule(
            ("loss", "refine_board", "rolling_shutter", "cluster", "detection.", *OF_TARGET),
            of_target,
            "with a target, found `pattern` lines",
        ),
        Rule(
            ("mirror", "calibration.mirror", "rolling_shutter"),
            lambda call: not (of_lines(call) and of_target(call)),
            "with a target alone, found lines beside it",
        ),
        Rule(("pattern", "detection.", "calibration.searches"), lambda call: not of_table(call), "with photos, found a table"),
        Rule(("frames.",), _of_video, "with a video"),
        Rule(("split", "cluster"), lambda call: not of_table(call), "with photos, found a table"),
        Rule(("frames.most_of_scene", "frames.step_share"), lambda call: False, "in `frames` without `pattern`"),
        Rule(("image_size",), _of_table_or_its_folder, "with a corners.csv, found photos, which have a size"),
        Rule(("boards", "calibration", "hold", "time_offsets", "calibration.rig.", "calibration.clocks."), _of_rig, IN_RIG),
        Rule(("calibration.duplicates.",), lambda call: not _of_rig(call), "with one camera, found a rig"),
        Rule(("detection.tags.", "detection.appearance."), _of_tags, "with a target of tags"),
    ),
    "board": (Rule(("pattern",), _of_board_photos, "with photos, found a corners.csv"),),
    "validate": (
        Rule(("mirror",), lambda call: call.has("scene"), "with `scene`"),
        Rule(("pattern",), lambda call: not call.has("scene"), "without `scene`"),
    ),
    "directions": (
        Rule(("directions.upright.",), lambda call: call.has("vertical"), "with `vertical`"),
        Rule(("directions.tried_axes",), lambda call: call.has("orthogonal"), "with `orthogonal`"),
        Rule(
            ("directions.max_directions", "directions.min_lines"), lambda call: not call.has("orthogonal"),
            "without `orthogonal`",
        ),
    ),
    "rectify": (
        Rule(("extraction.", "directions."), lambda call: call.has("upright"), "with `upright`"),
        Rule(("directions.tried_axes",), lambda call: False, "in `directions` with `orthogonal`"),
    ),
    "scene": (Rule(("texture_m", "textured"), lambda call: call.has("textures"), "with `textures`"),),
    "reconstruct": (
        Rule(
            ("mask", "cluster", "extraction."), lambda call: not call.has("segments"),
            "without `segments`: arcs are not looked for then",
        ),
        Rule(("split",), _of_photos, WITH_PHOTOS),
        Rule(("robust",), _of_segments, "with `segments` in place of photos: wrong arcs of photos are always left out"),
        Rule(
            ("pose_sigma_deg", "pose_sigma_m"),
            lambda call: _of_segments(call) or (_refined(call) and call.values["poses"] != "sfm"),
            "with `refine` poses, of a table or a model",
        ),
        Rule(
            ("pattern", "scale_from", "min_views", "tolerance_px", "colmap", "recording", "seed", "extraction."),
            _of_photos, WITH_PHOTOS,
        ),
        Rule(tuple(f"scene.{part}" for part in OF_SCENE), _of_photos, WITH_PHOTOS),
        Rule(("pattern",), lambda call: call.values["poses"] == "boards", "with `poses` boards"),
        Rule(("scene.rounds.", "partition"), _refined, "with `refine` poses"),
        Rule(
            ("scene.rough_poses.",), lambda call: _refined(call) and call.values["poses"] != "sfm",
            "with `refine` poses, of a table or a model",
        ),
        Rule(
            tuple(f"scene.posing.{part}." for part in ("features", "matches", "mapper", "growth", "carried")),
            _found_here, "with poses that are found in the photos",
        ),
        Rule(("scene.posing.rectangle.",), lambda call: call.values["poses"].startswith("rectangle:"), "with `poses` rectangle"),
        Rule(("scene.matching.tolerance.",), lambda call: not call.has("tolerance_px"), "without `tolerance_px`"),
        Rule(("scene.matching.bow.",), lambda call: not call.has("scene.bow_share"), "without `scene.bow_share`"),
    ),
    "adjust": (
        Rule(("partition",), lambda call: "poses" in call.values["refine"], "with `refine` poses"),
        Rule(
            ("extraction.", *(f"scene.{part}" for part in (*OF_SCENE, "min_views", "tolerance_px", "seed"))),
            lambda call: False, "in reconstruct with photos",
        ),
    ),
}  # fmt: skip
"""By command. The most general rule of an option stands first: its sentence is said."""


def call_of(values: Mapping[str, Any], given: Collection[str]) -> Call:
    """A call with what its `settings` give. Raises InputError where one thing is given twice."""
    names = [setting.partition("=")[0].strip() for setting in values.get("settings") or ()]
    names = [f"scene.{name}" if name.startswith(PARTS) else name for name in names]
    flags = [name.split(".")[1] for name in names if name.count(".") == 1]
    twice = [name for name, count in Counter([*names, *flags, *given]).items() if count > 1]
    if twice:
        raise InputError(f"`{twice[0]}` was expected once, found it twice; give one value.")
    return Call(values, {*given, *names, *(flag for flag in flags if flag in values)})


def require_counting(command: str, call: Call) -> None:
    """Raises InputError where an option was given that does nothing."""
    for rule in RULES.get(command, ()):
        idle = [name for name in sorted(call.given) if any(_is_of(name, option) for option in rule.options)]
        if idle and not rule.counts(call):
            shown = f"`{idle[0]}`" if idle[0] in call.values else idle[0]
            raise InputError(f"{shown} counts only {rule.where}, and does nothing here; leave it out.")


def _is_of(name: str, option: str) -> bool:
    return name == option or (option.endswith(".") and name.startswith(option))
