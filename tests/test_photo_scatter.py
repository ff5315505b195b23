"""Directions of the camera along which photos scatter more than their chains: told where they do, seldom where they do not."""

import pytest
import torch
from drawn_chains import FISHEYE, OPTIONS, true_chains
from torch import Tensor

from omnilines.calibration.lines.photo_scatter import raised_along
from omnilines.calibration.lines.scores import LEAST_SHARE
from omnilines.geometry.chains import Chains
from omnilines.pipelines.line_camera import adjusted_camera


def drawn(photos: int, size: int, seed: int, along: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """Covariance of the sum of independent chains, scores of photos, with more variance in one direction, and equal shares."""
    numbers = torch.Generator().manual_seed(seed)
    mix = torch.randn(size, size, generator=numbers, dtype=torch.float64)
    scores = torch.randn(photos, size, generator=numbers, dtype=torch.float64)
    scores[:, 0] *= along**0.5
    return photos * mix @ mix.mT, scores @ mix.mT, torch.ones(photos, dtype=torch.float64)


def raised(chains: Tensor, by_photo: Tensor, shares: Tensor) -> Tensor:
    """Variances in units of those by chains, in order."""
    root = torch.linalg.cholesky(chains)
    half = torch.linalg.solve_triangular(root, raised_along(chains, by_photo, shares, LEAST_SHARE), upper=False)
    return torch.linalg.eigvalsh(torch.linalg.solve_triangular(root, half.mT, upper=False))


@pytest.mark.parametrize(("photos", "size"), [(4, 8), (16, 8), (60, 5)])
def test_independent_chains_seldom_make_a_direction_stand_out(photos: int, size: int) -> None:
    out = [raised(*drawn(photos, size, seed)) for seed in range(400)]
    assert sum(float(one[-1]) > float(one[-2]) * (1 + 1e-6) for one in out) <= 12
    assert all(float(one[0]) >= 1 - 1e-6 for one in out)


@pytest.mark.parametrize("more", [8.0, 30.0])
def test_what_photos_scatter_along_one_direction_is_stated_along_it_alone(more: float) -> None:
    out = torch.stack([raised(*drawn(24, 6, seed, more)) for seed in range(200)])
    assert float(out[:, -1].mean()) == pytest.approx(more, rel=0.15)
    assert float(out[:, -2].mean()) < 1 + 1.2 * more / 6


def test_one_photo_that_says_all_tells_no_scatter() -> None:
    chains, by_photo, shares = drawn(12, 6, 0)
    weight = torch.full((12,), 1e-3, dtype=torch.float64)
    weight[3] = 1.0
    out = raised(chains * weight.sum() / 12, by_photo * weight.sqrt()[:, None], shares * weight)
    assert float(out[-1]) == pytest.approx(float(out[0]), rel=1e-6)
    nothing = torch.zeros_like(chains)
    assert torch.equal(raised_along(nothing, 0 * by_photo, 0 * shares, LEAST_SHARE), nothing)


@pytest.mark.slow
def test_a_centre_that_moves_from_photo_to_photo_is_as_uncertain_as_that_makes_it() -> None:
    """As where the image is stabilised: each photo's rows are shifted, by 1 px in the root mean square. One factor for all
    directions would make it 2.1 times as uncertain as without, where photos scatter 4 times as much."""
    chains = true_chains(FISHEYE, 1, photos=16)
    shift = torch.randn(16, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    shift = ((shift - shift.mean()) / shift.std(correction=0)).numpy()
    pixels = chains.pixels.copy()
    pixels[:, 1] += shift[chains.image[chains.chain]]
    shaken = Chains(chains.images, chains.image_size, chains.image, chains.chain, pixels, chains.normals, chains.sigma_px)
    still, moved = (adjusted_camera(FISHEYE, one, OPTIONS) for one in (chains, shaken))
    row = FISHEYE.PARAMETER_NAMES.index("cy")
    sigma = [float((one.problem.basis @ one.covariance @ one.problem.basis.mT)[row, row].sqrt()) for one in (still, moved)]
    assert sigma[1] > 3 * sigma[0]
