"""One law suite over every cost, and the published image-plane forms of those that have one."""

import math

import numpy as np
import pytest
import torch

from camera_models import CameraModel, InputError, OpenCVFisheye, Pinhole, Scaramuzza
from camera_models.pose import Pose
from omnilines.adjustment.arcs import MatchedArcs, arcs_from_segments
from omnilines.costs import COSTS, IN_PIXELS, WHITENED, cost_function, cost_named, sector
from omnilines.costs._cost import by_bearings
from omnilines.geometry.sphere import points_on_arc
from omnilines.records import ImagePoses, Segments

SIZE = (1280, 960)
CAMERAS: dict[str, CameraModel] = {
    "pinhole": Pinhole([800.0, 810.0, 640.0, 480.0, 2.0, 0, 0, 0, 0, 0, 0, 0, 0], SIZE),
    "fisheye": OpenCVFisheye([300.0, 302.0, 645.0, 470.0, 0.01, -0.004, 0.002, 0.0], SIZE),
    "omnidirectional": Scaramuzza([640.0, 480.0, 1.0, 0.0, 0.0, 250.0, -1.6e-3, 0.0, -2e-9], SIZE),
}
NAMES = [name for name, _ in COSTS]


def observed(camera: CameraModel, count: int = 30, seed: int = 0, stated: bool = True) -> MatchedArcs:
    """Segments anywhere in the image, 40 to 400 px long, with a covariance of their own each."""
    rng = np.random.default_rng(seed)
    first = rng.uniform([150, 120], [1130, 840], (count, 2))
    angle, length = rng.uniform(0, 2 * math.pi, count), rng.uniform(40, 400, count)
    second = np.clip(first + length[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1), [100, 80], [1180, 880])
    root = rng.normal(size=(count, 2, 2, 2)) + 2 * np.eye(2)
    covariance = root @ root.swapaxes(-1, -2) if stated else None
    names = tuple(str(k) for k in range(count))
    ends = np.stack([first, second], 1)
    segments = Segments(np.zeros(count, int), ("a",), np.arange(count), names, ends, covariance_px2=covariance)
    return arcs_from_segments(segments, ImagePoses(("a",), Pose.identity(1)), {"cam0": camera}).arcs


def normals_near(arcs: MatchedArcs, angle_rad: float, seed: int = 1) -> torch.Tensor:
    """Normals of planes a little off those of the arcs, of any length."""
    generator = torch.Generator().manual_seed(seed)
    own = torch.linalg.cross(arcs.bearings[:, 0], arcs.bearings[:, 1])
    off = torch.randn(own.shape, generator=generator, dtype=torch.float64)
    normal = own / own.norm(dim=-1, keepdim=True) + angle_rad * off
    return normal * (0.1 + 5 * torch.rand(len(own), 1, generator=generator, dtype=torch.float64))


@pytest.mark.parametrize("camera", list(CAMERAS))
@pytest.mark.parametrize("name", NAMES)
def test_laws(name, camera):
    """Zero on the arc's own plane, the same for every length of M, and derivatives as by automatic differentiation."""
    arcs = observed(CAMERAS[camera])
    cost, normal = cost_function(name, arcs), normals_near(arcs, 0.02)
    r, by_normal = cost(arcs.bearings, normal)
    size = float(r.abs().max())
    assert size > 0
    on_plane = torch.linalg.cross(arcs.bearings[:, 0], arcs.bearings[:, 1])
    assert float(cost(arcs.bearings, on_plane)[0].abs().max()) < 1e-11 * max(1.0, size)
    torch.testing.assert_close(cost(arcs.bearings, 7.5 * normal)[0], r, rtol=1e-12, atol=1e-14)
    leaf = normal.clone().requires_grad_()
    again = cost(arcs.bearings, leaf)[0]
    auto = [torch.autograd.grad(again[:, k].sum(), leaf, retain_graph=True)[0] for k in range(r.shape[1])]
    torch.testing.assert_close(by_normal, torch.stack(auto, 1), rtol=1e-9, atol=1e-10 * float(by_normal.abs().max()))


@pytest.mark.parametrize("name", NAMES)
def test_derivative_by_the_bearings_is_that_of_differences(name):
    arcs = observed(CAMERAS["fisheye"])
    cost, normal = cost_function(name, arcs), normals_near(arcs, 0.01)
    step = 1e-6 * torch.randn(arcs.bearings.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    ahead, behind = (cost(arcs.bearings + sign * step, normal)[0] for sign in (1, -1))
    predicted = torch.einsum("nmec,nec->nm", by_bearings(cost, arcs.bearings, normal), step)
    difference = 0.5 * (ahead - behind)
    torch.testing.assert_close(predicted, difference, rtol=1e-5, atol=1e-7 * float(difference.abs().max()))


@pytest.mark.parametrize("name", NAMES)
def test_a_cost_says_of_itself_what_is_so(name):
    """The form that the compiled engine takes has the residuals of the cost, and distances are in the unit that is said."""
    cost, arcs = cost_named(name), observed(CAMERAS["fisheye"])
    normal = normals_near(arcs, 0.02)
    found = cost.of_arcs(arcs)(arcs.bearings, normal)[0]
    if cost.scaled_rows is not None:
        rows, spread = cost.scaled_rows.rows(arcs.bearings), normal.square().sum(-1, keepdim=True)
        if cost.scaled_rows.spread is not None:
            b = cost.scaled_rows.spread(arcs.by_pixel, arcs.covariance_px2)
            spread = torch.einsum("ni,naij,nj->na", normal, b, normal)
        torch.testing.assert_close(torch.einsum("nai,ni->na", rows, normal) / spread.sqrt(), found, rtol=1e-12, atol=1e-15)
    if cost.distances_in is not None:
        distance_px = arcs.orthogonal_px(normal)
        unit = (normal / normal.norm(dim=-1, keepdim=True))[:, None, :, None]
        across = arcs.by_pixel.mT @ unit
        along = across / across.norm(dim=-2, keepdim=True)
        sigma_px = (along.mT @ arcs.covariance_px2 @ along)[..., 0, 0].sqrt()
        expected = distance_px / sigma_px if cost.distances_in == "sigma" else distance_px
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


def test_the_costs_that_the_adjustment_rests_on_are_what_it_takes_them_for():
    assert cost_named(WHITENED).is_whitened and cost_named(IN_PIXELS).distances_in == "px"
    assert cost_named(WHITENED).scaled_rows is not None
    assert any(cost_named(name).scaled_rows is None for name in NAMES)


def test_unknown_cost_is_refused():
    with pytest.raises(InputError, match=f"one of {', '.join(NAMES)}, found 'huber'"):
        cost_function("huber", observed(CAMERAS["pinhole"]))


def image_distances(camera: Pinhole, arcs: MatchedArcs, normal: torch.Tensor) -> torch.Tensor:
    """Distance (px) of the observed end points from the image l = K^-T M of the line."""
    fx, fy, cx, cy, skew = camera.parameters[:5].tolist()
    matrix = torch.tensor([[fx, skew, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    line = normal @ torch.linalg.inv(matrix)
    assert arcs.observed is not None
    ends = torch.cat([arcs.observed.pixels, torch.ones(len(arcs), 2, 1, dtype=torch.float64)], -1)
    return (ends @ line[..., None])[..., 0] / line[:, :2].norm(dim=-1, keepdim=True)


def pixel_sized_normals(arcs: MatchedArcs, seed: int = 5) -> torch.Tensor:
    """Normals for which end points are up to 1 px off."""
    normal = normals_near(arcs, 1e-3, seed)
    for _ in range(30):
        far = arcs.orthogonal_px(normal).abs().amax(-1) > 1
        own = torch.linalg.cross(arcs.bearings[:, 0], arcs.bearings[:, 1])
        own = own / own.norm(dim=-1, keepdim=True) * normal.norm(dim=-1, keepdim=True)
        normal = torch.where(far[:, None], 0.5 * (normal + own), normal)
    return normal


def test_for_a_pinhole_they_are_the_published_image_plane_forms():
    """Within 1e-3 for residuals up to 1 px; Taylor-Kriegman is l (h1^2 + h1 h2 + h2^2) / 3 for a segment of l pixels."""
    camera = CAMERAS["pinhole"]
    arcs = observed(camera, 200)
    normal = pixel_sized_normals(arcs)
    h = image_distances(camera, arcs, normal)
    assert 0.3 < float(h.abs().max()) <= 1.001
    found, _ = cost_function("bartoli-sturm", arcs)(arcs.bearings, normal)
    torch.testing.assert_close(found, h, rtol=1e-3, atol=1e-4)
    length = (arcs.observed.pixels[:, 1] - arcs.observed.pixels[:, 0]).norm(dim=-1)
    published = length * (h[:, 0] ** 2 + h[:, 0] * h[:, 1] + h[:, 1] ** 2) / 3
    found, _ = cost_function("taylor-kriegman", arcs)(arcs.bearings, normal)
    torch.testing.assert_close(found.norm(dim=-1), published.sqrt(), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("camera", ["fisheye", "omnidirectional"])
def test_distances_on_a_wide_camera_are_those_to_the_curve_in_the_image(camera):
    """Against the nearest of many projected points of the line's plane; arcs more than 90 degrees off axis take part."""
    model = CAMERAS[camera]
    arcs = observed(model, 40, seed=7)
    normal = pixel_sized_normals(arcs)
    found, _ = cost_function("bartoli-sturm", arcs)(arcs.bearings, normal)
    unit = normal / normal.norm(dim=-1, keepdim=True)
    share = torch.linspace(-0.1, 1.1, 4001, dtype=torch.float64)
    feet = arcs.bearings - (arcs.bearings @ unit[..., None]) * unit[:, None]
    feet = feet / feet.norm(dim=-1, keepdim=True)
    curve, _ = model.project(points_on_arc(feet[:, 0], feet[:, 1], share))
    ends = arcs.observed.pixels
    at = torch.cdist(ends, curve).argmin(-1).clamp(1, curve.shape[1] - 2)[..., None].expand(-1, -1, 2)
    tangent = curve.gather(1, at + 1) - curve.gather(1, at - 1)
    away = ends - curve.gather(1, at)
    nearest = (away[..., 0] * tangent[..., 1] - away[..., 1] * tangent[..., 0]).abs() / tangent.norm(dim=-1)
    torch.testing.assert_close(found.abs(), nearest, rtol=5e-3, atol=2e-3)
    nodes = arcs.nodes
    assert nodes is not None
    steps = torch.linspace(0, 1, 2001, dtype=torch.float64)
    pieces, _ = model.project(points_on_arc(arcs.bearings[:, 0], arcs.bearings[:, 1], steps))
    length = pieces.diff(dim=1).norm(dim=-1).sum(-1)
    torch.testing.assert_close(nodes.length_px.sum(-1), length, rtol=1e-3, atol=0.05)


def test_whitened_is_the_whitened_sector_residual():
    """r_sector = F Mh with F = T E, E the rows V_i': its covariance T diag(sigma^2) T' whitens it to E Mh / sigma, and
    Bartoli-Sturm is the same for isotropic noise of one pixel."""
    arcs = observed(CAMERAS["fisheye"])
    normal = normals_near(arcs, 0.01)
    r, _ = cost_function("sector", arcs)(arcs.bearings, normal)
    w, _ = cost_function("whitened", arcs)(arcs.bearings, normal)
    unit = normal / normal.norm(dim=-1, keepdim=True)
    factor = sector.prepare(arcs.bearings[:, 0], arcs.bearings[:, 1])
    mixing = factor @ torch.linalg.pinv(arcs.bearings)
    across = arcs.by_pixel.mT @ unit[:, None, :, None]
    sigma = (across.mT @ arcs.covariance_px2 @ across)[..., 0, 0].sqrt()
    covariance = mixing @ torch.diag_embed(sigma**2) @ mixing.mT
    torch.testing.assert_close((factor @ unit[..., None])[..., 0], r)
    squared = (r[:, None] @ torch.linalg.solve(covariance, r[..., None]))[:, 0, 0]
    torch.testing.assert_close(w.square().sum(-1), squared, rtol=1e-6, atol=1e-12)
    plain = observed(CAMERAS["fisheye"], stated=False)
    w, _ = cost_function("whitened", plain)(plain.bearings, normal)
    h, _ = cost_function("bartoli-sturm", plain)(plain.bearings, normal)
    torch.testing.assert_close(w, h)
