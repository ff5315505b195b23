"""The sweep of options: what is tried, what matters, and what is said of the rest."""

from dataclasses import dataclass
from typing import NamedTuple

import pytest

from camera_models import InputError
from omnilines.studies.sensitivity import Outcome, others, sweep, table


class Edges(NamedTuple):
    """A group."""

    smoothing_px: float = 0.6
    """Sigma of the smoothing."""
    rounds: int = 3
    """Times."""
    nothing_px: float = 0.0
    """Neither half nor double."""


@dataclass(frozen=True)
class Options:
    """Of a stage."""

    edges: Edges = Edges()
    min_share: float = 0.8
    """Of the whole."""
    scales_px: tuple[float, ...] = (1.0, 2.0)
    """One after another."""
    loud: bool = False
    """Whether it is."""
    kind: str = "plain"
    """A name."""
    unused: int = 1
    """Nobody asks."""


def run(options: Options) -> Outcome:
    """A stage that refuses many rounds."""
    if options.edges.rounds > 5:
        raise ValueError("too many")
    found = 100.0 * options.edges.smoothing_px + (5.0 if options.loud else 0.0)
    figures = {"found": found, "share": options.min_share}
    return Outcome(figures, repr((figures, options.scales_px[0], options.edges.rounds)).encode())


@pytest.mark.parametrize(
    ("name", "value", "tried"),
    [
        ("a.smoothing_px", 0.6, (0.3, 1.2)),
        ("a.min_share", 0.8, (0.4, 0.9)),
        ("min_support", 0.2, (0.1, 0.4)),
        ("sigma_px", 0.9, (0.45, 1.8)),
        ("rounds", 3, (2, 6)),
        ("rounds", 1, (1, 2)),
        ("loud", True, (False,)),
        ("scales_px", (1.0, 2.0), ((0.5, 1.0), (2.0, 4.0))),
        ("nothing", 0.0, ()),
        ("kind", "plain", ()),
    ],
)
def test_values_that_are_tried(name: str, value: object, tried: tuple[object, ...]) -> None:
    assert tuple(others(name, value)) == pytest.approx(tried) if isinstance(value, float) else tuple(others(name, value)) == tried


def test_options_are_sorted_by_what_they_change() -> None:
    found = sweep(Options(), run)
    assert [row.name for row in found.matter] == ["edges.rounds", "edges.smoothing_px", "min_share", "loud", "scales_px"]
    assert found.without_effect == ("unused",)
    assert found.left_out == ("edges.nothing_px", "kind")
    by_name = {row.name: row for row in found.swept}
    assert by_name["edges.rounds"].tried[1] == (6, "raises ValueError")
    assert by_name["edges.smoothing_px"].effect(found.default) == pytest.approx(1.0)
    # 1 has no half among whole numbers.
    assert [value for value, _ in by_name["unused"].tried] == [2]
    text = table(found)
    assert "| `edges.smoothing_px` | 0.6 | 30, 120 | 0.8, 0.8 |" in text
    assert "| `edges.rounds` | 3 | 60, raises ValueError | 0.8, raises ValueError |" in text
    assert "No result changes with `unused`." in text and "double: `edges.nothing_px`, `kind`." in text


def test_a_part_of_the_options_can_be_swept() -> None:
    found = sweep(Options(), run, only="edges.")
    assert [row.name for row in found.swept] == ["edges.smoothing_px", "edges.rounds"]
    with pytest.raises(InputError, match="'edgse'"):
        sweep(Options(), run, only="edgse")
