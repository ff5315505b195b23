"""Options that do nothing where they stand, are given twice, or have values out of all reason by --set."""

from collections.abc import Iterator

from hostile.case import Case
from hostile.corpus_options import BASE
from hostile.good import give

BOARD = "checkerboard:7x5:30mm"
ALL_PLACES = "walls,floors,ceilings,furniture"
IDLE: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("corners", ("--pattern", BOARD)),
    ("corners", ("--boards", "moving")),
    ("corners", ("--boards", "fixed")),
    ("corners", ("--hold",)),
    ("corners", ("--calibration", "IN/corners.csv")),
    ("corners", ("--model", "pinhole", "--set", "calibration.degree=4")),
    ("corners", ("--model", "unified", "--coefficients", "8")),
    ("corners", ("--model", "auto", "--coefficients", "8")),
    ("corners", ("--set", "calibration.searches=2")),
    ("corners", ("--set", "calibration.rig.proposers=3")),
    ("corners", ("--set", "detection.min_corners=8")),
    ("corners", ("--image-size", "646x482,cam0=646x482")),
    ("calibrate", ("--image-size", "646x482")),
    ("calibrate", ("--boards", "known")),
    ("calibrate", ("--degree", "4")),
    ("calibrate", ("--set", "detection.tags.max_misfit=0.2")),
    ("detect", ("--set", "detection.appearance.max_pieces=3")),
    ("convert", ("--image-size", "646x482")),
    ("convert", ("--model", "opencv-fisheye", "--fov", "150")),
    ("segments", ("--robust", "--recording")),
    ("segments", ("--seed", "3")),
    ("segments", ("--min-views", "4")),
    ("segments", ("--scale-from", "0.png,1.png:2")),
    ("segments", ("--set", "extraction.min_length_px=30")),
    ("segments", ("--set", "scene.min_views=4")),
    ("segments", ("--set", "scene.rounds.max_rounds=3")),
    ("segments", ("--set", "matching.explained.reach_px=2")),
    ("segments", ("--subset", "4")),
    ("segments", ("--set", "scene.triangulation=svd", "--weights", "unit")),
    ("segments", ("--pose-sigma-deg", "1", "--pose-sigma-m", "0.1")),
    ("reconstruct", ("--robust",)),
    ("reconstruct", ("--pattern", BOARD)),
    ("reconstruct", ("--pose-sigma-deg", "1")),
    ("reconstruct", ("--set", "scene.rounds.max_rounds=3")),
    ("reconstruct", ("--set", "scene.rough_poses.min_gain=2")),
    ("reconstruct", ("--set", "posing.growth.min_seen=5")),
    ("reconstruct", ("--set", "scene.posing.rectangle.max_arcs=5")),
    ("reconstruct", ("--tolerance-px", "1", "--set", "matching.tolerance.chance_sigmas=3")),
    ("reconstruct", ("--segments", "IN/poses.csv", "--mask", "IN/photos/0.png")),
    ("reconstruct", ("--segments", "IN/poses.csv", "--set", "extraction.min_length_px=30")),
    ("adjust", ("--set", "scene.min_views=5")),
    ("adjust", ("--set", "scene.structure.families.min_members=5")),
    ("adjust", ("--set", "extraction.min_length_px=30")),
    ("adjust", ("--triangulation", "svd", "--subset", "4")),
    ("adjust", ("--refine", "lines", "--pose-sigma-deg", "1", "--pose-sigma-m", "0.1")),
    ("validate", ("--mirror",)),
    ("validate", ("--scene", "room", "--pattern", BOARD)),
    ("scene", ("--textured", ALL_PLACES)),
    ("scene", ("--texture-m", "1.5")),
    ("scene", ("--model", "opencv-fisheye", "--mirror")),
    ("board", ("--data", "IN/corners.csv", "--pattern", BOARD)),
    ("board", ("--triangulation", "svd", "--bandwidth", "0.1")),
    ("rectify", ("--view", "cube", "--fov-deg", "100")),
    ("rectify", ("--set", "directions.tried_rad=0.01")),
    ("rectify", ("--upright", "--set", "directions.tried_axes=4")),
    ("directions", ("--set", "directions.tried_axes=4")),
    ("directions", ("--vertical", "--set", "directions.tried_axes=5")),
    ("directions", ("--orthogonal", "--set", "directions.max_directions=4")),
)
"""Command -> what it is given and does nothing there; the last option is at fault."""
TWICE: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("corners", ("--degree", "3", "--degree", "4")),
    ("corners", ("--degree", "3", "--set", "calibration.degree=4")),
    ("corners", ("--image-size", "646x482")),
    ("convert", ("--to", "opencv", "--to", "kalibr")),
    ("extract", ("--set", "extraction.min_length_px=30", "--set", "extraction.min_length_px=40")),
    ("rectify", ("--yaw-deg", "1", "--yaw-deg", "2")),
    ("reconstruct", ("--min-views", "3", "--set", "scene.min_views=4")),
    ("reconstruct", ("--set", "matching.explained.reach_px=2", "--set", "scene.matching.explained.reach_px=3")),
    ("adjust", ("--poses", "IN/poses.csv")),
    ("targets", ("--seed", "1", "--seed", "1")),
    ("wide", ("--noise", "2")),
)
STAGES = {
    "detect": ("detection.min_corners", "detection.fit.max_sigma_px", "detection.views.half_angle_deg"),
    "corners": ("calibration.views.least_views", "calibration.robust.reject_sigma", "calibration.start.half_angles_deg"),
    "extract": ("extraction.min_length_px", "extraction.chains.min_points", "extraction.clutter.strong_grey"),
    "directions": ("directions.tried_rad", "directions.used_arcs", "directions.strays_rad"),
    "reconstruct": ("scene.matching.explained.reach_px", "scene.kept_lines.max_chance", "scene.seed"),
    "adjust": ("scene.adjustment.loss_scale", "scene.adjustment.weak_share", "adjustment.start_rounds"),
}
BEYOND = ("nan", "-1", "1e300", f"{10**30}", "-inf", "", " ", "many", "1," * 200 + "1", "9" * 5000)


def cases() -> Iterator[Case]:
    """All of them."""
    for k, (name, options) in enumerate(IDLE):
        command, given = BASE[name]
        for option in options:
            if option.startswith("--") and option in command:
                command = tuple(part for at, part in enumerate(command) if option not in (part, command[at - 1]))
        fault = [option for option in options if option.startswith("--")][-1].strip("-")
        named = options[-1].partition("=")[0] if fault == "set" else fault
        word = named.split(".")[-1].replace("_", ".")
        says = f"{named}|{word}|field of view|pose.sigma|degrees across"
        yield Case(f"idle:{name}:{k}", (*command, *options), give(*given), says)
    for k, (name, options) in enumerate(TWICE):
        command, given = BASE[name]
        yield Case(f"twice:{name}:{k}", (*command, *options), give(*given), "expected once, found it")
    for name, options in STAGES.items():
        command, given = BASE[name]
        for option in options:
            for value in BEYOND:
                arguments = (*command, "--set", f"{option}={value}")
                yield Case(f"set:{option}={value[:12]!r}", arguments, give(*given), option.split(".")[-1])
    for name, (command, given) in BASE.items():
        if "--out" in command:
            at = command.index("--out")
            arguments = (*command[: at + 1], "--json", *command[at + 2 :])
            yield Case(f"no-value:{name}", arguments, give(*given), "after --out, found the option --json")
