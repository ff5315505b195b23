"""Options of extraction: each has a sentence and is used, and those set by name have their effect."""

from pathlib import Path

import cv2
import numpy as np
import pytest

import omnilines as ol
import omnilines.extraction
from camera_models import InputError, Pinhole
from omnilines.extraction import ExtractionOptions, extract_arcs
from omnilines.extraction.options import ChainOptions
from omnilines.options import walk, with_settings

CAMERA = Pinhole.from_mapping({"fx": 260.0, "fy": 260.0, "cx": 159.5, "cy": 119.5}, (320, 240))


def test_every_option_has_a_sentence_and_is_used() -> None:
    folder = Path(omnilines.extraction.__file__).parent
    code = "\n".join(path.read_text() for path in sorted(folder.rglob("*.py")) if path.name != "options.py")
    options = list(walk(ExtractionOptions()))
    assert len(options) > 60
    for name, _, sentence in options:
        assert sentence.endswith("."), name
        assert f".{name.split('.')[-1]}" in code, name


def strips() -> np.ndarray:
    """A photo of faint quadrangles and of strips 1.75 px wide."""
    rng = np.random.default_rng(4)
    image = np.full((960, 1280, 3), 120, dtype=np.uint8)
    for _ in range(20):
        corners = cv2.boxPoints(
            (rng.uniform([80, 80], [1200, 880]).tolist(), rng.uniform(100, 400, 2).tolist(), rng.uniform(0, 90))
        )
        cv2.fillPoly(image, [corners.astype(np.int32)], rng.uniform(105, 135, 3).tolist())
    for _ in range(8):
        ends = rng.integers(0, [1280, 960], (2, 2))
        cv2.line(image, ends[0].tolist(), ends[1].tolist(), (250, 250, 250), 7)
    small = cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA)
    noisy = cv2.GaussianBlur(small, (0, 0), 0.6) + rng.standard_normal(small.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("setting", "fewer"),
    [
        ("min_length_px=40", True),
        ("min_length_px=13", False),
        ("edges.min_slope_grey=12", True),
        ("support.min_cosine=0.9999", True),
        ("clutter.min_evidence=1e6", True),
        ("hidden.rounds=0", True),
    ],
)
def test_options_set_by_name_change_what_is_found(setting: str, fewer: bool) -> None:
    photo, usual = strips(), ExtractionOptions()
    counts = [len(extract_arcs(photo, CAMERA, options=options)) for options in (usual, with_settings(usual, [setting]))]
    assert counts[0] > 30
    assert counts[1] < counts[0] if fewer else counts[1] > counts[0]


def test_options_made_in_python_have_the_ranges_of_those_set_by_name() -> None:
    with pytest.raises(InputError, match=r"^min_length_px was expected to be a number from 0 to 1e\+12, found -50; correct it"):
        ol.extract({"0.png": strips()}, CAMERA, options=ExtractionOptions(min_length_px=-50.0))
    with pytest.raises(InputError, match=r"^chains\.\w+ was expected"):
        ol.extract({"0.png": strips()}, CAMERA, options=ExtractionOptions(chains=ChainOptions(min_points=-1)))
