"""The law suite: every registered camera model, every example, NumPy and torch, on both sides of each boundary."""

import math

import cv2
import numpy as np
import pytest
import torch

import camera_models
from camera_models import MODELS, model_class

CASES = [(name, index, model) for name, _ in MODELS for index, model in enumerate(model_class(name).examples())]
EACH = pytest.mark.parametrize("model", [case[2] for case in CASES], ids=[f"{name}-{index}" for name, index, _ in CASES])


def axis_sign(model) -> float:
    return float(torch.sign(model._unproject(model.centre_px)[0][2]))


def bearings_of(model, count=4000, seed=0, share=0.999, least=0.0):
    """Unit bearings spread over the domain of the model."""
    rng = np.random.default_rng(seed)
    theta = least + rng.uniform(0, 1, count) * (share * min(model.max_angle, math.radians(115)) - least)
    phi = rng.uniform(-np.pi, np.pi, count)
    xyz = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    return xyz * [1, 1, axis_sign(model)]


def image_pixels(model, count=3000, seed=1):
    rng = np.random.default_rng(seed)
    w, h = model.image_size
    return rng.uniform([-0.5, -0.5], [w - 0.5, h - 0.5], (count, 2))


def radial_slope(model, pixels):
    """d theta / d rho at pixels relative to its central value, from the singular values of the projection's Jacobian."""
    bearing, _ = model.unproject(torch.as_tensor(pixels))
    _, _, by_point, _ = model.project_with_jacobians(bearing)
    gain = torch.linalg.svdvals(by_point)[..., 0]
    _, _, central, _ = model.project_with_jacobians(model._unproject(model.centre_px)[0])
    return (torch.linalg.svdvals(central)[..., 0] / gain).numpy()


def pixel_difference(model, a, b):
    """a - b, modulo the width where the image closes around the sphere."""
    difference = a - b
    if model.PERIODIC:
        difference[..., 0] -= model.image_size[0] * np.round(difference[..., 0] / model.image_size[0])
    return difference


def test_registry_covers_the_package():
    assert len(CASES) >= 9
    assert {name for name, _ in MODELS} == {model.NAME for _, _, model in CASES}


@EACH
def test_round_trip_inside_the_image(model):
    pixels = image_pixels(model)
    bearings, valid = model.unproject(pixels)
    assert isinstance(bearings, np.ndarray) and valid.dtype == bool
    np.testing.assert_allclose(np.linalg.norm(bearings, axis=-1), 1, atol=1e-14)
    again, seen = model.project(bearings)
    ordinary = valid.copy()
    ordinary[valid] = radial_slope(model, pixels[valid]) > 1e-3
    assert ordinary.mean() > 0.5
    assert seen[ordinary].all()
    assert np.abs(pixel_difference(model, again, pixels))[ordinary].max() < 1e-9


@EACH
def test_round_trip_over_the_whole_domain(model):
    bearings = bearings_of(model, share=0.99)
    pixels, valid = model.project(bearings * np.random.default_rng(3).uniform(0.01, 100, (len(bearings), 1)))
    assert valid.all()
    again, seen = model.unproject(pixels)
    assert seen.all()
    assert np.linalg.norm(again - bearings, axis=-1).max() < 1e-10


@EACH
def test_near_and_on_the_axis(model):
    sign = axis_sign(model)
    for offset in (0.0, 1e-300, 1e-15, 1e-9, 1e-8, 0.99e-7, 1.01e-7, 1e-6):
        point = np.array([offset, -0.5 * offset, sign])
        pixel, valid = model.project(point)
        assert valid
        expected = model.centre_px.numpy() + slope_at_centre(model) @ point[:2]
        np.testing.assert_allclose(pixel, expected, rtol=0, atol=1e-9)
        bearing, seen = model.unproject(pixel)
        assert seen
        np.testing.assert_allclose(bearing, point / np.linalg.norm(point), rtol=0, atol=1e-12)


def slope_at_centre(model):
    _, _, by_point, _ = model.project_with_jacobians(torch.tensor([0.0, 0.0, axis_sign(model)], dtype=torch.float64))
    return by_point[:, :2].numpy()


@EACH
def test_validity_edge(model):
    """Just inside the largest angle a point is seen, just outside it is not, and nothing is NaN anywhere."""
    edge = model.max_angle
    sign = axis_sign(model)
    phis = np.linspace(-3, 3, 7)
    for phi in phis:
        for theta, expected in ((edge - 1e-6, True), (min(edge + 1e-6, math.pi), False)):
            point = np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), sign * math.cos(theta)])
            pixel, valid = model.project(point)
            assert bool(valid) is expected or edge >= math.pi
            assert np.isfinite(pixel).all()
    pixels, valid = model.project(np.array([[0.0, 0, 0], [0, 0, -sign], [1e-3, 0, -sign]]))
    assert np.isfinite(pixels).all()
    assert not valid[0]
    assert valid[1] == model.PERIODIC


@EACH
def test_pixels_beyond_the_edge_are_not_seen(model):
    """On a walk outwards, valid never comes back once lost, and no bearing exceeds the largest angle or turns back.

    On an image that closes around the sphere the walk goes around it, and the angle off axis rises and falls."""
    steps = np.linspace(0, 30 * model.image_radius_px, 3001)
    checked = 0
    for phi in np.linspace(0, 2 * np.pi, 9)[:-1]:
        pixels = model.centre_px.numpy() + steps[:, None] * [math.cos(phi), math.sin(phi)]
        bearings, valid = model.unproject(pixels)
        assert np.isfinite(bearings).all()
        assert (np.diff(valid.astype(int)) <= 0).all()
        theta = np.arctan2(np.hypot(bearings[:, 0], bearings[:, 1]), axis_sign(model) * bearings[:, 2])
        assert (theta[valid] <= model.max_angle + 1e-9).all()
        assert (np.diff(theta[valid]) >= 0).all() or model.PERIODIC
        again, seen = model.project(bearings[valid][: len(steps) // 2])
        off = np.abs(pixel_difference(model, again, pixels[valid][: len(steps) // 2]))[seen].max(-1)
        scale = 1 + steps[valid][: len(steps) // 2][seen]
        slope = radial_slope(model, pixels[valid][: len(steps) // 2][seen])
        ordinary = slope > 1e-3
        assert (off[ordinary] < 1e-9 * scale[ordinary]).all()
        checked += int(valid.sum())
    assert checked > 100


@EACH
def test_what_is_not_seen_is_finite_all_the_same(model):
    """Points and pixels of any size, on either side of everything: where `valid` is false the value is finite."""
    rng = np.random.default_rng(4)
    points = rng.standard_normal((600, 3)) * 10.0 ** rng.uniform(-9, 9, (600, 1))
    points = np.concatenate([points, [[0, 0, 0], [0, 0, 1], [0, 0, -1], [1e-9, 0, -1], [1, 0, 0], [1, 0, 1e-12], [1, 0, -1e-12]]])
    pixels, valid = model.project(points)
    again, seen, by_point, by_parameter = model.project_with_jacobians(torch.as_tensor(points))
    assert np.array_equal(valid, seen.numpy()) and not valid.all()
    assert all(np.isfinite(part).all() for part in (pixels, again.numpy(), by_point.numpy(), by_parameter.numpy()))
    far = rng.uniform(-1, 1, (300, 2)) * 10.0 ** rng.uniform(0, 100, (300, 1))
    assert np.isfinite(model.unproject(far)[0]).all()
    assert torch.isfinite(model.unproject(torch.as_tensor(far))[0]).all()


@EACH
def test_jacobians_agree(model):
    """Analytic = automatic (forward and reverse through `project`) = finite differences."""
    points = torch.as_tensor(bearings_of(model, 60, seed=5, share=0.9, least=0.001)) * 2.5
    pixels, valid, by_point, by_parameter = model.project_with_jacobians(points)
    assert valid.all()
    torch.testing.assert_close(pixels, model.project(points)[0], rtol=0, atol=1e-9)

    def of_points(p):
        return model.project(p)[0].sum(0)

    def of_parameters(theta):
        return model.with_parameters(theta).project(points)[0]

    auto_points = torch.autograd.functional.jacobian(of_points, points).permute(1, 0, 2)
    auto_parameters = torch.autograd.functional.jacobian(of_parameters, model.parameters)
    scale = by_point.abs().max()
    torch.testing.assert_close(by_point, auto_points, rtol=1e-8, atol=float(1e-9 * scale))
    torch.testing.assert_close(by_parameter, auto_parameters, rtol=1e-8, atol=1e-8)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = 1e-6
        numeric = (model.project(points + step)[0] - model.project(points - step)[0]) / 2e-6
        torch.testing.assert_close(by_point[..., axis], numeric, rtol=1e-5, atol=float(1e-6 * scale))
    for index in range(len(model.parameters)):
        size = 1e-3 / float(by_parameter[..., index].abs().max())  # moves some pixel by a thousandth
        step = torch.zeros_like(model.parameters)
        step[index] = size
        numeric = (of_parameters(model.parameters + step) - of_parameters(model.parameters - step)) / (2 * size)
        atol = float(2e-5 * by_parameter[..., index].abs().max())
        torch.testing.assert_close(by_parameter[..., index], numeric, rtol=1e-4, atol=atol)


@EACH
def test_unproject_is_differentiable(model):
    points = torch.as_tensor(bearings_of(model, 40, seed=6, share=0.9, least=0.01))
    pixels = model.project(points)[0]
    automatic = torch.autograd.functional.jacobian(lambda p: model.unproject(p)[0].sum(0), pixels).permute(1, 0, 2)
    analytic = model.unproject_jacobian(pixels)
    torch.testing.assert_close(analytic, automatic, rtol=1e-6, atol=float(1e-8 * automatic.abs().max()))

    def of_parameters(theta):
        return model.with_parameters(theta).unproject(pixels)[0]

    automatic = torch.autograd.functional.jacobian(of_parameters, model.parameters)
    _, _, _, by_parameter = model.project_with_jacobians(points)
    # project(unproject(pixel)) = pixel for all parameters: J_point d bearing + J_parameter = 0.
    largest = max(automatic.abs().flatten().tolist(), default=0.0)
    torch.testing.assert_close(automatic, -(analytic @ by_parameter), rtol=1e-6, atol=1e-8 * largest)


@EACH
def test_batch_shapes_and_kinds(model):
    points = bearings_of(model, 24, seed=7, share=0.9)
    flat, valid = model.project(points)
    folded, folded_valid = model.project(points.reshape(2, 3, 4, 3))
    np.testing.assert_allclose(folded.reshape(-1, 2), flat, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(folded_valid.reshape(-1), valid)
    tensor, _ = model.project(torch.as_tensor(points))
    assert isinstance(tensor, torch.Tensor)
    np.testing.assert_allclose(tensor.numpy(), flat, rtol=0, atol=1e-10)
    single, single_valid = model.project(points[0])
    np.testing.assert_allclose(single, flat[0], rtol=0, atol=1e-10)
    assert single.shape == (2,) and single_valid.shape == ()
    empty, _ = model.project(np.zeros((0, 3)))
    assert empty.shape == (0, 2)
    assert model.unproject(flat.reshape(4, 6, 2))[0].shape == (4, 6, 3)


@EACH
def test_named_parameters_make_the_same_model(model):
    again = type(model).from_mapping(model.named_parameters(), model.image_size)
    assert again.named_parameters() == model.named_parameters()
    assert again.image_size == model.image_size
    with pytest.raises(camera_models.InputError, match="unknown nonsense"):
        type(model).from_mapping({**model.named_parameters(), "nonsense": 1.0}, model.image_size)
    if model.PARAMETER_NAMES:
        incomplete = dict(list(model.named_parameters().items())[1:])
        with pytest.raises(camera_models.InputError, match="missing"):
            type(model).from_mapping(incomplete, model.image_size)


@EACH
def test_start_from_a_radial_curve(model):
    """The start of a calibration lies within a few pixels of the curve that it is handed."""
    seen = min(model.max_angle * 0.9, math.radians(75 if model.NAME == "pinhole" else 100))
    theta = torch.linspace(0.05, seen, 60, dtype=torch.float64)
    ring = torch.stack([torch.sin(theta), torch.zeros_like(theta), axis_sign(model) * torch.cos(theta)], -1)
    rho = (model.project(ring)[0] - model.centre_px).norm(dim=-1)
    if not model.CALIBRATED:
        with pytest.raises(camera_models.InputError, match="is not calibrated"):
            type(model).from_radial_curve(rho, theta, model.centre_px, model.image_size)
        return
    start = type(model).from_radial_curve(rho, theta, model.centre_px, model.image_size, mirror=axis_sign(model) < 0)
    off = (start.project(ring)[0] - start.centre_px).norm(dim=-1) - rho
    assert float(off.abs().max()) < 0.05 * float(rho.max())


@EACH
def test_calibration_basis_spans_estimable_directions(model):
    basis = model.calibration_basis()
    assert basis.shape[0] == len(model.parameters)
    assert (basis.shape[1] > 0) == model.CALIBRATED
    assert int(torch.linalg.matrix_rank(basis)) == basis.shape[1]


@pytest.mark.parametrize("index", range(5))
def test_pinhole_against_opencv(index):
    model = camera_models.Pinhole.examples()[index]
    points = bearings_of(model, 500, share=0.95)
    fx, fy, cx, cy, skew = model.parameters[:5].tolist()
    ideal = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    expected, _ = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), ideal, model.parameters[5:].numpy())
    expected = expected[:, 0]
    expected[:, 0] += skew * (expected[:, 1] - cy) / fy
    np.testing.assert_allclose(model.project(points)[0], expected, atol=1e-8)


@pytest.mark.parametrize("index", range(4))
def test_fisheye_against_opencv(index):
    model = camera_models.OpenCVFisheye.examples()[index]
    points = bearings_of(model, 500)
    points = points[points[:, 2] > 0.02]
    assert len(points) > 100
    fx, fy, cx, cy = model.parameters[:4].tolist()
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    expected, _ = cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), matrix, model.parameters[4:].numpy())
    np.testing.assert_allclose(model.project(points)[0], expected[0], atol=1e-8)


def test_fisheye_against_kornia():
    from kornia.geometry.camera.distortion_kannala_brandt import distort_points_kannala_brandt

    model = camera_models.OpenCVFisheye.examples()[0]
    points = torch.as_tensor(bearings_of(model, 500))
    points = points[points[:, 2] > 0.05]
    assert len(points) > 100
    expected = distort_points_kannala_brandt(points[:, :2] / points[:, 2:], model.parameters)
    torch.testing.assert_close(model.project(points)[0], expected, rtol=0, atol=1e-8)


def test_pinhole_against_kornia():
    from kornia.geometry.calibration import distort_points

    model = camera_models.Pinhole.examples()[1]
    points = torch.as_tensor(bearings_of(model, 500, share=0.9))
    fx, fy, cx, cy, _ = model.parameters[:5].tolist()
    matrix = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]], dtype=torch.float64)
    ideal = points[:, :2] / points[:, 2:] * torch.tensor([fx, fy]) + torch.tensor([cx, cy])
    expected = distort_points(ideal[None], matrix[None], model.parameters[5:][None])[0]
    torch.testing.assert_close(model.project(points)[0], expected, rtol=0, atol=1e-6)


def test_scaramuzza_is_the_published_polynomial():
    """unproject is (x, y, f(rho)) by definition; project agrees with a root of rho z = s f(rho) found by NumPy."""
    model = camera_models.Scaramuzza.examples()[0]
    cx, cy, c, d, e, *a = model.parameters.tolist()
    pixels = image_pixels(model, 200)
    y_x = np.linalg.solve([[1, e], [d, c]], (pixels - [cx, cy]).T).T
    rho = np.hypot(*y_x.T)
    f = a[0] + a[1] * rho**2 + a[2] * rho**3 + a[3] * rho**4
    ray = np.column_stack([y_x, f])
    np.testing.assert_allclose(model.unproject(pixels)[0], ray / np.linalg.norm(ray, axis=1)[:, None], atol=1e-14)
    for point in bearings_of(model, 50, least=0.05):
        s = math.hypot(point[0], point[1])
        roots = np.roots([a[3] * s, a[2] * s, a[1] * s, -point[2], a[0] * s])
        root = min(r.real for r in roots if abs(r.imag) < 1e-9 and r.real > 0)
        x, y = root * point[:2] / s
        np.testing.assert_allclose(model.project(point)[0], [cx + x + e * y, cy + d * x + c * y], atol=1e-8)


@pytest.mark.parametrize("index", range(5))
def test_unified_against_opencv(index):
    model = camera_models.model_class("unified").examples()[index]
    points = bearings_of(model, 500)
    fx, fy, cx, cy, skew, xi, *distortion = model.parameters.tolist()
    matrix = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1.0]])
    expected, _ = cv2.omnidir.projectPoints(points[None], np.zeros(3), np.zeros(3), matrix, xi, np.array(distortion))
    pixels, valid = model.project(points)
    assert valid.all()
    near = np.abs(expected[0]).max(-1) < 1e5  # the image is infinite at the edge of some
    assert near.sum() > 400
    np.testing.assert_allclose(pixels[near], expected[0][near], atol=1e-7)


@pytest.mark.parametrize("index", range(4))
def test_extended_unified_is_the_published_projection(index):
    """Khomutenko et al. 2016, equations (5) and (8), and the end of its domain: z > -w d with their w."""
    model = camera_models.model_class("extended-unified").examples()[index]
    fx, fy, cx, cy, alpha, beta = model.parameters.tolist()
    count = 0
    for x, y, z in bearings_of(model, 200):
        rho = math.sqrt(beta * (x * x + y * y) + z * z)
        eta = alpha * rho + (1 - alpha) * z
        pixel, valid = model.project(np.array([x, y, z]))
        assert valid
        np.testing.assert_allclose(pixel, [fx * x / eta + cx, fy * y / eta + cy], rtol=1e-11)
        mx, my = (pixel[0] - cx) / fx, (pixel[1] - cy) / fy
        r2 = mx * mx + my * my
        mz = (1 - beta * alpha**2 * r2) / (alpha * math.sqrt(1 - (2 * alpha - 1) * beta * r2) + (1 - alpha))
        np.testing.assert_allclose(model.unproject(pixel)[0], np.array([mx, my, mz]) / math.hypot(mx, my, mz), atol=1e-9)
        count += 1
    assert count == 200
    w = (1 - alpha) / alpha if alpha > 0.5 else alpha / (1 - alpha)
    s, z = math.sin(model.max_angle), math.cos(model.max_angle)
    assert abs(z / math.sqrt(beta * s * s + z * z) + w) < 1e-7


@pytest.mark.parametrize("index", range(5))
def test_double_sphere_is_the_published_projection(index):
    """Usenko et al. 2018, equations (40) to (42) and (46) to (49); their bound (43) to (45) lies inside our domain."""
    model = camera_models.model_class("double-sphere").examples()[index]
    fx, fy, cx, cy, xi, alpha = model.parameters.tolist()
    w1 = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
    w2 = (w1 + xi) / math.sqrt(2 * w1 * xi + xi * xi + 1)
    count = 0
    for x, y, z in bearings_of(model, 200):
        d1 = math.hypot(x, y, z)
        d2 = math.hypot(x, y, xi * d1 + z)
        divisor = alpha * d2 + (1 - alpha) * (xi * d1 + z)
        pixel, valid = model.project(np.array([x, y, z]))
        assert valid
        np.testing.assert_allclose(pixel, [fx * x / divisor + cx, fy * y / divisor + cy], rtol=1e-11)
        mx, my = (pixel[0] - cx) / fx, (pixel[1] - cy) / fy
        r2 = mx * mx + my * my
        mz = (1 - alpha * alpha * r2) / (alpha * math.sqrt(1 - (2 * alpha - 1) * r2) + 1 - alpha)
        k = (mz * xi + math.sqrt(mz * mz + (1 - xi * xi) * r2)) / (mz * mz + r2)
        np.testing.assert_allclose(model.unproject(pixel)[0], [k * mx, k * my, k * mz - xi], atol=1e-9)
        count += 1
    assert count == 200
    assert -math.cos(model.max_angle) >= w2 - 1e-9 or xi > 1


@pytest.mark.parametrize("name", ["unified", "extended-unified", "double-sphere"])
def test_the_domain_of_a_sphere_model_ends_where_the_radius_stops_growing(name):
    """At the largest angle the published radius turns over or is infinite: found on a fine grid, without our closed form."""
    turned = infinite = 0
    for model in model_class(name).examples():
        theta = np.linspace(0, math.pi, 200001)[:-1]
        s, z = np.sin(theta), np.cos(theta)
        p = model.named_parameters()
        if name == "unified":
            r = s / (z + p["xi"])
            r = np.where(r > 0, r * (1 + p["k1"] * r**2 + p["k2"] * r**4), r)
        elif name == "extended-unified":
            r = s / (p["alpha"] * np.hypot(np.sqrt(p["beta"]) * s, z) + (1 - p["alpha"]) * z)
        else:
            r = s / (p["alpha"] * np.hypot(s, p["xi"] + z) + (1 - p["alpha"]) * (p["xi"] + z))
        stops = np.flatnonzero(np.diff(r) <= 0)
        edge = theta[stops[0] + 1] if len(stops) else math.pi
        turned, infinite = turned + (model.max_radius < 1e3), infinite + (model.max_radius >= 1e3)
        # Tangential terms fold a little earlier in one direction.
        assert abs(model.max_angle - edge) < (5e-3 if p.get("p1") else 1e-4)
    assert turned and infinite


@pytest.mark.parametrize("index", range(2))
def test_equirectangular_against_opencv(index):
    """cv2's spherical warper, which works in single precision and counts from its own origin."""
    model = camera_models.model_class("equirectangular").examples()[index]
    w, h = model.image_size
    warper = cv2.PyRotationWarper("spherical", 100.0)
    bearings = bearings_of(model, 300, seed=4)
    turned = 0
    for bearing in bearings:
        z = bearing[2]
        # A rotation of the middle pixel's ray onto the bearing: the warper takes pixels of a pinhole camera and a rotation.
        helper = np.cross(bearing, [0.0, 1.0, 0.0])
        first = helper / np.linalg.norm(helper)
        rotation = np.stack([first, np.cross(bearing, first), bearing], -1).astype(np.float32)
        longitude, latitude = np.array(warper.warpPoint((0.0, 0.0), np.eye(3, dtype=np.float32), rotation)) / 100
        pixel, valid = model.project(bearing)
        assert valid
        np.testing.assert_allclose(pixel, [w * (longitude / (2 * np.pi) + 0.5) - 0.5, h * latitude / np.pi - 0.5], atol=2e-3)
        turned += z < 0
    assert turned > 30


def test_equirectangular_landmarks():
    """The middle looks along +z, a quarter of the width further along +x, the bottom along +y; both edges look along -z."""
    model = camera_models.model_class("equirectangular")([], (2048, 1024))
    for pixel, bearing in (
        ((1023.5, 511.5), (0, 0, 1)),
        ((1535.5, 511.5), (1, 0, 0)),
        ((511.5, 511.5), (-1, 0, 0)),
        ((1023.5, 1023.5), (0, 1, 0)),
        ((-0.5, 511.5), (0, 0, -1)),
        ((2047.5, 511.5), (0, 0, -1)),
        ((2048.0 + 1535.5, 511.5), (1, 0, 0)),
    ):
        found, valid = model.unproject(np.array(pixel))
        assert valid
        np.testing.assert_allclose(found, bearing, atol=1e-12)
    assert not model.unproject(np.array([100.0, 1024.0]))[1]
    assert not model.project(np.array([0.0, 1.0, 0.0]))[1]


@pytest.mark.parametrize("name", ["unified", "extended-unified", "double-sphere"])
def test_sphere_models_refuse_mirrors(name):
    theta = torch.linspace(0.1, 1, 10, dtype=torch.float64)
    with pytest.raises(camera_models.InputError, match="use `model` scaramuzza"):
        model_class(name).from_radial_curve(300 * theta, theta, torch.zeros(2, dtype=torch.float64), (640, 480), mirror=True)


@pytest.mark.parametrize("name", ["unified", "extended-unified", "double-sphere"])
def test_parameters_outside_their_range_give_no_nan(name):
    """A solver may try such parameters: nothing is NaN and what is valid goes there and back."""
    shapes = {
        "unified": [[0.0, -0.7, 0, 0, 0, 0], [0.0, -1.5, 0.1, 0, 0, 0], [0.0, 5.0, 0, 0, 0, 0]],
        "extended-unified": [[-0.3, 1.0], [1.2, 1.0], [0.6, -0.5], [0.5, 1e-3], [0.0, 1.0], [1.0, 1.0]],
        "double-sphere": [[-1.0, 0.5], [-1.5, 0.6], [0.3, -0.4], [0.3, 1.2], [2.0, 0.7], [0.0, 0.0], [1.0, 1.0]],
    }[name]
    rng = np.random.default_rng(8)
    points = np.concatenate([rng.standard_normal((2000, 3)), [[0, 0, 1.0], [0, 0, -1.0], [0, 0, 0.0]]])
    for shape in shapes:
        model = model_class(name)([300.0, 300.0, 320.0, 240.0, *shape], (640, 480))
        pixels, valid, by_point, by_parameter = model.project_with_jacobians(torch.as_tensor(points))
        assert all(bool(torch.isfinite(part).all()) for part in (pixels, by_point, by_parameter))
        again, seen = model.unproject(pixels.numpy())
        assert np.isfinite(again).all() and np.isfinite(model.unproject(image_pixels(model))[0]).all()
        inside = valid.numpy() & (np.linalg.norm(pixels.numpy() - [320.0, 240.0], axis=-1) < 1e4)
        assert seen[inside].all()
        unit = points[inside] / np.linalg.norm(points[inside], axis=-1, keepdims=True)
        np.testing.assert_allclose(again[inside], unit, atol=1e-7)


def test_unknown_model_is_named():
    with pytest.raises(camera_models.InputError, match=f"one of {', '.join(name for name, _ in MODELS)}, found 'fish'"):
        model_class("fish")
