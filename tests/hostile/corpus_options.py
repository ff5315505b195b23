"""Options out of all reason, options that do nothing here, and folders that cannot be written to."""

from collections.abc import Iterator
from pathlib import Path

from hostile.case import Case
from hostile.good import give

PHOTOS = ("IN/photos", "--pattern", "checkerboard:7x5:30mm")
LENS = ("--calibration", "IN/calibration.yaml")
BASE: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "pattern": (("pattern", "checkerboard:7x5:30mm", "--out", "OUT/p.pdf"), ()),
    "detect": (("detect", *PHOTOS, "--out", "OUT"), ("photos",)),
    "calibrate": (("calibrate", *PHOTOS, "--model", "opencv-fisheye", "--out", "OUT"), ("photos",)),
    "corners": (("calibrate", "IN/corners.csv", "--image-size", "646x482", "--out", "OUT"), ("corners.csv",)),
    "convert": (("convert", "IN/calibration.yaml", "OUT.yml"), ("omnilines",)),
    "extract": (("extract", "IN/photos", *LENS, "--out", "OUT"), ("photos", "omnilines")),
    "directions": (("directions", "IN/photos", *LENS, "--out", "OUT"), ("photos", "omnilines")),
    "rectify": (("rectify", "IN/photos", *LENS, "--out", "OUT"), ("photos", "omnilines")),
    "adjust": (
        ("adjust", *LENS, "--poses", "IN/poses.csv", "--segments", "IN/segments.csv", "--out", "OUT"),
        ("omnilines", "poses.csv", "segments.csv"),
    ),
    "segments": (
        ("reconstruct", *LENS, "--poses", "IN/poses.csv", "--segments", "IN/segments.csv", "--out", "OUT"),
        ("omnilines", "poses.csv", "segments.csv"),
    ),
    "reconstruct": (
        ("reconstruct", "IN/photos", *LENS, "--poses", "IN/poses.csv", "--out", "OUT"),
        ("photos", "omnilines", "poses.csv"),
    ),
    "check": (("check", "IN/photos", *LENS, "--out", "OUT"), ("photos", "omnilines")),
    "lines": (("calibrate", "IN/photos", "--pattern", "lines", "--out", "OUT"), ("photos",)),
    "export": (("export", "IN/scene", "OUT/a.dxf"), ("scene",)),
    "doctor": (("doctor", "--no-check"), ()),
    "frames": (("frames", "IN/a.avi", "--out", "OUT"), ("a.avi",)),
    "targets": (
        ("render", "targets", "--pattern", "checkerboard:4x3:30mm", "--size", "320x240", "--views", "2", "--out", "OUT"),
        (),
    ),
    "scene": (("render", "scene", "--size", "64x48", "--views", "2", "--out", "OUT"), ()),
    "validate": (("validate", "--size", "320x240", "--pattern", "checkerboard:4x3:30mm", "--out", "OUT"), ()),
    "board": (("experiment", "board", "--data", "IN/photos", "--pattern", "checkerboard:7x5:30mm", "--out", "OUT"), ("photos",)),
    "wide": (("experiment", "wide", "--trials", "1", "--noise", "1", "--out", "OUT"), ()),
    "short": (("experiment", "short", "--trials", "1", "--noise", "1", "--out", "OUT"), ()),
    "room": (("experiment", "room", "--trials", "1", "--noise", "1", "--out", "OUT"), ()),
    "house": (("experiment", "house", "--data", "IN", "--out", "OUT"), ("omnilines",)),
    "book": (("experiment", "book", "--size", "64x48", "--out", "OUT"), ()),
}
"""Command -> a good command line, and the inputs that it needs."""
SIZES = ("", "640", "0x0", "-1x5", "640x", "9999999x9999999", "1e3x1e3", "nanxnan", "640x480x3")
FRACTIONS = ("nan", "inf", "-1", "1e300", "many")
COUNTS = ("0", "-1", "1000000000000", "nan", "1.5", "")
WRONG: dict[str, dict[str, tuple[str, ...]]] = {
    "corners": {
        "--image-size": SIZES,
        "--degree": ("1000000", "-1", "1", "nan"),
        "--loss": ("tukey", ""),
        "--model": ("", "fish", "cam0="),
    },
    "calibrate": {
        "--pattern": (
            "",
            "chess:7x5:30mm",
            "checkerboard:0x0:30mm",
            "checkerboard:7x5:nanmm",
            "checkerboard:99999x99999:1mm",
            "checkerboard:7x5:-3mm",
            "checkerboard:7x5:1e300m",
            "charuco:9x7:30mm:40mm:DICT_5X5_100",
            "\x1b[31m",
        ),
        "--refine-board": ("everything",),
        "--coefficients": ("3", "-1"),
        "--calibration": ("nowhere.yaml",),
        "--boards": ("flying",),
    },
    "convert": {
        "--fov": (*FRACTIONS, "0", "400"),
        "--image-size": SIZES,
        "--model": ("", "fish", "cylindrical"),
        "--from": ("", "bundler"),
        "--to": ("bundler",),
    },
    "extract": {"--mask": ("nowhere.png", "IN/photos", "IN/calibration.yaml")},
    "rectify": {
        "--size": SIZES,
        "--fov-deg": (*FRACTIONS, "0", "180", "400"),
        "--yaw-deg": ("nan", "inf"),
        "--pitch-deg": ("nan", "inf"),
        "--view": ("", "fish"),
        "--poses": ("nowhere.csv", "IN/calibration.yaml"),
    },
    "adjust": {
        "--subset": ("2",),
        "--bandwidth": ("0.1",),
        "--weights": ("heavy",),
        "--refine": ("", "everything"),
        "--cost": ("magic",),
        "--loss": ("tukey",),
        "--pose-sigma-deg": FRACTIONS,
        "--pose-sigma-m": FRACTIONS,
        "--device": ("toaster",),
        "--triangulation": ("magic",),
    },
    "segments": {
        "--pattern": ("checkerboard:7x5:30mm",),
        "--mask": ("IN/photos/0.png",),
        "--min-views": ("5",),
        "--tolerance-px": ("2",),
        "--scale-from": ("0.png,1.png:2",),
    },
    "reconstruct": {
        "--min-views": ("0", "-1", "2", "1000"),
        "--tolerance-px": FRACTIONS,
        "--pattern": ("checkerboard:7x5:30mm",),
        "--scale-from": ("a", "0.png,1.png:nan", "0.png,1.png:-2", "0.png,0.png:1", "x.png,y.png:1"),
        "--poses": ("", "nowhere.csv", "rectangle:0x0mm", "rectangle:nan", "boards"),
        "--seed": ("-1", "x"),
        "--robust": (),
    },
    "targets": {
        "--size": SIZES,
        "--views": COUNTS,
        "--noise": FRACTIONS,
        "--blur": FRACTIONS,
        "--fov-deg": (*FRACTIONS, "0", "500"),
        "--seed": ("-1", "1.5", ""),
        "--model": ("fish", "cylindrical"),
        "--pattern": ("checkerboard:7x5:1mm:9",),
    },
    "scene": {
        "--size": SIZES,
        "--views": COUNTS,
        "--noise": FRACTIONS,
        "--blur": FRACTIONS,
        "--fov-deg": (*FRACTIONS, "0", "500"),
        "--seed": ("-1",),
        "--scene": ("moon", ""),
        "--textures": ("nowhere",),
        "--texture-m": FRACTIONS,
        "--textured": ("clouds",),
    },
    "validate": {
        "--size": SIZES[:4],
        "--views": COUNTS[:3],
        "--noise": FRACTIONS,
        "--blur": FRACTIONS,
        "--fov-deg": FRACTIONS,
        "--seed": ("-1",),
        "--scene": ("moon",),
    },
    "board": {
        "--perturb-deg": FRACTIONS,
        "--perturb-m": FRACTIONS,
        "--seed": ("-1",),
        "--data": ("nowhere",),
        "--model": ("fish",),
    },
    "wide": {
        "--trials": COUNTS,
        "--noise": (*FRACTIONS, ""),
        "--perturb-deg": FRACTIONS,
        "--perturb-m": FRACTIONS,
        "--seed": ("-1",),
    },
    "short": {"--trials": ("0", "-1"), "--noise": ("nan", "-1"), "--seed": ("-1",)},
    "room": {"--trials": ("0", "-1"), "--noise": ("nan", "-1"), "--seed": ("-1",)},
    "house": {"--data": ("nowhere", "IN")},
    "book": {
        "--views": COUNTS[:3],
        "--noise": FRACTIONS,
        "--hand-px": FRACTIONS,
        "--lines": ("0", "-1"),
        "--seed": ("-1",),
        "--size": SIZES[:4],
    },
}
SAID = {
    "--fov": "field of view",
    "--fov-deg": "field of view",
    "--perturb-deg": "perturbation|disturbance",
    "--perturb-m": "perturbation|disturbance",
    "--mask": "nowhere|IN/",
    "--poses": "nowhere|IN/",
    "--data": "nowhere|IN",
    "--textures": "nowhere",
}
"""How the sentence may put what the option is of."""
IGNORED: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("corners", ("--pattern", "checkerboard:7x5:30mm", "--model", "opencv-fisheye")),
    ("corners", ("--model", "pinhole", "--degree", "4")),
    ("corners", ("--model", "scaramuzza", "--coefficients", "5")),
    ("corners", ("--model", "opencv-fisheye", "--degree", "4")),
    ("segments", ("--robust", "--colmap")),
    ("reconstruct", ("--robust",)),
    ("reconstruct", ("--pose-sigma-m", "0.1")),
    ("convert", ("--fov", "90")),
    ("targets", ("--mirror",)),
    ("scene", ("--texture-m", "2")),
    ("scene", ("--textured", "walls")),
    ("rectify", ("--view", "panorama", "--fov-deg", "90")),
)
"""Options that do nothing in the command where they stand."""
PLACES = (
    "/proc/omnilines",
    "/dev/null",
    "/dev/null/x",
    "IN/a-file",
    "IN/a-file/x",
    "",
    "O" * 300,
    "IN/link-to-itself/x",
    "IN/dangling/x/y",
)


def with_option(command: tuple[str, ...], option: str, value: str) -> tuple[str, ...]:
    """The command line with an option set, in place of what it has there."""
    if option in command:
        at = command.index(option)
        return (*command[: at + 1], value, *command[at + 2 :])
    return (*command, option, value)


def places(*given: str) -> "object":
    """The good inputs, a file and links that lead nowhere."""

    def prepare(folder: Path) -> None:
        give(*given)(folder)
        (folder / "IN/a-file").write_text("mine\n")
        (folder / "IN/link-to-itself").symlink_to("link-to-itself")
        (folder / "IN/dangling").symlink_to("/proc/nowhere")

    return prepare


def cases() -> Iterator[Case]:
    """All of them."""
    for name, options in WRONG.items():
        command, given = BASE[name]
        for option, values in options.items():
            for value in values:
                said = f"{option.strip('-').replace('-', '[-_ ]')}|{SAID.get(option, 'found')}"
                says = rf"{said}|{value[:12]!r}" if value.isalnum() and len(value) > 2 else f"{said}|found"
                yield Case(
                    f"{name}:{option[2:]}={value[:24]!r}", with_option(command, option, value), give(*given), f"(?i){says}"
                )
    for k, (name, options) in enumerate(IGNORED):
        command, given = BASE[name]
        for option in options[::2]:
            command = tuple(part for at, part in enumerate(command) if option not in (part, command[at - 1]))
        said = options[-2 if len(options) > 1 else -1]
        yield Case(f"ignored:{name}:{k}", (*command, *options), give(*given), f"{said.strip('-')}|{SAID.get(said, 'nothing')}")
    for name, (command, given) in BASE.items():
        if "--out" in command and name not in ("segments", "corners"):
            for place in PLACES:
                yield Case(
                    f"out:{name}:{place[:20]!r}",
                    with_option(command, "--out", place),
                    places(*given),
                    "folder|written|path|out|file",
                )
        yield Case(f"unknown-option:{name}", (*command, "--colour", "red"), give(*given), "colour")
