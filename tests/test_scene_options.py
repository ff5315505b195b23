"""Options of matching, structure, triangulation and posing: each has a sentence and is used, and those set have their effect."""

from pathlib import Path

import numpy as np
import pytest
from matching_scenes import every_neighbour, room
from triangulation_scenes import circle

import omnilines
from camera_models import Calibration, Equirectangular, InputError
from omnilines.matching.hypotheses import find_hypotheses
from omnilines.matching.match import match_arcs
from omnilines.matching.options import MatchingOptions
from omnilines.options import walk, with_settings
from omnilines.pipelines.options import JudgeOptions, SceneOptions
from omnilines.pipelines.reconstruct import check_options
from omnilines.posing.colmap_mapper import MapperInput, map_photos
from omnilines.posing.options import PosingOptions
from omnilines.structure.options import FamilyOptions, StructureOptions
from omnilines.triangulation import triangulate
from omnilines.triangulation.options import TriangulationOptions
from omnilines.triangulation.robust import robust_triangulate

STAGES = {
    "matching": (MatchingOptions(), 50),
    "structure": (StructureOptions(), 15),
    "triangulation": (TriangulationOptions(), 10),
    "posing": (PosingOptions(), 55),
}


@pytest.mark.parametrize("package", STAGES)
def test_every_option_has_a_sentence_and_is_used(package: str) -> None:
    root = Path(omnilines.__file__).parent
    folder = root / package
    paths = [path for path in sorted(folder.rglob("*.py")) if path.name != "options.py"]
    # Which lines run along planes is asked of them there.
    paths += [root / "pipelines" / "coplanar_lines.py"] if package == "structure" else []
    code = "\n".join(path.read_text() for path in paths) + (folder / "options.py").read_text().replace("self.", "options.")
    given, least = STAGES[package]
    options = list(walk(given))
    assert len(options) >= least
    for name, value, sentence in options:
        assert sentence.endswith("."), name
        assert f".{name.split('.')[-1]}" in code, name
        text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
        assert with_settings(given, [f"{name}={text}"]) == given


@pytest.mark.parametrize("judge", [{"fitting_px": -1.0}, {"rough_share": 1.5}])
def test_options_made_in_python_have_the_ranges_of_the_command_line(judge: dict[str, float]) -> None:
    cameras = Calibration({"cam0": Equirectangular([], (100, 50))})
    with pytest.raises(InputError, match=f"{next(iter(judge))} was expected to be a number from .*correct it"):
        check_options(SceneOptions(judge=JudgeOptions(**judge)), cameras)


@pytest.mark.parametrize(
    ("setting", "fewer"),
    [
        ("likeness.min_likeness=0.9", True),
        ("likeness.colour_sigma=0.5", False),
        ("hypotheses.min_overlap_share=0.9", True),
        ("hypotheses.max_depth_sigma_share=0.05", True),
    ],
)
def test_options_of_matching_reach_the_compiled_loops(setting: str, fewer: bool) -> None:
    arcs = room("fisheye").arcs(0.3, 1, colours=True)
    rows, near, usual = np.arange(0, len(arcs), 5), every_neighbour(arcs.images), MatchingOptions()
    counts = [
        int(find_hypotheses(arcs, near, rows=rows, options=options).candidates.sum())
        for options in (usual, with_settings(usual, [setting]))
    ]
    assert counts[0] > 500
    assert counts[1] < counts[0] if fewer else counts[1] > counts[0]


def test_the_tolerance_is_one_of_those_to_try() -> None:
    arcs = room("fisheye").arcs(0.3, 3)
    options = with_settings(MatchingOptions(), ["matching.tolerance.tried_px=0.3,0.9"], "matching.")
    assert match_arcs(arcs, options=options).arcs.covariance_px2[0, 0, 0, 0] > 0.3**2


def test_options_of_triangulation_decide_who_belongs_and_what_is_weak() -> None:
    scene = circle(2)
    given = scene.observe(scene.noisy(0.5, 3), 0.5)
    every = robust_triangulate(given)
    strict = TriangulationOptions(consensus=TriangulationOptions().consensus._replace(row_chi_square=3.0))
    assert int(every.inlier.sum()) > int(robust_triangulate(given, options=strict).inlier.sum())
    assert "weak" not in every.triangulation.status_names
    wary = TriangulationOptions(degeneracy=TriangulationOptions().degeneracy._replace(weak_angle_rad=3.0))
    for method in ("dual", "svd", "averaging", "ml"):
        assert set(triangulate(method, given, options=wary).status_names) == {"weak"}


def test_a_gate_follows_from_its_share() -> None:
    """Chi-square of two degrees of freedom exceeds -2 log(1 - share) in as many cases."""
    assert FamilyOptions().gate == pytest.approx(13.8155, abs=1e-4)
    assert FamilyOptions(member_share=0.5).gate == pytest.approx(2.0 * np.log(2.0))


def test_a_resection_needs_a_limit_and_a_number_each(tmp_path: Path) -> None:
    options = with_settings(PosingOptions(), ["mapper.resection_px=4,8"])
    nothing = MapperInput([], {}, [], [], {})
    with pytest.raises(InputError, match=r"As many `resection_inliers` as `resection_px`"):
        map_photos(nothing, tmp_path / "colmap", 0, options=options)
    assert not (tmp_path / "colmap").exists()
