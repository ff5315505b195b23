"""The uncertainty map of the report: contour levels, what is drawn where, and figures against closed forms."""

import html
import json
import math
import re
from types import SimpleNamespace

import numpy as np
import plotly.graph_objects
import pytest

from camera_models import OpenCVFisheye
from omnilines.pages.uncertainty_map import UncertaintyMap, sigma_at_px
from omnilines.report import Section, uncertainty, uncertainty_section

SIZE = (1032, 778)
U, V = np.linspace(0, 1031, 61), np.linspace(0, 777, 47)
PHASE = np.linspace(0, 2 * np.pi, 90)


def circle(radius_px: float) -> np.ndarray:
    return np.stack([515.5 + radius_px * np.cos(PHASE), 388.5 + radius_px * np.sin(PHASE)], 1)


def section(sigma: np.ndarray, radius_px: float = 300.0, corners: np.ndarray | None = None, **known: object) -> Section:
    points = np.array([[515.5, 388.5], [700.0, 400.0]]) if corners is None else corners
    return uncertainty_section(sigma, U, V, SIZE, circle(radius_px), corners_px=points, supported_angle_deg=82.44, **known)


def figure(shown: Section) -> dict:
    (text,) = re.findall(r'<script type="application/json">(.*?)</script>', str(shown.html), re.S)
    spec = json.loads(text)
    plotly.graph_objects.Figure(spec)
    return spec


def words(shown: Section) -> str:
    return " ".join(html.unescape(re.sub(r"<script.*?</script>|<[^>]+>", " ", str(shown.html), flags=re.S)).split())


def growing(low: float, factor: float) -> np.ndarray:
    """From `low` at the left border to `factor` times that at the right one, evenly in the logarithm."""
    return np.broadcast_to(low * factor ** (U / U[-1]), (len(V), len(U))).copy()


def test_a_largest_value_that_is_not_known_is_said_so() -> None:
    said = words(section(growing(0.01, 10.0), largest=("the image", math.inf, (12.0, 7.0))))
    assert "Over the image it is not known everywhere, least at (12, 7) px." in said and "inf" not in said


def test_colours_are_logarithmic_and_capped() -> None:
    sigma = growing(0.01, 1e4)
    spec = figure(section(sigma))
    colours = spec["data"][0]
    z = np.array(colours["z"], dtype=np.float64)
    np.testing.assert_allclose(z, np.log10(np.minimum(sigma, 1.0)), atol=2e-3)
    assert (colours["zmin"], colours["zmax"]) == pytest.approx((-2.0, 0.0))
    np.testing.assert_allclose(np.array(colours["customdata"], dtype=np.float64), sigma, rtol=1e-3)
    bar = colours["colorbar"]
    assert bar["ticktext"] == ["0.02", "0.05", "0.1", "0.2", "0.5", "≥ 1"]
    np.testing.assert_allclose(10 ** np.array(bar["tickvals"]), [0.02, 0.05, 0.1, 0.2, 0.5, 1.0], rtol=1e-4)


def test_one_line_per_level_labelled_in_pixels() -> None:
    lines = [t for t in figure(section(growing(0.011, 50.0)))["data"] if t["type"] == "contour"]
    assert [t["contours"]["start"] for t in lines] == [0.02, 0.05, 0.1, 0.2, 0.5]
    assert all(t["contours"]["showlabels"] and t["contours"]["end"] == t["contours"]["start"] for t in lines)
    # Lines are drawn through the values themselves, so that their labels are pixels.
    assert all(t["z"] == lines[0]["z"] for t in lines)
    np.testing.assert_allclose(np.array(lines[0]["z"]), growing(0.011, 50.0), rtol=1e-3)


@pytest.mark.parametrize(
    ("low", "high", "levels"),
    [
        (0.05, 0.1, [0.06, 0.07, 0.08, 0.09, 0.1]),
        (0.9, 1.1, [0.9, 0.95, 1.0, 1.05, 1.1]),
        (0.031, 7.0, [0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0]),
        (3.0, 3.0, []),
    ],
)
def test_levels(low: float, high: float, levels: list[float]) -> None:
    found = uncertainty._levels(low, high)
    assert [x for x in found if low < x < high] == [x for x in levels if low < x < high]


def test_unknown_is_blank_and_a_constant_map_is_drawn() -> None:
    sigma = growing(0.01, 10.0)
    sigma[0, 0], sigma[1, 1], sigma[2, 2] = np.nan, np.inf, 0.0
    colours = figure(section(sigma))["data"][0]
    assert [colours["z"][k][k] for k in range(3)] == [None] * 3 and colours["z"][3][3] is not None
    assert figure(section(np.full_like(sigma, 0.2)))["data"][0]["z"][5][5] == pytest.approx(np.log10(0.2), abs=1e-3)
    nothing = section(np.full_like(sigma, np.nan))
    assert "not known at any pixel" in words(nothing) and "<script" not in str(nothing.html)


def test_words_give_the_map_at_the_corners_and_its_largest_value() -> None:
    sigma = growing(0.01, 1e5)
    corners = np.array([[100.0, 100.0], [300.0, 300.0], [500.0, 700.0], [np.nan, 1.0]])
    text = words(section(sigma, corners=corners, corners_sigma_px=np.array([0.1, 0.2, 0.4, np.nan])))
    assert "At the observed corners it is 0.2 px in the median, at most 0.4 px." in text
    edges = words(section(sigma, corners=corners, corners_sigma_px=np.full(4, 0.3), seen="points of edges"))
    assert "At the observed points of edges it is 0.3 px" in edges and "corner" not in edges
    assert "Over the image it is at most 1000 px, at (1031, 0) px." in text
    assert "after the best common rotation" in text
    alone = words(section(sigma, corners=np.zeros((0, 2))))
    assert "At the observed corners" not in alone and "at most 1000 px" in alone


def test_circle_and_corners_are_drawn_and_explained() -> None:
    shown = section(growing(0.01, 10.0))
    dots, curve = figure(shown)["data"][-2:]
    assert dots["x"] == [515.5, 700.0] and dots["marker"]["opacity"] < 0.5
    np.testing.assert_allclose(np.hypot(np.array(curve["x"]) - 515.5, np.array(curve["y"]) - 388.5), 300.0, rtol=1e-4)
    assert "82.4 degrees off axis: beyond it the map is extrapolation" in words(shown)
    assert "where there are none, the uncertainty grows" in words(shown)
    beyond = words(section(growing(0.01, 10.0), radius_px=2000.0))
    assert "The corners reach 82.4 degrees off axis, past the border of the image" in beyond and "blue curve" not in beyond


def test_a_map_agrees_with_the_camera_at_its_nodes_and_ends_at_the_rim() -> None:
    camera = OpenCVFisheye([150.0, 150.0, 319.5, 239.5, 0.02, -0.004, 0.0, 0.0], (640, 480))
    known = SimpleNamespace(model=camera, covariance=np.diag(np.full(8, 1e-4)), min_angle_deg=0.0, max_angle_deg=80.0)
    found = UncertaintyMap.of(known)
    nodes = np.stack(np.meshgrid(found.u_px, found.v_px), -1)
    np.testing.assert_allclose(sigma_at_px(known, nodes.reshape(-1, 2)).reshape(found.sigma_px.shape), found.sigma_px)
    inner = found.within(100.0, np.array([319.5, 239.5]))
    far = np.hypot(*(nodes - [319.5, 239.5]).transpose(2, 0, 1)) > 100.0
    assert far.any() and np.isnan(inner.sigma_px[far]).all() and not inner.supported[far].any()
    np.testing.assert_array_equal(inner.sigma_px[~far], found.sigma_px[~far])
