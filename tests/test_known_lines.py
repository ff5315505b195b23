"""Which arcs lines explain, compared in portions."""

import numpy as np
import pytest
from matching_scenes import room

from omnilines.matching import known_lines as module
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
