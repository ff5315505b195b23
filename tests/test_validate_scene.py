"""`omnilines validate --scene`: it holds on a good scene, fails where poses or calibration are wrong, and counts what it says."""

import json
import math
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

import camera_models
from camera_models import GeometryError, Pinhole
from camera_models.pose import Pose
from omnilines import cli
from omnilines.adjustment.lines import end_sigma_m
from omnilines.commands import validate_scene as command
from omnilines.commands.result import CommandResult
from omnilines.files import read_poses, write_poses
from omnilines.geometry.line import PlueckerLines, end_radius_sigmas
from omnilines.geometry.line_chart import LineChart
from omnilines.pipelines.render import RenderOptions, render_scene
from omnilines.pipelines.rendered import RenderedScene
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Lines
from omnilines.studies.scene_validation import (
    RebuiltScene,
    SceneValidation,
    _median,
    _pixel_at_edges,
    compare_scene,
    own_edges,
    read_rebuilt,
)
from omnilines.studies.validate import validate

OPTIONS = RenderOptions(fov_deg=100.0, views=8, size_px=(360, 360), seed=1)
ARGUMENTS = ("--scene", "room", "--model", "pinhole", "--fov-deg", 100, "--views", 8, "--size", "360x360", "--seed", 1)
ON_EDGE, WORST = "arcs on true edges, share, at least", "arcs on true edges in the worst photo, share, at least"
NEAR = "lines near true edges, share, at least"
INSIDE = "ends inside their 95 percent interval, share, at least"


@dataclass(frozen=True)
class Done:
    """One run of the command."""

    out: Path
    truth: RenderedScene
    result: CommandResult

    @property
    def rebuilt(self) -> RebuiltScene:
        said = json.loads((self.out / "scene/done.json").read_text())["data"]
        return read_rebuilt(self.out / "scene", said)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Done:
    """The command on a small room, with the truth that it rendered."""
    out = tmp_path_factory.mktemp("validated")
    kept = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "render_scene", lambda *a, **k: kept.append(render_scene(*a, **k)) or kept[0])
        result = command.validate_scene(out, "room", "pinhole", OPTIONS)
    return Done(out, kept[0], result)


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """(exit status, standard output, standard error) of one command."""
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    said = capsys.readouterr()
    return int(ended.value.code or 0), said.out, said.err


@pytest.mark.slow
def test_a_good_scene_holds(done: Done) -> None:
    assert [check.name for check in done.result.checks if not check.holds] == []
    assert len(done.result.checks) == 6 and done.result.holds
    assert all(path.is_file() for path in done.result.files)
    data = done.result.data
    json.dumps(data, allow_nan=False)
    assert data["photos"] == len(data["views"]) == 8 and data["lines"] > 50
    assert [row["distance_m"] for row in data["within"]] == [0.001, 0.005, 0.01, data["tolerance_m"]]
    assert data["tolerance_m"] == pytest.approx(1.5 * data["pixel_m"])
    # A room of 5 x 4 m, pixels of a 180th of the tangent of 50 degrees.
    assert 1.0 < data["distance_m"] < 5.0
    assert 0.2 < data["pixel_m"] * 180 / math.tan(math.radians(50)) / data["distance_m"] < 1.2
    page = (done.out / "report.html").read_text()
    assert all(text in page for text in ("Checks", "Stages", "Precision and recall", "view07.png", "true lines"))
    assert len(page) < 15e6


def disturbed(done: Done, folder: Path, patch: pytest.MonkeyPatch, turn_deg: float, zoom: float) -> None:
    """Have the command work on the photos of `done` with the first pose turned and the focal length changed."""

    class Disturbed(RenderedScene):
        def save(self, folder: str | Path, progress: ProgressCallback = silent) -> tuple[Path, ...]:
            out = Path(folder)
            shutil.copytree(done.out / "photos", out)
            poses = read_poses(out / "poses.csv")
            turn = torch.zeros(len(poses), 6, dtype=torch.float64)
            turn[0, 1] = math.radians(turn_deg)
            write_poses(out / "poses.csv", replace(poses, cam_from_world=Pose.exp(turn) @ poses.cam_from_world))
            cameras = camera_models.load(out / "calibration.yaml")
            parameters = cameras["cam0"].parameters.clone()
            parameters[:2] *= zoom
            wrong = replace(cameras, cameras={"cam0": cameras["cam0"].with_parameters(parameters)})
            camera_models.save(out / "calibration.yaml", wrong)
            return ()

    # Arcs depend on the camera, not on poses: they need not be found again.
    shutil.copytree(done.out / "scene/work", folder / "scene/work")
    patch.setattr(command, "render_scene", lambda *_, **__: Disturbed(**vars(done.truth)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("turn_deg", "zoom", "failed"),
    [
        pytest.param(1.0, 1.0, WORST, id="a pose by 1 degree"),
        pytest.param(0.0, 1.01, NEAR, id="the focal length by 1 percent", marks=pytest.mark.full),
    ],
)
def test_what_is_wrong_exits_with_one(
    turn_deg: float,
    zoom: float,
    failed: str,
    done: Done,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    disturbed(done, tmp_path, monkeypatch, turn_deg, zoom)
    status, out, _ = run(capsys, "validate", *ARGUMENTS, "--out", tmp_path, "--json")
    data = json.loads(out)
    assert status == 1 and not data["holds"]
    assert failed in [check["name"] for check in data["checks"] if not check["holds"]]
    worst = min(data["views"], key=lambda view: view["on_edge_share"])
    assert worst["image"] == "view00.png" or zoom != 1.0


def test_a_wrong_focal_length_is_seen_by_the_arcs(done: Done) -> None:
    """Two percent: 3.6 px at the border of these photos."""
    rebuilt = done.rebuilt
    camera = rebuilt.cameras["cam0"]
    parameters = camera.parameters.clone()
    parameters[:2] *= 1.02
    wrong = replace(rebuilt.cameras, cameras={"cam0": camera.with_parameters(parameters)})
    checks = compare_scene(done.truth, replace(rebuilt, cameras=wrong)).checks
    assert ON_EDGE in [check.name for check in checks if not check.holds]


@pytest.mark.full
def test_photos_in_memory_give_what_files_do(done: Done, tmp_path: Path) -> None:
    checked = validate(done.truth)
    assert isinstance(checked, SceneValidation) and checked.holds == done.result.holds
    # An end of a line that lies at the border of its interval may be counted as inside or not: poses of files are rounded.
    one_end = 1.0 / (2 * int(checked.own.sum()))
    for mine, of_files in zip(checked.checks, done.result.checks, strict=True):
        assert mine.name == of_files.name and mine.value == pytest.approx(of_files.value, rel=1e-6, abs=1.01 * one_end)
    # A page without the photos, which are no files.
    page = checked.report(tmp_path / "report.html").read_text()
    assert "Precision and recall" in page and "Lines over the photos" not in page


def test_a_second_run_reads_what_the_first_wrote(done: Done) -> None:
    """The comparison rests on the files alone."""
    again = compare_scene(done.truth, done.rebuilt)
    assert again.checks == done.result.checks


def with_errors(done: Done, sigma: float) -> RebuiltScene:
    """Every visible edge as a line, with normal errors in its chart and their covariance."""
    rng = np.random.default_rng(0)
    ends = torch.as_tensor(done.truth.edges.ends_m[np.unique(done.truth.stretches.edge)])
    ends = ends[(ends[:, 1] - ends[:, 0]).norm(dim=-1) > 0.3]
    true = PlueckerLines.from_points(ends[:, 0], ends[:, 1])
    centre = done.truth.poses.cam_from_world.centre.mean(0).expand(len(ends), 3)
    chart = LineChart.from_lines(true, centre, true.distance_to(centre))
    spread = np.tile(np.diag([0.5, 1.0, 2.0, 1.5]) ** 2, (len(ends), 1, 1))
    step = torch.as_tensor(sigma * rng.normal(size=(len(ends), 4)) * [0.5, 1.0, 2.0, 1.5])
    moved = chart.retract(step).lines()
    found = torch.stack([moved.closest_point(ends[:, k]) for k in range(2)], 1)
    covariance = torch.as_tensor(sigma**2 * spread)
    sigma_m = end_sigma_m(LineChart.from_lines(moved, centre, chart.scale), covariance, found).numpy()
    names = tuple(f"line{k}" for k in range(len(ends)))
    count = len(ends)
    lines = Lines(names, found.numpy(), np.full(count, 4), np.full(count, 0.1), sigma_m, ("ok",) * count)
    return replace(
        done.rebuilt, lines=lines, covariance=covariance.numpy(), chart_centre_m=centre.numpy(), chart_scale_m=chart.scale.numpy()
    )


@pytest.mark.slow
def test_shares_inside_are_those_of_normal_errors(done: Done) -> None:
    """Errors of 0.2 mm at 1 m: far below the distance of edges. 95 percent of the ellipsoids hold the truth."""
    honest = compare_scene(done.truth, with_errors(done, 2e-4))
    count = honest.scores.lines
    assert count > 500 and honest.own.mean() > 0.99
    assert abs(honest.covariance_share - 0.95) < 4 * math.sqrt(0.95 * 0.05 / count)
    # sigma_m is the largest over directions and both ends.
    assert honest.inside_share > 0.95
    assert next(check for check in honest.checks if check.name == INSIDE).holds
    lines = replace(honest.rebuilt.lines, sigma_m=honest.rebuilt.lines.sigma_m / 4)
    proud = replace(honest, rebuilt=replace(honest.rebuilt, lines=lines))
    assert not next(check for check in proud.checks if check.name == INSIDE).holds


def test_an_edge_is_owned_across_gaps_and_not_at_a_crossing() -> None:
    edges = np.array(
        [
            [[0, 0, 0], [1, 0, 0]],
            [[1.1, 0, 0], [2, 0, 0]],
            [[0.5, -1, 0.01], [0.5, 1, 0.01]],
            [[0, 0, 5], [1, 0, 5]],
        ],
        dtype=np.float64,
    )
    lines = np.array(
        [
            [[0, 0.003, 0.004], [2, 0, 0]],
            [[0.4, 0, 0.012], [0.6, 0, 0.012]],
            [[1.0, 0.3, 4.6], [0.1, 0, 5]],
            [[3.0, 0, 0], [4.0, 0, 0]],
        ]
    )
    edge, offset = own_edges(lines, edges)
    assert edge.tolist() in ([0, 0, 3, -1], [1, 0, 3, -1])
    np.testing.assert_allclose(np.linalg.norm(offset[:3], axis=-1), [[0.005, 0], [0.012, 0.012], [0.5, 0]], atol=1e-12)
    assert end_radius_sigmas() == pytest.approx(math.sqrt(-2 * math.log(0.05)))


def test_the_size_of_a_pixel_is_that_of_the_closed_form(done: Done) -> None:
    """Of a pinhole without distortion the solid angle of a pixel is cos^3(theta) / f^2."""
    focal = 150.0
    camera = Pinhole([focal, focal, 179.5, 179.5] + [0.0] * 9, (360, 360))
    truth = replace(done.truth, camera=camera)
    distance, pixel = _pixel_at_edges(truth)
    stretches = truth.stretches
    ends, poses = truth.edges.ends_m[stretches.edge], truth.poses.cam_from_world
    assert truth.poses.images == stretches.images
    middle = (1 - stretches.t.mean(1)[:, None]) * ends[:, 0] + stretches.t.mean(1)[:, None] * ends[:, 1]
    points = np.einsum("nij,nj->ni", poses.rotation.numpy()[stretches.image], middle) + poses.translation.numpy()[stretches.image]
    far = np.linalg.norm(points, axis=-1)
    before = points[:, 2] > 0
    size = far * (points[:, 2] / far).clip(min=0) ** 1.5 / focal
    assert distance == pytest.approx(_median(far[before], stretches.length_px[before]), rel=0.02)
    assert pixel == pytest.approx(_median(size[before], stretches.length_px[before]), rel=0.02)
    assert _median(np.array([3.0, 1.0, 2.0]), np.array([1.0, 5.0, 1.0])) == 1.0


def test_edges_that_too_few_photos_see_are_an_error(done: Done) -> None:
    alone = done.truth.stretches.keep(done.truth.stretches.image == 0)
    with pytest.raises(GeometryError, match="found none"):
        compare_scene(replace(done.truth, stretches=alone), done.rebuilt)


def test_options_of_the_other_kind_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, _, error = run(capsys, "validate", "--mirror", "--out", tmp_path)
    assert status == 2 and "--scene" in error
    status, _, error = run(capsys, "validate", "--scene", "room", "--pattern", "checkerboard:8x6:30mm", "--out", tmp_path)
    assert status == 2 and "--pattern" in error
    status, _, error = run(capsys, "validate", "--scene", "cave", "--out", tmp_path)
    assert status == 2 and "cave" in error
