"""What camera models say of themselves: to which side they may look, how their variants follow each other, their form."""

import numpy as np
import pytest
import torch

from camera_models import MODELS, CameraModel, InputError, model_class

KINDS = [model_class(name) for name, _ in MODELS]
EXAMPLES = [model for kind in KINDS for model in kind.examples()]


def pixels_of(model: CameraModel) -> torch.Tensor:
    rng = np.random.default_rng(0)
    return torch.as_tensor(rng.uniform(0, np.array(model.image_size) - 1, (300, 2)))


@pytest.mark.parametrize("model", EXAMPLES, ids=lambda model: model.NAME)
def test_a_model_that_may_look_to_either_side_reverses_its_bearings(model: CameraModel) -> None:
    if not model.AXIS_SIGN_OPEN:
        with pytest.raises(InputError, match=f"may look to either side was expected, found {model.NAME}"):
            model.reversed()
        return
    pixels, back = pixels_of(model), model.reversed()
    (bearings, seen), (others, also) = model.unproject(pixels), back.unproject(pixels)
    assert torch.equal(seen, also) and bool(seen.any())
    torch.testing.assert_close(others, bearings * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64), rtol=0, atol=1e-12)
    assert torch.equal(back.reversed().parameters, model.parameters)


@pytest.mark.parametrize("model", EXAMPLES, ids=lambda model: model.NAME)
def test_variants_of_a_model_are_near_each_other_where_they_are_nested(model: CameraModel) -> None:
    rho_px = torch.linspace(1.0, 0.5 * min(model.image_size), 100, dtype=torch.float64)
    if not model.NESTED_VARIANTS:
        assert not model.variant and model.label == model.NAME
        with pytest.raises(InputError, match=f"variants to go through was expected, found {model.NAME}"):
            model.of_variant({}, rho_px)
        return
    assert type(model).variant_options() == set(model.variant) != set()
    assert model.label == f"{model.NAME} of " + " ".join(f"{name} {value}" for name, value in model.variant.items())
    richest = model.of_variant(model.VARIANTS[-1], rho_px)
    assert richest.variant == model.VARIANTS[-1]
    pixels = pixels_of(model)
    torch.testing.assert_close(richest.unproject(pixels)[0], model.unproject(pixels)[0], rtol=0, atol=1e-12)
    again = richest.of_variant(model.variant, rho_px)
    assert again.variant == model.variant
    inner = pixels[(pixels - model.centre_px).norm(dim=-1) < 0.5 * min(model.image_size)]
    torch.testing.assert_close(again.unproject(inner)[0], model.unproject(inner)[0], rtol=0, atol=1e-3)


@pytest.mark.parametrize("model", EXAMPLES, ids=lambda model: model.NAME)
def test_the_calibrated_form_is_held_by_the_calibration(model: CameraModel) -> None:
    """No step along the calibration's directions is needed to leave it as it is, nor to bring it there twice."""
    form = model.calibrated_form()
    torch.testing.assert_close(form.calibrated_form().parameters, form.parameters, rtol=1e-12, atol=1e-15)
    basis = model.calibration_basis()
    tied = [k for k in range(len(basis)) if int((basis[k] != 0).sum()) and bool((basis[:k] == basis[k]).all(1).any())]
    for k in tied:
        first = next(j for j in range(k) if torch.equal(basis[j], basis[k]))
        assert float(form.parameters[k]) == pytest.approx(float(form.parameters[first]), abs=1e-15)
