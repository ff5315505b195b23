"""The law suite: every registered camera model, every example, NumPy and torch, on both sides of each boundary."""

import math
import warnings

import numpy as np
import pytest
import torch
from model_cases import axis_sign, bearings_of, image_pixels

import camera_models
from camera_models import MODELS, InputError, model_class

CASES = [(name, index, model) for name, _ in MODELS for index, model in enumerate(model_class(name).examples())]
EACH = pytest.mark.parametrize("model", [case[2] for case in CASES], ids=[f"{name}-{index}" for name, index, _ in CASES])


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
def test_numbers_that_are_no_camera_are_refused(model):
    values = model.named_parameters()
    wrong = [(name, bad) for name in values for bad in (math.nan, math.inf)]
    wrong += [(name, bad) for name in ("fx", "fy") if name in values for bad in (0.0, -500.0)]
    for name, bad in wrong:
        for given in (list({**values, name: bad}.values()), np.array(list({**values, name: bad}.values()))):
            with pytest.raises(
                InputError, match=rf"The parameter {name} of camera model {model.NAME} was expected .* found {bad:g}"
            ):
                model.with_parameters(given)
        with pytest.raises(InputError, match=rf"{name} of camera model {model.NAME} was expected .* found {bad:g}"):
            type(model)(torch.tensor(list({**values, name: bad}.values())), model.image_size)
        # A fit may pass through anything.
        assert len(model.with_parameters(torch.tensor(list({**values, name: bad}.values()))).parameters) == len(values)


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


def test_a_curve_whose_best_focal_length_is_below_0_starts_a_pinhole_all_the_same():
    """Views that are no board's make such curves; the start was refused as parameters that a user had typed."""
    theta = torch.linspace(0.01, math.radians(60), 100, dtype=torch.float64)
    start = camera_models.Pinhole.from_radial_curve(500 * (theta / theta[-1]) ** 4, theta, torch.zeros(2).double(), (640, 480))
    assert float(start.parameters[0]) > 0


@EACH
def test_calibration_basis_spans_estimable_directions(model):
    basis = model.calibration_basis()
    assert basis.shape[0] == len(model.parameters)
    assert (basis.shape[1] > 0) == model.CALIBRATED
    assert int(torch.linalg.matrix_rank(basis)) == basis.shape[1]


def test_unknown_model_is_named():
    with pytest.raises(camera_models.InputError, match=f"one of {', '.join(name for name, _ in MODELS)}, found 'fish'"):
        model_class("fish")


def test_arrays_of_any_order_are_numbers_and_cameras_keep_their_own() -> None:
    lens = camera_models.OpenCVFisheye.examples()[0]
    rows = np.argwhere(np.eye(9, dtype=bool))
    wanted, _ = lens.unproject(np.array(rows[:, ::-1], dtype=float))
    for given in (rows[:, ::-1], rows[:, ::-1].astype(">f8"), rows[:, ::-1].astype(np.longdouble), np.asfortranarray(rows * 1.0)):
        np.testing.assert_array_equal(lens.unproject(given)[0], wanted)
    fixed = np.broadcast_to(np.array([3.0, 4.0]), (2, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(*lens.unproject(fixed)[0])
        np.testing.assert_array_equal(*lens.unproject([np.array([3.0, 4.0]), np.array([3.0, 4.0])])[0])
    of_tensors, _ = lens.unproject([torch.tensor([3.0, 4.0]), torch.tensor([3.0, 4.0])])
    np.testing.assert_array_equal(of_tensors, lens.unproject(fixed)[0])
    for words in (np.array(["1", "2"]), np.array([1, None]), [[1.0], [1.0, 2.0]]):
        with pytest.raises(InputError, match="An array of real numbers was expected"):
            lens.unproject(words)
    values = lens.parameters.numpy().copy()
    for given in (values, torch.as_tensor(values)):
        made = camera_models.OpenCVFisheye(given, lens.image_size)
        given[0] = 1.0
        assert float(made.parameters[0]) == float(lens.parameters[0])
        given[0] = float(lens.parameters[0])
    free = torch.as_tensor(values.copy()).requires_grad_()
    assert camera_models.OpenCVFisheye(free, lens.image_size).parameters is free
