"""Which arcs lines explain, compared in portions."""

import numpy as np
import pytest
from matching_scenes import room

from omnilines.matching import known_lines as module
from omnilines.matching.asked import AskedLines
from omnilines.matching.known_lines import known_lines
from omnilines.matching.match import match_arcs
from omnilines.matching.options import MatchingOptions


def test_what_lines_explain_does_not_depend_on_portions(monkeypatch: pytest.MonkeyPatch) -> None:
    """All at once takes gigabytes where hundreds of photos show every line."""
    found = match_arcs(room("fisheye").arcs(0.3, 3))
    known = known_lines(found.arcs, found.tracks.track, found.tracks.lines)
    every = known.explaining(found.arcs, MatchingOptions())
    assert len(every[0]) > 200
    monkeypatch.setattr(module, "PAIRS_AT_ONCE", 97)
    for one, other in zip(every, known.explaining(found.arcs, MatchingOptions()), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10)


def test_photos_are_asked_for_the_lines_that_they_or_their_neighbours_show() -> None:
    rng = np.random.default_rng(4)
    photos, lines = 9, 30
    neighbours = np.triu(rng.random((photos, photos)) < 0.25, 1)
    neighbours |= neighbours.T
    image, line = rng.integers(0, photos, 80), rng.integers(-1, lines, 80)
    asked = AskedLines.near(neighbours, image, line, lines)
    for photo in range(photos):
        shown = {int(own) for at, own in zip(image, line, strict=True) if own >= 0 and (at == photo or neighbours[photo, at])}
        assert asked.lines[asked.starts[photo] : asked.starts[photo + 1]].tolist() == sorted(shown)
    assert 0 < len(asked.lines) < photos * lines
    everywhere = AskedLines.near(~np.eye(photos, dtype=bool), image, line, lines)
    assert len(everywhere.lines) == photos * len(np.unique(line[line >= 0]))
    assert everywhere.photos.tolist() == sorted(everywhere.photos.tolist())
