"""Places of edges told by colour without brightness: their noise, how far it is alike along an edge, and JPEGs of known edges."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from scipy.special import ndtr

from camera_models import Pinhole
from omnilines.extraction import ExtractedArcs, extract_arcs
from omnilines.extraction.alike import ChromaNoise, ToldChroma, correlation, correlations
from omnilines.extraction.kernels.chroma import LUMA, chroma_noise
from omnilines.extraction.kernels.circle import LEFT, OFF, WEIGHT

SIZE = (960, 720)
CAMERA = Pinhole.from_mapping({"fx": 800.0, "fy": 800.0, "cx": 479.5, "cy": 359.5}, SIZE)
CHI2_95 = 5.99
BLUR_PX = 0.6


def jpeg(quality: int, sampling: int) -> Callable[[np.ndarray], np.ndarray]:
    settings = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    return lambda image: cv2.imdecode(cv2.imencode(".jpg", image, settings)[1], cv2.IMREAD_COLOR)


def drawn(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """48 turned rectangles: the photo, their sides (n, 2, 2) in pixels, and the change of colour across them (n, 3). Every third
    one is as bright as the ground, and differs by colour alone."""
    ground = np.array([120.0, 130.0, 125.0])
    image = np.tile(ground, (SIZE[1], SIZE[0], 1))
    sides, changes = [], []
    pixel = np.stack(np.meshgrid(np.arange(120.0), np.arange(120.0)), -1)
    for k in range(48):
        first = np.array([120 * (k % 8), 120 * (k // 8)])
        centre, half = np.array([59.5, 59.5]) + rng.uniform(-3.0, 3.0, 2), rng.uniform(28.0, 36.0, 2)
        turn = rng.uniform(0.0, 0.5 * np.pi)
        way = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        inside = ndtr((half - np.abs((pixel - centre) @ way.T)) / BLUR_PX).prod(-1)
        colour = rng.uniform(-1.0, 1.0, 3)
        colour -= LUMA @ colour
        colour *= rng.uniform(50.0, 70.0) / np.abs(colour).max()
        change = colour if k % 3 == 0 else colour + rng.choice([-1.0, 1.0]) * rng.uniform(20.0, 45.0)
        image[first[1] : first[1] + 120, first[0] : first[0] + 120] += inside[..., None] * change
        corners = first + centre + (np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half) @ way
        sides.append(np.stack([corners, np.roll(corners, -1, 0)], 1))
        changes += [change] * 4
    noisy = image + 1.5 * rng.standard_normal(image.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), np.concatenate(sides), np.stack(changes)


def distances(found: ExtractedArcs, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the arcs that lie on a side, which it is, and the square of the normal's error over its covariance."""
    rays = CAMERA.unproject(sides)[0]
    truth = np.cross(rays[:, 0], rays[:, 1])
    truth /= np.linalg.norm(truth, axis=-1, keepdims=True)
    along = sides[:, 1] - sides[:, 0]
    across = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=-1, keepdims=True)
    off = np.abs(((found.endpoints_px[:, None] - sides[None, :, :1]) * across[None, :, None]).sum(-1)).max(-1)
    near = np.linalg.norm(found.endpoints_px.mean(1)[:, None] - sides.mean(1), axis=-1) < 20.0
    side = np.where(near, off, np.inf).argmin(-1)
    arc = np.flatnonzero(np.where(near, off, np.inf).min(-1) < 2.0)
    side, arcs = side[arc], found.arcs
    normal = truth[side] * np.sign((truth[side] * arcs.normal[arc]).sum(-1, keepdims=True))
    change = np.stack([(normal * arcs.first[arc]).sum(-1), (normal * arcs.second[arc]).sum(-1)], -1)
    return side, np.einsum("ni,nij,nj->n", change, np.linalg.inv(arcs.covariance[arc]), change)


@pytest.mark.parametrize(
    ("treat", "least_of_colour", "least_of_both"),
    [(lambda image: image, 0.97, 0.97), (jpeg(75, 0x111111), 0.95, 0.965), (jpeg(75, 0x221111), 0.55, 0.95)],
    ids=["as drawn", "JPEG, 4:4:4", "JPEG, 4:2:0"],
)
def test_edges_of_mere_colour_lie_where_their_covariance_says(
    treat: Callable[[np.ndarray], np.ndarray], least_of_colour: float, least_of_both: float
) -> None:
    """While chroma counted like luma: 100, 94 and 47 percent, and of both 100, 95 and 91. In 4:2:0 it is too seldom still."""
    rng = np.random.default_rng(7)
    of_colour, of_both = [], []
    for _ in range(3):
        image, sides, changes = drawn(rng)
        side, chi2 = distances(extract_arcs(treat(image), CAMERA), sides)
        mere = np.abs(changes[side] @ LUMA) < 1.0
        of_colour.append(chi2[mere])
        of_both.append(chi2[~mere])
    assert len(np.concatenate(of_colour)) > 150
    assert (np.concatenate(of_colour) < CHI2_95).mean() > least_of_colour
    assert (np.concatenate(of_both) < CHI2_95).mean() > least_of_both


def test_noise_of_chroma_is_what_it_adds_to_places() -> None:
    """In channels of luma and the rest; and none in a grey photo of three channels."""
    rng = np.random.default_rng(3)
    count, row = 40, rng.standard_normal(13).astype(np.float32)
    grey = rng.uniform(0.0, 255.0, (60, 3, 13)).astype(np.float32)
    difference = rng.uniform(-80.0, 80.0, (60, 3)).astype(np.float32)
    chosen, room = rng.permutation(60)[:count], rng.standard_normal((6, count))
    room[WEIGHT] = rng.random(count) < 0.8
    for profile, step in ((grey, difference), (np.repeat(grey[:, :1], 3, 1), np.repeat(difference[:, :1], 3, 1))):
        d, g = step[chosen].astype(float), profile[chosen].astype(float)
        room[OFF] = np.einsum("nc,nck,k->n", d, g, row) / (d**2).sum(-1)
        luma, bright = d @ LUMA, np.einsum("c,nck,k->n", LUMA, g, row)
        rest = np.einsum("nc,nck,k->n", d, g, row) - d.sum(-1) * bright
        share = 1.0 - d.sum(-1) * luma / (d**2).sum(-1)
        noise = rest / (d**2).sum(-1) - share * (room[OFF] - room[LEFT])
        used = room[WEIGHT] > 0
        expected = share[used].mean(), noise[used].sum(), (noise[used] ** 2).sum(), (room[LEFT, used] ** 2).sum()
        scale = np.abs(room[OFF]).max()
        np.testing.assert_allclose(chroma_noise(profile, step, row, room, chosen, count), expected, rtol=1e-4, atol=1e-4 * scale)
    assert chroma_noise(grey[:, :1].copy(), difference[:, :1].copy(), row, room, chosen, count)[:3] == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("width", [1, 12])
def test_places_of_chroma_are_alike_as_far_as_luma_shows(width: int) -> None:
    """Places of 400 arcs: sums over `width` px of white noise, whose mean has that many times the variance; arcs that chroma
    alone tells have all of that, those without chroma nothing."""
    rng = np.random.default_rng(5)
    length, share = 240, 0.3
    white = rng.standard_normal((400, length + width - 1))
    chroma = np.stack([white[:, k : k + width].sum(-1) for k in range(length)], -1)
    # The circle goes after chroma by its share.
    noise = share * (chroma - share * chroma.mean(-1, keepdims=True))
    told = ToldChroma().with_more(
        ChromaNoise(np.full(400, share), noise.sum(-1), (noise**2).sum(-1), (noise**2).sum(-1) + 0.01 * length)
    )
    mere = ChromaNoise(np.array([1.0, 0.0]), np.zeros(2), np.array([5.0, 0.0]), np.array([5.0, 5.0]))
    found = correlations(mere, told, 1.0)
    # Of the mean of a finite piece.
    expected = length * chroma.mean(-1).var() / (chroma**2).mean()
    assert found[1] == 1.0
    assert abs(found[0] / max(expected, 1.0) - 1.0) < 0.25
    none = ChromaNoise(*np.zeros((4, 2)))
    np.testing.assert_array_equal(correlations(none, ToldChroma().with_more(none), 2.3), 2.3)


def test_residuals_that_are_alike_over_some_pixels() -> None:
    """Sums over 3 px of white noise: the correlations are 2/3 and 1/3."""
    white = np.random.default_rng(2).standard_normal(100_002)
    noise = white[:-2] + white[1:-1] + white[2:]
    products = np.array([[(noise[: len(noise) - lag] * noise[lag:]).sum(), len(noise) - lag] for lag in range(9)])
    assert abs(correlation(products) - 3.0) < 0.1
