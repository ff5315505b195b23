"""Camera models against the programs and publications that define them: OpenCV, kornia, closed forms."""

import math

import cv2
import numpy as np
import pytest
import torch
from model_cases import bearings_of, image_pixels

import camera_models
from camera_models import model_class


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
