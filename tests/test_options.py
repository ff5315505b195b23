"""Options: walked, set by name, and refused where a name or a value is not known."""

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import pytest

import omnilines as ol
from camera_models import Calibration, InputError, Pinhole
from omnilines.options import _with, walk, with_settings
from omnilines.pages.options import options_of
from omnilines.pipelines.photo_arcs import PhotoArcs
from omnilines.posing.options import FeatureOptions, PosingOptions
from omnilines.provenance import provenance


class Edges(NamedTuple):
    """A group."""

    smoothing_px: float = 0.6
    """Sigma of the smoothing."""
    rounds: int = 2
    """Times."""


@dataclass(frozen=True)
class Options:
    """Of a stage."""

    edges: Edges = Edges()
    scales_px: tuple[float, ...] = (1.0, 2.0)
    """One after another."""
    loud: bool = False
    """Whether it is."""
    degree: int | None = None
    """Chosen where it is not given."""
    parts: tuple[str, ...] = ()
    """Names."""


def test_every_option_has_its_name_value_and_sentence() -> None:
    assert list(walk(Options(), "stage.")) == [
        ("stage.edges.smoothing_px", 0.6, "Sigma of the smoothing."),
        ("stage.edges.rounds", 2, "Times."),
        ("stage.scales_px", (1.0, 2.0), "One after another."),
        ("stage.loud", False, "Whether it is."),
        ("stage.degree", None, "Chosen where it is not given."),
        ("stage.parts", (), "Names."),
    ]


def test_settings_replace_what_they_name_and_leave_the_rest() -> None:
    settings = ["s.edges.smoothing_px=0.9", "s.scales_px=1,2,4", "s.loud=true", "s.edges.rounds=3", "s.degree=4", "s.parts=a,b"]
    assert with_settings(Options(), settings, "s.") == Options(Edges(0.9, 3), (1.0, 2.0, 4.0), True, 4, ("a", "b"))
    assert with_settings(Options(), []) == Options()


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("edges.smothing_px=1", "did you mean edges.smoothing_px"),
        ("edges.smoothing_px", "edges.smoothing_px=VALUE"),
        ("edges=1", "NAME=VALUE"),
        ("edges.rounds=1.5", "a value like 2"),
        ("edges.smoothing_px=nan", "a value like 0.6"),
        ("loud=perhaps", "true or false"),
        ("scales_px=1,x", "a value like"),
        ("degree=four", "a number"),
    ],
)
def test_what_is_not_known_is_refused(setting: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        with_settings(Options(), [setting])


def test_options_show_what_is_not_as_by_default_and_state_all() -> None:
    """Signatures in `help` are short; what a result was made from holds every value."""
    changed = ol.SceneOptions(seed=3, posing=PosingOptions(features=FeatureOptions(max_features=9)))
    assert repr(ol.SceneOptions()) == "SceneOptions()"
    assert repr(changed).startswith("SceneOptions(seed=3, posing=PosingOptions(features=FeatureOptions(max_features=9, ")
    assert "min_views=4" in changed.stated and "'mapper': MapperOptions(" in changed.stated
    assert changed.stated != ol.SceneOptions(seed=3).stated
    assert "min_views=4" in provenance({"options": changed})["inputs"]["options"]
    assert all(len(str(inspect.signature(function))) < 1200 for function in (ol.calibrate, ol.reconstruct, ol.extract))


CAMERA = Pinhole([300.0, 300.0, 159.5, 119.5, *[0.0] * 9], (320, 240))
ARCS = PhotoArcs((), Calibration({"cam0": CAMERA}))
CALLS: dict[str, Callable[[Any], object]] = {
    "frames": lambda options: ol.frames("nowhere.mp4", options=options),
    "detection": lambda options: ol.frames("nowhere.mp4", "checkerboard:8x6:30mm", detection=options),
    "calibration": lambda options: ol.calibrate("nowhere", "checkerboard:8x6:30mm", options),
    "extraction": lambda options: ol.rectify("nowhere", CAMERA, extraction=options),
    "directions": lambda options: ol.directions(ARCS, options=options),
    "lines": lambda options: ol.calibrate("nowhere", "lines", lines=options),
    "check": lambda options: ol.check("nowhere", CAMERA, options),
    "posing": lambda options: ol.estimate_poses("nowhere", CAMERA, "sfm", options=options),
}
"""By the options, what takes them, with inputs that there are not: options are looked at first."""


def refusal(call: Callable[[], object]) -> str:
    """What is said of a value, without the value."""
    with pytest.raises(InputError) as refused:
        call()
    return str(refused.value).partition(", found")[0]


def numbers_of(stage: str) -> list[tuple[str, Any]]:
    """The options of a stage that are numbers or lists of them."""
    every = ((name, value) for name, value, _ in walk(options_of(stage)))
    return [
        (name, value)
        for name, value in every
        if (own := value if isinstance(value, tuple) else (value,))
        and all(isinstance(one, int | float) and not isinstance(one, bool) for one in own)
    ]


@pytest.mark.parametrize("stage", CALLS)
def test_python_refuses_the_values_that_the_command_line_refuses_with_the_same_sentence(stage: str) -> None:
    """`rectify`, `frames` and `directions` took what `--set` refuses: a separation of 0 searched for ever."""
    call, options, checked = CALLS[stage], options_of(stage), 0
    for name, value in numbers_of(stage):
        kind = type(value[0] if isinstance(value, tuple) else value)
        for wild in (kind(10**30), kind(-(10**30))):
            several = (wild,) * len(value) if isinstance(value, tuple) else wild
            text = ",".join([str(wild)] * (len(value) if isinstance(value, tuple) else 1))
            said = refusal(lambda name=name, text=text: with_settings(options, [f"{name}={text}"]))  # type: ignore[misc]
            assert name in said
            assert refusal(lambda name=name, several=several: call(_with(options, name.split("."), several))) == said  # type: ignore[misc]
            checked += 1
        if kind is float:
            several = (math.nan,) * len(value) if isinstance(value, tuple) else math.nan
            refusal(lambda name=name, several=several: call(_with(options, name.split("."), several)))  # type: ignore[misc]
    assert checked > 20


def test_lists_are_as_long_in_python_as_on_the_command_line() -> None:
    """No stray at all ended in a traceback."""
    for strays in ((), (0.01,) * 1000):
        assert "strays_rad was expected as a list of 1 to 20" in refusal(
            lambda strays=strays: ol.directions(ARCS, options=ol.DirectionsOptions(strays_rad=strays))  # type: ignore[misc]
        )


def test_a_number_by_name_has_the_range_of_its_option() -> None:
    said = refusal(lambda: ol.calibrate("nowhere", "checkerboard:8x6:30mm", degree=1000))
    assert said == refusal(lambda: with_settings(ol.CalibrationOptions(), ["degree=1000"]))
