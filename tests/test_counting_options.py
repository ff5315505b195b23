"""The table of options that count in some modes only: its names are real, and what counts is not refused."""

from pathlib import Path

import pytest
import typer

from camera_models import InputError
from omnilines import cli
from omnilines.cli.counts import RULES, call_of, require_counting
from omnilines.options import range_of, walk, with_settings
from omnilines.pages.options import STAGES, options_of

OPTIONS = {name: value for stage, _ in STAGES for name, value, _ in walk(options_of(stage), f"{stage}.")}


def commands() -> dict[str, set[str]]:
    """The parameters of every command by its name."""
    found = {}
    groups = [typer.main.get_command(cli.app)]
    while groups:
        group = groups.pop()
        for name, command in group.commands.items():
            if hasattr(command, "commands"):
                groups.append(command)
            else:
                found[name] = {parameter.name for parameter in command.params}
    return found


def test_rules_name_options_that_there_are() -> None:
    known = commands()
    checked = 0
    for command, rules in RULES.items():
        for rule in rules:
            for option in rule.options:
                names = known[command] if "." not in option else OPTIONS
                assert any(name == option or (option.endswith(".") and name.startswith(option)) for name in names), option
                checked += 1
    assert checked > 50


def refused(command: str, given: dict[str, object], defaults: dict[str, object]) -> str | None:
    """Why a call is refused, or None."""
    try:
        require_counting(command, call_of({**defaults, **given}, list(given)))
    except InputError as error:
        return str(error)
    return None


RECONSTRUCT = {
    "photos": [],
    "segments": None,
    "poses": "poses.csv",
    "refine": None,
    "settings": None,
    "min_views": 4,
    "tolerance_px": None,
}
PHOTOS = {"photos": [Path("photos")]}


@pytest.mark.parametrize(
    "given",
    [
        {**PHOTOS, "min_views": 4, "tolerance_px": 2.0, "mask": Path("m.png"), "colmap": True, "seed": 1},
        {**PHOTOS, "segments": Path("s.csv"), "settings": ["scene.rounds.max_rounds=2"], "refine": "lines,poses"},
        {**PHOTOS, "poses": "sfm", "settings": ["posing.growth.min_seen=5", "rounds.max_rounds=3"]},
        {**PHOTOS, "poses": "boards", "pattern": "checkerboard:8x6:30mm"},
        {**PHOTOS, "settings": ["scene.refine=lines,poses", "scene.rough_poses.min_gain=2"]},
        {**PHOTOS, "refine": "lines,poses", "pose_sigma_m": 1.0, "pose_sigma_deg": 1.0},
        {"segments": Path("s.csv"), "robust": True, "pose_sigma_m": 1.0, "settings": ["adjustment.weak_share=0.2"]},
    ],
)  # fmt: skip
def test_what_counts_is_taken(given: dict[str, object]) -> None:
    assert refused("reconstruct", given, RECONSTRUCT) is None


def test_what_does_nothing_is_refused_by_its_name() -> None:
    said = refused("reconstruct", {"segments": Path("s.csv"), "min_views": 4}, RECONSTRUCT)
    assert said is not None and said.startswith("`min_views` counts only with photos")
    for given in ({"refine": "lines"}, {"poses": "sfm"}):
        said = refused("reconstruct", {**PHOTOS, **given, "pose_sigma_m": 1.0}, RECONSTRUCT)
        assert (
            said == "`pose_sigma_m` counts only with `refine` poses, of a table or a model, and does nothing here; leave it out."
        )
    said = refused("reconstruct", {"segments": Path("s.csv"), "settings": ["scene.min_views=4"]}, RECONSTRUCT)
    assert said is not None and "min_views" in said
    said = refused("reconstruct", {**PHOTOS, "segments": Path("s.csv"), "cluster": "local"}, RECONSTRUCT)
    assert said is not None and said.startswith("`cluster` counts only without `segments`")
    said = refused("reconstruct", {**PHOTOS, "min_views": 4, "settings": ["scene.min_views=4"]}, RECONSTRUCT)
    assert said == "`min_views` was expected once, found it twice; give one value."


@pytest.mark.slow
def test_ranges_hold_every_default_and_refuse_what_is_beyond_reason() -> None:
    """An option by its own default changes nothing; NaN, infinity and numbers without end are no values."""
    checked = 0
    for stage, _ in STAGES:
        options = options_of(stage)
        for name, value, _ in walk(options, f"{stage}."):
            numbers = value if isinstance(value, tuple) else (value,)
            if not numbers or not all(isinstance(number, int | float) and not isinstance(number, bool) for number in numbers):
                continue
            text = ",".join(map(repr, numbers))
            assert with_settings(options, [f"{name}={text}"], f"{stage}.") == options, name
            for wild in ("nan", "-1e300", "1e300", "-inf"):
                with pytest.raises(InputError):
                    with_settings(options, [f"{name}={','.join([wild] * len(numbers))}"], f"{stage}.")
            checked += 1
    assert checked > 300
    assert range_of("scene.seed", 0)[0] == 0
