"""Edge points along the arcs of a photo, against edges drawn beside one another."""

import numpy as np
import pytest
from scipy.special import ndtr

from camera_models import model_class
from omnilines.extraction import edge_chains
from omnilines.extraction.edge_chains import arc_chains

SIZE = (240, 160)
BLUR_PX = 0.7
CAMERA = model_class("pinhole")([200.0, 200.0, 119.5, 79.5, *[0.0] * 9], SIZE)


def wedge() -> tuple[np.ndarray, np.ndarray]:
    """A bright strip on grey that narrows from 5 to 2.5 px, and the height of its upper edge at each column."""
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    upper, lower = 60.0 + 0.1 * u[0], 65.0 + (0.1 - 2.5 / SIZE[0]) * u[0]
    slopes = np.hypot(1.0, 0.1)
    grey = 70.0 + 110.0 * ndtr((v - upper) / slopes / BLUR_PX) - 60.0 * ndtr((v - lower) / slopes / BLUR_PX)
    noise = np.random.default_rng(0).normal(0.0, 1.0, grey.shape)
    return np.clip(np.rint(grey + noise), 0, 255).astype(np.uint8), upper


def off_at_narrow_end(image: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """How far the points of the upper edge lie below it where the strip is about 3 px wide."""
    chains = arc_chains(image, CAMERA, "wedge")
    below = chains.pixels[:, 1] - np.interp(chains.pixels[:, 0], np.arange(SIZE[0]), upper)
    own = np.abs(np.bincount(chains.chain, below) / np.bincount(chains.chain)) < 0.5
    rows = own[chains.chain] & (chains.pixels[:, 0] > 0.7 * SIZE[0]) & (chains.pixels[:, 0] < 0.9 * SIZE[0])
    assert rows.sum() > 20
    return below[rows]


def test_edge_points_are_not_drawn_away_by_the_edge_beside(monkeypatch: pytest.MonkeyPatch) -> None:
    image, upper = wedge()
    off = off_at_narrow_end(image, upper)
    monkeypatch.setattr(
        edge_chains, "_off_neighbours", lambda done, at, sample, *_: (np.zeros(len(sample)), np.zeros(len(sample)))
    )
    alone = off_at_narrow_end(image, upper)
    assert abs(off.mean()) < 0.02 < 0.05 < abs(alone.mean()), (off.mean(), alone.mean())
