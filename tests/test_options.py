"""Options: walked, set by name, and refused where a name or a value is not known."""

import inspect
from dataclasses import dataclass
from typing import NamedTuple

import pytest

import omnilines as ol
from camera_models import InputError
from omnilines.options import walk, with_settings
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
