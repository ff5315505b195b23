"""Lines drawn from covariances of their own about true ones, and how far off they are."""

import numpy as np
import torch

from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.records import Lines


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def drawn_lines(
    direction: np.ndarray, start: np.ndarray, length_m: np.ndarray, sigma_rad: np.ndarray, rng: np.random.Generator
) -> tuple[Lines, LineChart]:
    """Lines that start about at points and are so long, each drawn from a covariance of its own, of the size `sigma_rad` (a
    standard deviation of its chart of 2 m); and the true charts."""
    count = len(direction)
    d, point = torch.as_tensor(direction), torch.as_tensor(start)
    centre = point + torch.as_tensor(rng.normal(size=(count, 3)))
    chart = LineChart.from_lines(
        PlueckerLines(d, torch.linalg.cross(point, d)), centre, torch.full((count,), 2.0, dtype=torch.float64)
    )
    mix = rng.normal(size=(count, 4, 4)) * np.exp(rng.uniform(-0.5, 0.5, (count, 1, 1))) * sigma_rad[:, None, None] / 2
    seen = chart.retract(torch.as_tensor((mix @ rng.normal(size=(count, 4, 1)))[..., 0])).lines()
    first = seen.closest_point(point)
    ends = torch.stack([first, first + seen.direction * torch.as_tensor(length_m[:, None])], 1).numpy()
    one, covariance = np.ones(count), mix @ mix.transpose(0, 2, 1)
    names, views = tuple(map(str, range(count))), np.full(count, 5)
    return Lines(names, ends, views, one, one, ("ok",) * count, covariance, centre.numpy(), chart.scale.numpy()), chart


def square_error(lines: Lines, true: LineChart) -> np.ndarray:
    """Squared error of each line in units of its covariance: chi-square with 4 degrees of freedom."""
    ends = torch.as_tensor(lines.ends_m - lines.chart_centre_m[:, None])
    own = PlueckerLines.from_points(ends[:, 0], ends[:, 1])
    chart = LineChart.from_lines(own, torch.zeros_like(own.direction), true.scale)
    turn = (chart.S.mT @ true.S).numpy()
    error = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0], (true.phi - chart.phi).numpy()], -1)
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(lines.covariance), error)
