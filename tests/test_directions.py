"""Directions of one photo against arcs drawn with known noise: none by chance, else the true ones with honest covariances."""

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from table_checks import read_npz

import omnilines as ol
from camera_models import Calibration, Equirectangular, OpenCVFisheye, Pinhole
from omnilines.cli import main
from omnilines.commands.directions import directions
from omnilines.pages.limits_of_lines import directions_advice
from omnilines.structure.circles import Circles
from omnilines.structure.manhattan import manhattan_frame
from omnilines.structure.meeting import largest_sigma, line_weights, meeting_directions
from omnilines.structure.mixture import fitted
from omnilines.structure.options import DirectionsOptions

STRAYS = np.array(DirectionsOptions().strays_rad)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return turn * np.linalg.det(turn)


def arcs_along(
    way: np.ndarray, middle: np.ndarray, rng: np.random.Generator, sigma_rad: float | np.ndarray, half_rad: float = 0.08
) -> Circles:
    """Arcs through the middles (n, 3) towards `way`, ends off by noise that is correlated as that of a fitted line."""
    along = unit(way - (way * middle).sum(-1, keepdims=True) * middle)
    ends = np.stack([math.cos(half_rad) * middle + side * math.sin(half_rad) * along for side in (-1, 1)], 1)
    normal = np.cross(along, middle)
    sigma = np.broadcast_to(sigma_rad, len(middle))
    first, other = rng.normal(size=(2, len(middle)))
    off = sigma[:, None] * np.stack([first, -0.5 * first + math.sqrt(0.75) * other], -1)
    by_pixel = np.zeros((len(middle), 2, 3, 2))
    by_pixel[..., 0] = normal[:, None]
    covariance = np.zeros((len(middle), 2, 2, 2))
    covariance[..., 0, 0] = sigma[:, None] ** 2
    return Circles.of_arcs(unit(ends + off[..., None] * normal[:, None]), by_pixel, covariance)


def places(count: int, fov_deg: float, rng: np.random.Generator) -> np.ndarray:
    """Bearings all over a field of view about z."""
    cosine = rng.uniform(math.cos(math.radians(fov_deg / 2)), 1.0, count)
    azimuth, sine = rng.uniform(0, 2 * math.pi, count), np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], -1)


def world(
    axes: np.ndarray, each: int, clutter: int, rng: np.random.Generator, fov_deg: float = 120.0, stray_rad: float = 0.0
) -> Circles:
    """Arcs of lines along the rows of `axes`, far enough from these, and arcs at random."""
    parts = []
    for axis in axes:
        middle = places(8 * each, fov_deg, rng)
        middle = middle[np.abs(middle @ axis) < 0.95][:each]
        way = unit(axis + stray_rad * rng.normal(size=(len(middle), 3)))
        parts.append(arcs_along(way, middle, rng, np.exp(rng.normal(-7.5, 0.5, len(middle)))))
    middle = places(clutter, fov_deg, rng)
    parts.append(arcs_along(rng.normal(size=(clutter, 3)), middle, rng, 5e-4))
    return Circles.joined(parts)


@pytest.mark.parametrize("fov_deg", [40.0, 120.0, 190.0, 359.0])
def test_arcs_at_random_meet_nowhere(fov_deg: float) -> None:
    rng, options = np.random.default_rng(int(fov_deg)), DirectionsOptions()
    for count in (0, 1, 2, 5, 30, 200):
        middle = places(count, fov_deg, rng)
        circles = arcs_along(rng.normal(size=(count, 3)), middle, rng, float(np.exp(rng.uniform(-9, -5))))
        assert len(meeting_directions(circles, options)) == 0
        assert manhattan_frame(circles, options) is None


def test_fragments_of_two_lines_are_no_direction() -> None:
    """However many there are, two lines always meet."""
    rng, parts = np.random.default_rng(3), []
    for k in range(2):
        start, end = unit(rng.normal(size=(2, 3)) + np.array([0, 0, 3.0]))
        middle = unit(start + np.linspace(0, 0.9, 25)[:, None] * (end - start))
        parts.append(arcs_along(np.broadcast_to(end - start, middle.shape), middle, rng, 2e-4, 0.01 + 0.005 * k))
    circles = Circles.joined(parts)
    assert 2.0 <= line_weights(circles, math.radians(0.5)).sum() < 3.5
    assert len(meeting_directions(circles)) == 0


def test_true_directions_are_found_among_clutter_and_their_arcs() -> None:
    rng = np.random.default_rng(5)
    axes = unit(np.array([[0.0, -1.0, 0.1], [1.0, 0.0, 0.3], [0.5, 0.1, 1.0], [-0.7, 0.0, 0.6]]))
    circles = world(axes, 30, 90, rng)
    found = meeting_directions(circles)
    assert len(found) == 4 and (found.members >= 28).all() and (np.diff(found.members) <= 0).all()
    nearest = np.abs(found.direction @ axes.T)
    assert sorted(nearest.argmax(1)) == [0, 1, 2, 3]
    assert np.arccos(np.clip(nearest.max(1), 0, 1)).max() < 5e-3
    for k, axis in enumerate(nearest.argmax(1)):
        assert (found.direction_of[30 * axis : 30 * axis + 30] == k).mean() > 0.9
    assert (found.direction_of[120:] >= 0).mean() < 0.15


@pytest.mark.slow
@pytest.mark.parametrize("stray_deg", [pytest.param(0.0, marks=pytest.mark.full), 0.3])
def test_covariances_hold_the_errors(stray_deg: float) -> None:
    """Of directions and of frames: Mahalanobis distances squared are chi-square with two and three degrees of freedom."""
    rng, of_directions, of_frames = np.random.default_rng(7), list[float](), list[float]()
    for _ in range(14):
        turn = random_rotation(rng)
        circles = world(turn.T, 18, 25, rng, 190.0, math.radians(stray_deg))
        found, frame = meeting_directions(circles), manhattan_frame(circles)
        for direction, covariance in zip(found.direction, found.covariance, strict=True):
            true = turn[:, np.abs(direction @ turn).argmax()]
            error = np.sign(true @ direction) * true - direction
            of_directions.append(float(error @ np.linalg.pinv(covariance, 1e-6) @ error))
        assert frame is not None
        axes = turn @ np.round(turn.T @ frame.cam_from_world)
        assert np.abs(axes - frame.cam_from_world).max() < 0.02
        skew = axes @ frame.cam_from_world.T
        error = 0.5 * np.array([skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]])
        of_frames.append(float(error @ np.linalg.solve(frame.covariance, error)))
    assert len(of_directions) >= 40
    assert 0.9 <= np.mean(np.array(of_directions) < 5.991) <= 1.0 and 1.0 < np.mean(of_directions) < 3.0
    assert 0.8 <= np.mean(np.array(of_frames) < 7.815) <= 1.0 and 1.5 < np.mean(of_frames) < 4.5


def test_covariance_is_that_of_the_likelihood() -> None:
    """The second derivatives of the log likelihood by turns of the frame, numerically."""
    rng = np.random.default_rng(9)
    turn = random_rotation(rng)
    circles = world(turn.T, 15, 10, rng, 190.0, math.radians(0.2))
    weight = np.ones(len(circles))
    fit = fitted(circles, weight, turn.T, STRAYS, as_frame=True)

    def likelihood(turn: np.ndarray) -> float:
        direction = unit(fit.direction + np.cross(turn, fit.direction) - 0.5 * (turn @ turn) * fit.direction)
        direction += 0.5 * np.outer(fit.direction @ turn, turn)
        ratio = np.einsum("ck,ckn->n", fit.share, circles.ratio(unit(direction), fit.strays_rad))
        return float(np.log(1 - fit.share.sum() + ratio).sum())

    step, hessian = 2e-5, np.zeros((3, 3))
    for i, j in np.ndindex(3, 3):
        a, b = step * np.eye(3)[i], step * np.eye(3)[j]
        values = likelihood(a + b) - likelihood(a - b) - likelihood(b - a) + likelihood(-a - b)
        hessian[i, j] = -values / (4 * step**2)
    assert likelihood(np.zeros(3)) == pytest.approx(fit.log_likelihood)
    assert np.allclose(np.linalg.inv(fit.turn_covariance[0]), hessian, rtol=0.05, atol=0.02 * np.abs(hessian).max())


def test_frame_is_upright_and_right_handed() -> None:
    rng = np.random.default_rng(11)
    roll = math.radians(12.0)
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    cosine, sine = math.cos(roll), math.sin(roll)
    true = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ level
    frame = manhattan_frame(world(true.T, 25, 30, rng))
    assert frame is not None and np.linalg.det(frame.cam_from_world) == pytest.approx(1.0)
    assert np.abs(frame.cam_from_world - true).max() < 0.01
    assert np.array_equal(frame.axes.direction.T, frame.cam_from_world)


def test_one_direction_makes_no_frame() -> None:
    rng = np.random.default_rng(13)
    assert manhattan_frame(world(np.array([[0.0, -1.0, 0.0]]), 60, 60, rng)) is None


def test_arcs_without_a_circle_and_those_that_hold_the_direction_are_of_none() -> None:
    rng = np.random.default_rng(15)
    axis = np.array([0.0, 0.0, 1.0])
    circles = world(axis[None], 40, 0, rng)
    through = arcs_along(np.array([[1.0, 0.2, 0.0]]), unit(np.array([[1e-3, 2e-4, 1.0]])), rng, 2e-4)
    point = np.broadcast_to(unit(np.array([0.3, 0.2, 1.0])), (1, 2, 3)).copy()
    dot = Circles.of_arcs(point, np.ones((1, 2, 3, 2)), np.broadcast_to(np.eye(2), (1, 2, 2, 2)).copy())
    found = meeting_directions(Circles.joined([circles, through, dot]))
    assert len(found) == 1 and (found.direction_of[:40] == 0).all() and (found.direction_of[40:] == -1).all()
    assert largest_sigma(found.covariance)[0] < 1e-3


LENS = OpenCVFisheye([105.0, 105.0, 199.5, 199.5, 0.0, 0.0, 0.0, 0.0], (400, 400))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two photos of a room, and one of noise."""
    folder = tmp_path_factory.mktemp("directions") / "room"
    ol.render("plain-room", LENS, ol.RenderOptions(views=2, seed=4)).save(folder)
    noise = np.random.default_rng(0).integers(110, 130, (400, 400, 3)).astype(np.uint8)
    assert cv2.imwrite(str(folder / "noise.png"), noise)
    return folder


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        main([str(one) for one in arguments])
    told = capsys.readouterr()
    return int(end.value.code or 0), told.out, told.err


def test_command_writes_directions_arcs_and_rotations(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ("directions", room, "--calibration", room / "calibration.yaml", "--out", tmp_path / "out", "--json")
    status, out, _ = run(capsys, *given, "--orthogonal")
    data = json.loads(out)
    assert status == 0 and [len(photo["directions"]) for photo in data["photos"]] == [0, 3, 3]
    assert any("noise.png: no Manhattan frame" in note for note in data["notes"])
    true, found = ol.read_poses(room / "poses.csv"), ol.read_poses(tmp_path / "out" / "poses.csv")
    covariance = read_npz(tmp_path / "out" / "covariance.npz")
    assert found.images == true.images == tuple(covariance["image"])
    for k in range(2):
        turn = true.cam_from_world.rotation[k].numpy().T @ found.cam_from_world.rotation[k].numpy()
        assert np.abs(turn - np.round(turn)).max() < 2e-3
        assert (turn[:, 2].round() == [0, 0, 1]).all()
        assert 0 < largest_sigma(covariance["pose_covariance"][:, :3, :3])[k] < 2e-3
    rows = (tmp_path / "out" / "directions.csv").read_text().splitlines()
    assert rows[0] == "image,direction,x,y,z,sxx,sxy,sxz,syy,syz,szz,arcs" and len(rows) == 7
    arcs = (tmp_path / "out" / "arcs.csv").read_text().splitlines()
    counts = {name: sum(f"{true.images[0]},{name}," in row for row in arcs) for name in "xyz"}
    assert list(counts.values()) == [one["arcs"] for one in data["photos"][1]["directions"]]
    assert all((tmp_path / "out" / "pictures" / f"{Path(name).stem}.jpg").stat().st_size > 1000 for name in true.images)
    page = (tmp_path / "out" / "report.html").read_text()
    verdict = page[page.index("A Manhattan frame") :].partition("</p>")[0]
    assert verdict.startswith("A Manhattan frame stands out from chance in 2 of 3 photos, known to 0.0")
    assert page.count('<figure class="photo" ') == 3 and page.count(f'<th scope="row">{true.images[0]}</th>') == 3
    assert '<th scope="row">noise.png</th><td>none</td>' in page and "noise.png: no Manhattan frame" in page


def test_command_tells_the_vertical_alone(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ("directions", room, "--calibration", room / "calibration.yaml", "--out", tmp_path / "out")
    status, out, _ = run(capsys, *given, "--vertical", "--json")
    data = json.loads(out)
    poses = ol.read_poses(room / "poses.csv")
    true = dict(zip(poses.images, poses.cam_from_world.rotation.numpy(), strict=True))
    seen = [photo for photo in data["photos"] if photo["directions"]]
    assert status == 0 and seen
    for photo in seen:
        up = np.array(photo["directions"][0]["xyz"])
        assert photo["directions"][0]["name"] == "up" and math.degrees(math.acos(min(1, up @ true[photo["image"]][:, 2]))) < 0.2
    found = ol.read_poses(tmp_path / "out" / "poses.csv")
    assert found.images == tuple(photo["image"] for photo in seen)


def test_lines_that_stray_are_said_to_be_the_calibrations_where_there_is_one(room: Path) -> None:
    """A stitched panorama has none: `omnilines check` refuses it."""
    found = ol.directions(ol.extract(room, ol.load(room / "calibration.yaml")), orthogonal=True)
    assert not any("Lines differ" in one.limit for one in directions_advice(found))
    crooked = tuple(replace(one, meeting=replace(one.meeting, stray_rad=0.02)) for one in found.photos)
    panorama = Calibration({"cam0": Equirectangular((), (400, 200))})
    lens, stitched = (
        directions_advice(replace(found, photos=crooked, arcs=replace(found.arcs, cameras=cameras)))[-1]
        for cameras in (found.arcs.cameras, panorama)
    )
    assert lens.limit == stitched.limit and lens.limit.startswith("Lines differ from their direction by 1.1 degrees")
    assert "omnilines check" in lens.do and "omnilines check" not in stitched.do and "no calibration" in stitched.do


@pytest.mark.slow
def test_photos_are_turned_upright_in_a_view_as_wide_as_their_camera(room: Path, tmp_path: Path) -> None:
    ordinary = Pinhole.from_mapping({"fx": 630.0, "fy": 630.0, "cx": 299.5, "cy": 224.5}, (600, 450))
    ol.render("plain-room", ordinary, ol.RenderOptions(views=3, seed=4)).save(tmp_path / "room")
    found = {
        one: directions([one], one / "calibration.yaml", tmp_path / one.parent.name, vertical=True)
        for one in (room, tmp_path / "room")
    }
    fisheye, narrow = (result.then for result in found.values())
    assert fisheye[-5:] == ("--view", "panorama", "--upright", "--out", "level")
    assert narrow[:2] == ("rectify", str(tmp_path / "room")) and narrow[4:6] == ("--view", "perspective")
    across_deg = 2.0 * math.degrees(math.atan(math.hypot(299.5, 224.5) / 630.0))
    assert narrow[6] == "--fov-deg" and across_deg - 2.0 < float(narrow[7]) < across_deg + 1.0
    views = ol.rectify(tmp_path / "room", ordinary, narrow[5], fov_deg=float(narrow[7]), upright=True)
    assert min(views.shown_share.values()) > 0.3


def test_idle_and_contradicting_options_are_refused(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ("directions", room, "--calibration", room / "calibration.yaml", "--out", tmp_path / "out")
    for options, said in (
        (("--orthogonal", "--vertical"), "found both"),
        (("--set", "directions.tried_axes=3"), "counts only with --orthogonal"),
        (("--orthogonal", "--set", "directions.upright.as_near=3"), "counts only with --vertical"),
        (("--orthogonal", "--set", "directions.min_lines=3"), "counts only without --orthogonal"),
        (("--set", "directions.tried_rad=0"), "directions.tried_rad was expected to be a number from 8.72665e-09 to"),
        (("--set", "directions.strays_rad="), "directions.strays_rad was expected"),
        (("--set", "directions.share=0"), "directions.share was expected to be a number from 1e-06 to"),
        (("--set", "directions.false_directions=0"), "directions.false_directions was expected to be a number from 1e-09 to"),
        (("--set", "directions.paired_arcs=0"), "directions.paired_arcs was expected to be a number from 1 to"),
    ):
        status, out, err = run(capsys, *given, *options)
        assert status == 2 and said in err and not out and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_options_at_the_ends_of_their_ranges_end(room: Path) -> None:
    """A separation of 0 searched for ever; the order of strays, of which one is chosen, changes nothing."""
    arcs = ol.extract(room, ol.load(room / "calibration.yaml"))
    usual = ol.directions(arcs)
    for fields in (
        {"separation_rad": 0.0},
        {"strays_rad": ol.DirectionsOptions().strays_rad[::-1]},
        {"share": 1e-6},
        {"false_directions": 1e-9},
        {"used_arcs": 1},
        {"paired_arcs": 1},
    ):
        options = ol.DirectionsOptions(**fields)  # type: ignore[arg-type]
        found, frame = ol.directions(arcs, options=options), ol.directions(arcs, orthogonal=True, options=options)
        assert len(found.photos) == len(frame.photos) == len(usual.photos)
        if "strays_rad" in fields:
            for one, same in zip(found.photos, usual.photos, strict=True):
                np.testing.assert_allclose(one.meeting.direction, same.meeting.direction, atol=1e-9)
