"""The compiled parts of extraction against plain forms: edge points, chains, circles, crossings, hidden steps, first light."""

import itertools
import math

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.special import ndtr

from camera_models import OpenCVFisheye, Pinhole
from omnilines.extraction.blocks import OFFSETS_PX, window_weights
from omnilines.extraction.edgels import find_points, numbered, seen_chains
from omnilines.extraction.hidden_edges import CANDIDATES_PX
from omnilines.extraction.kernels.chain import LEAST_COSINE_ALONG, REACH, chains, circles, links
from omnilines.extraction.kernels.crossing import crossings
from omnilines.extraction.kernels.edgel import gradient_products, ridge_points, strengths
from omnilines.extraction.kernels.hidden import one_more_step
from omnilines.extraction.kernels.rim import LEAST_LIGHT, WINDOW, Rays, first_light
from omnilines.extraction.kernels.step_algebra import MOST_STEPS
from omnilines.extraction.kernels.tables import Crossed, Edgels, SeenChains, Stepped, Window
from omnilines.extraction.options import ExtractionOptions

OPTIONS = ExtractionOptions()
FISHEYE = OpenCVFisheye.from_mapping(
    {"fx": 100.0, "fy": 101.0, "cx": 161.2, "cy": 118.7, "k1": -0.02, "k2": 0.004, "k3": 0.0, "k4": 0.0}, (320, 240)
)
PINHOLE = Pinhole.from_mapping({"fx": 260.0, "fy": 260.0, "cx": 159.3, "cy": 119.6}, (320, 240))


def drawn(seed: int = 4, noise: float = 2.0) -> np.ndarray:
    """A photo of quadrangles on each other."""
    image = np.full((240, 320, 3), 120, dtype=np.uint8)
    rng = np.random.default_rng(seed)
    for _ in range(25):
        corners = cv2.boxPoints((rng.uniform([20, 20], [300, 220]).tolist(), rng.uniform(20, 90, 2).tolist(), rng.uniform(0, 90)))
        cv2.fillPoly(image, [corners.astype(np.int32)], rng.uniform(30, 220, 3).tolist(), cv2.LINE_AA)
    noisy = cv2.GaussianBlur(image, (0, 0), 0.6) + noise * rng.standard_normal(image.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def photo_tensor(image: np.ndarray) -> np.ndarray:
    """Sums over channels of the products of derivatives (3, h, w), by the kernel."""
    return gradient_products(image, False, 0, len(image), np.ones(1, dtype=np.float32))


@pytest.mark.parametrize("closed", [False, True])
def test_products_of_derivatives_are_those_of_opencv(closed: bool) -> None:
    """Gaussian and Scharr's masks; all rows, and some of them; an image that is smaller than the Gaussian."""
    weight = cv2.getGaussianKernel(7, 0.6, cv2.CV_32F)[:, 0]
    for image in (drawn(), drawn()[:3, :4].copy()):
        height, width = image.shape[:2]
        side = 12 if closed else 0
        wide = cv2.copyMakeBorder(image, 0, 0, side, side, cv2.BORDER_WRAP).astype(np.float32)
        plain = np.zeros((3, height, width))
        for channel in np.moveaxis(wide, -1, 0):
            smooth = cv2.sepFilter2D(channel, cv2.CV_32F, weight, weight, borderType=cv2.BORDER_REFLECT_101)
            by_u, by_v = (
                cv2.Scharr(smooth, cv2.CV_32F, *order, scale=1 / 32, borderType=cv2.BORDER_REFLECT_101)[:, side : side + width]
                for order in ((1, 0), (0, 1))
            )
            plain += np.stack([by_u * by_u, by_u * by_v, by_v * by_v])
        found = gradient_products(image, closed, 0, height, weight)
        np.testing.assert_allclose(found, plain, rtol=1e-4, atol=1e-2)
        np.testing.assert_array_equal(gradient_products(image, closed, 1, height - 1, weight), found[:, 1:-1])


@pytest.mark.parametrize("source", ["photo", "random"])
def test_edge_points_are_the_tops_of_parabolas_across_edges(source: str) -> None:
    """Strengths and directions by NumPy's eigenvectors, values beside a pixel by SciPy's interpolation."""
    rng = np.random.default_rng(2)
    image = drawn() if source == "photo" else np.clip(rng.normal(120.0, 40.0, (120, 160, 3)), 0, 255).astype(np.uint8)
    tensor = photo_tensor(image)
    uu, uv, vv = tensor.astype(np.float64)
    values, vectors = np.linalg.eigh(np.stack([np.stack([uu, uv], -1), np.stack([uv, vv], -1)], -2))
    strength = np.empty(image.shape[:2], dtype=np.float32)
    strengths(tensor, strength)
    np.testing.assert_allclose(strength, np.sqrt(values[..., 1]), rtol=1e-4, atol=1e-3)
    allowed = rng.random(strength.shape) < 0.9
    threshold, first, last = 4.0, 10, 100
    cells, points = ridge_points(strength, tensor, allowed, threshold, first, last)
    rows, columns = np.nonzero(allowed & (strength >= threshold))
    keep = (rows >= first) & (rows < last) & (columns >= 2) & (columns < strength.shape[1] - 2)
    rows, columns = rows[keep], columns[keep]
    way = vectors[rows, columns, :, 1]
    here = strength[rows, columns].astype(np.float64)
    before, after = (
        map_coordinates(strength.astype(np.float64), [rows + s * way[:, 1], columns + s * way[:, 0]], order=1) for s in (-1, 1)
    )
    # Which of both directions is meant decides between equal neighbours only.
    tops = (here > before) & (here > after)
    shift = 0.5 * (after - before) / (2.0 * here - before - after)
    unsure = np.abs(here - np.maximum(before, after)) < 1e-3
    expected = {(int(i), int(j)): n for n, (i, j) in enumerate(zip(rows, columns, strict=True)) if tops[n]}
    doubtful = {(int(i), int(j)) for i, j in zip(rows[unsure], columns[unsure], strict=True)}
    found = {(int(i), int(j)): k for k, (i, j) in enumerate(cells)}
    assert len(expected) > 500 and len(doubtful) < 0.02 * len(expected)
    assert found.keys() ^ expected.keys() <= doubtful
    both = sorted((found.keys() & expected.keys()) - doubtful)
    k, n = np.array([found[cell] for cell in both]), np.array([expected[cell] for cell in both])
    place = np.stack([columns, rows], -1)[n] + shift[n, None] * way[n]
    steady = np.abs(values[rows, columns, 1] - values[rows, columns, 0])[n] > 0.05 * values[rows, columns, 1][n]
    np.testing.assert_allclose(points[k, :2][steady], place[steady], atol=5e-3)
    np.testing.assert_allclose(np.abs((points[k, 2:] * way[n]).sum(-1))[steady], 1.0, atol=1e-4)


def some_points(source: str, closed: bool) -> tuple[Edgels, np.ndarray]:
    """Edge points of a photo, or at random pixels with directions that change slowly; and their pixels."""
    if source == "photo":
        image = drawn()
        cells, points = find_points(image, closed, np.ones(image.shape[:2], dtype=bool), 2.0, OPTIONS.edges)
        return numbered((320, 240), closed, cells, points), cells
    rng = np.random.default_rng(5)
    cells = np.stack(np.nonzero(rng.random((60, 90)) < 0.2), -1).astype(np.int32)
    turn = cells @ np.array([0.05, 0.08]) + 0.3 * rng.standard_normal(len(cells))
    place = cells[:, ::-1] + rng.uniform(-0.5, 0.5, cells.shape)
    points = np.concatenate([place, np.stack([np.cos(turn), np.sin(turn)], -1)], -1).astype(np.float32)
    return numbered((90, 60), closed, cells, points), cells


def plain_links(edgels: Edgels, cells: np.ndarray) -> np.ndarray:
    """From all pairs: the neighbour of least cost on either side; those that are mutual stay."""
    points, width = edgels.points.astype(np.float64), edgels.number.shape[1]
    best = np.full((len(cells), 2), -1)
    for k in range(len(cells)):
        across_cells = cells[:, 1] - cells[k, 1]
        turns = np.round(across_cells / width) if edgels.closed else np.zeros(len(cells))
        near = (np.abs(cells[:, 0] - cells[k, 0]) <= REACH) & (np.abs(across_cells - turns * width) <= REACH)
        near[k] = False
        apart = points[:, :2] - points[k, :2] - turns[:, None] * np.array([width, 0.0])
        x, y = points[k, 2:]
        along, across = x * apart[:, 1] - y * apart[:, 0], np.abs(apart @ points[k, 2:])
        near &= np.abs(points[:, 2:] @ points[k, 2:]) >= OPTIONS.chains.min_cosine
        near &= (np.abs(along) >= 0.3) & (across <= 0.75 * np.abs(along))
        for side, there in enumerate((near & (along <= 0), near & (along > 0))):
            if there.any():
                best[k, side] = np.where(there, np.abs(along) + 2.0 * across, np.inf).argmin()
    mutual = (best[best] == np.arange(len(cells))[:, None, None]).any(-1) & (best >= 0)
    return np.where(mutual, best, -1)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("source", ["photo", "random"])
def test_chains_are_the_paths_of_mutual_nearest_neighbours(source: str, closed: bool) -> None:
    edgels, cells = some_points(source, closed)
    found = links(edgels, cells, OPTIONS.chains.min_cosine)
    expected = plain_links(edgels, cells)
    assert (expected >= 0).sum() > 500
    # Single precision decides between costs that are nearly equal.
    assert (found != expected).any(-1).mean() < 2e-3
    order, starts = chains(found)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(cells)))
    row, side = np.nonzero(found >= 0)
    graph = csr_matrix((np.ones(len(row)), (row, found[row, side])), shape=(len(cells), len(cells)))
    count, label = connected_components(graph, directed=False)
    assert count == len(starts) - 1
    inside = np.setdiff1d(np.arange(1, len(order)), starts)
    assert (found[order[inside]] == order[inside - 1][:, None]).any(-1).all()
    np.testing.assert_array_equal(label[order[inside]], label[order[inside - 1]])
    ends = (found[order[starts[:-1]]] < 0).any(-1)
    closed_curve = np.array([(found[order[a:b]] >= 0).all() for a, b in itertools.pairwise(starts)])
    assert (ends | closed_curve).all()


def plain_circles(seen: SeenChains) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The same greedy growth, with each circle from NumPy's least squares of all points so far."""
    chain, within = OPTIONS.chains, OPTIONS.support.within_px

    def fitted(rows: list[int], first: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Normal + a e1 + b e2 by least squares, e1 the first bearing."""
        basis = np.stack([first, np.cross(normal, first)], -1)
        weight = 1.0 / np.linalg.norm(seen.acrosses[rows], axis=-1)
        rays = seen.bearings[rows] * weight[:, None]
        change = np.linalg.lstsq(rays @ basis, -rays @ normal, rcond=None)[0]
        result = normal + basis @ change
        return result / np.linalg.norm(result)

    def off(row: int, normal: np.ndarray) -> float:
        by_px = seen.acrosses[row] @ normal
        if 4.0 * by_px**2 < (seen.acrosses[row] ** 2).sum():
            return math.inf
        return float(abs(seen.bearings[row] @ normal / by_px))

    found = []
    for begin, stop in itertools.pairwise(seen.starts):
        while begin + chain.min_points <= stop:
            rows = list(range(begin, begin + chain.min_points))
            first = seen.bearings[begin]
            start = np.cross(first, seen.bearings[rows[-1]])
            start /= np.linalg.norm(start)
            normal = fitted(rows, first, start)
            if max(off(row, normal) for row in rows) > 0.8 * within:
                begin += 1
                continue
            missed = 0
            for row in range(rows[-1] + 1, stop):
                if first @ seen.bearings[row] < LEAST_COSINE_ALONG or missed > chain.max_missed:
                    break
                if off(row, normal) <= within:
                    rows.append(row)
                    normal, missed = fitted(rows, first, start), 0
                else:
                    missed += 1
            every = slice(begin, rows[-1] + 1)
            rays = seen.bearings[every] / (chain.sigma_px * np.linalg.norm(seen.acrosses[every], axis=-1))[:, None]
            found.append((normal, np.stack([first, seen.bearings[rows[-1]]]), rays.T @ rays))
            begin = rows[-1] + 1
    return found


@pytest.mark.parametrize("source", ["photo", "random"])
def test_circles_along_chains_are_those_of_least_squares(source: str) -> None:
    if source == "photo":
        edgels, cells = some_points("photo", False)
        seen = seen_chains(FISHEYE, edgels.points, *chains(links(edgels, cells, OPTIONS.chains.min_cosine)), 9)
    else:
        # Two edges each, at an angle, with noise of 0.15 px, and a gap of places 3 px off.
        rng = np.random.default_rng(8)
        u = np.tile(np.arange(60.0), 40)
        bend = np.repeat(rng.uniform(0.2, 1.0, 40), 60)
        v = 120.0 + np.where(u > 30.0, bend * (u - 30.0), 0.0) + 0.15 * rng.standard_normal(2400)
        v[(u > 10) & (u < 13)] += 3.0
        u += np.repeat(rng.uniform(20.0, 200.0, 40), 60)
        rays, _ = PINHOLE.unproject(np.stack([u, v], -1))
        after, _ = PINHOLE.unproject(np.stack([u, v + 1.0], -1))
        seen = SeenChains(np.arange(0, 2401, 60), rays, after - rays)
    normals, ends, information = circles(seen, OPTIONS.support.within_px, OPTIONS.chains)
    expected = plain_circles(seen)
    assert len(expected) == len(normals) > 60
    for k, (normal, end, information_k) in enumerate(expected):
        np.testing.assert_allclose(normals[k], normal, atol=1e-9)
        np.testing.assert_array_equal(ends[k], end)
        np.testing.assert_allclose(information[k], information_k, rtol=1e-9, atol=1e-9 * np.abs(information_k).max())


@pytest.mark.parametrize("closed", [False, True])
def test_profiles_are_crossed_where_a_search_over_all_points_says(closed: bool) -> None:
    """Straight curves in an image, many of them nearly parallel: by arc the point nearest along, carried on to the profile."""
    rng = np.random.default_rng(9)
    width, height, arcs = 157, 120, 60
    turn = 0.15 * rng.standard_normal(arcs) + 0.4
    along = np.stack([np.cos(turn), np.sin(turn)], -1)
    begin = rng.uniform([0.0, 0.0], [width - 1.0, height - 1.0], (arcs, 2))
    owner = np.repeat(np.arange(arcs), 25)
    pixel = begin[owner] + np.tile(1.8 * np.arange(25.0), arcs)[:, None] * along[owner]
    if closed:
        pixel[:, 0] = np.mod(pixel[:, 0] + 0.5, width) - 0.5
    across = np.stack([-along[:, 1], along[:, 0]], -1)[owner]
    own = rng.permutation(len(owner))[:300]
    place, count = crossings(
        Crossed(owner[own], pixel[own], across[own]), Crossed(owner, pixel, across), (width, height), closed, 6.0, 0.95
    )
    crowded = 0
    for n, k in enumerate(own):
        apart = pixel - pixel[k]
        if closed:
            apart[:, 0] -= width * np.round(apart[:, 0] / width)
        x, y = across[k]
        beside, ahead, cosine = apart @ across[k], apart @ np.array([-y, x]), across @ across[k]
        offset = beside + ahead * (across @ np.array([-y, x])) / cosine
        rows = np.flatnonzero((owner != owner[k]) & (np.abs(ahead) <= 1.0) & (np.abs(cosine) >= 0.95) & (np.abs(offset) <= 6.0))
        visible = (pixel[rows] >= 0).all(-1) if not closed else (pixel[rows, 1] >= 0)
        rows = rows[visible & (pixel[rows, 1] < height + 8)]
        nearest = {owner[row]: offset[row] for row in rows[np.argsort(-np.abs(ahead[rows]))]}
        expected = sorted(nearest.values(), key=abs)[: MOST_STEPS - 1]
        assert count[n] == 1 + len(expected)
        np.testing.assert_allclose(place[n, : count[n]], [0.0, *expected], atol=1e-9)
        crowded += len(expected) > 2
    assert crowded > 30


@pytest.mark.parametrize("twice", [False, True])
def test_one_more_step_explains_what_least_squares_say(twice: bool) -> None:
    """Arcs of several profiles in three channels, with steps known and one that is not; also with two known ones in one place."""
    rng = np.random.default_rng(10)
    starts, blur = np.array([0, 6, 6, 14, 20]), 0.7
    count = rng.integers(1, 4, 20)
    place = np.zeros((20, MOST_STEPS))
    place[:, 1:3] = rng.uniform([[1.2, -2.9]], [[2.9, -1.2]], (20, 2))
    if twice:
        place[:, 2] = place[:, 1]
    steps = ndtr((OFFSETS_PX[None, :, None] - place[:, None, :3]) / blur) * (np.arange(3) < count[:, None])[:, None]
    profile = 90.0 + np.einsum("nks,nsc->nck", steps, rng.uniform(-60.0, 60.0, (20, 3, 3)))
    profile += 15.0 * ndtr((OFFSETS_PX - 3.7) / blur) + rng.standard_normal((20, 3, len(OFFSETS_PX)))
    profile, whole = np.ascontiguousarray(profile, np.float32), rng.random(20) < 0.8
    weight = window_weights(2.0)
    window = Window(0, OFFSETS_PX, weight)
    gain, height, left = one_more_step(Stepped(profile, place, count), starts, whole, window, blur, CANDIDATES_PX, 0.7)
    for arc in range(4):
        rows = [n for n in range(starts[arc], starts[arc + 1]) if whole[n]]
        rests, gains, heights, taken = 0.0, np.zeros(17), np.zeros(17), np.zeros(17)
        for n in rows:
            a = (OFFSETS_PX - place[n, : count[n], None]) / blur
            design = np.concatenate([np.ones((1, len(OFFSETS_PX))), ndtr(a) - 0.5, np.exp(-0.5 * a**2)]).T * weight[:, None]
            project = np.eye(len(OFFSETS_PX)) - design @ np.linalg.pinv(design, rcond=1e-7)
            rest = (profile[n] * weight) @ project.T
            rests += (rest**2).sum()
            for d, candidate in enumerate(CANDIDATES_PX):
                if np.abs(place[n, : count[n]] - candidate).min() < 0.7:
                    continue
                step = project @ (weight * (ndtr((OFFSETS_PX - candidate) / blur) - 0.5))
                taken[d] += 1
                gains[d] += ((rest @ step) ** 2).sum() / (step @ step)
                heights[d] += (((rest @ step) / (step @ step)) ** 2).sum()
        known = (2 * taken >= len(rows)) & (len(rows) > 0)
        np.testing.assert_allclose(left[arc], rests, rtol=1e-6)
        np.testing.assert_allclose(gain[arc], np.where(known, gains, 0.0), rtol=1e-5, atol=1e-6 * max(rests, 1.0))
        np.testing.assert_allclose(height[arc], np.where(known, heights / np.maximum(taken, 1), 0.0), rtol=1e-4)
    assert (left > 0).sum() == 3 and (gain.max(-1) > 0.5 * left)[left > 0].all()


@pytest.mark.parametrize("source", ["circle", "random"])
def test_the_first_light_is_where_three_of_four_pixels_are_light(source: str) -> None:
    rng = np.random.default_rng(11)
    row, column = np.mgrid[:90, :120]
    circle = np.where(np.hypot(column - 61.0, row - 43.0) < 38.0, 150.0, 8.0)[..., None] + 4.0 * rng.standard_normal((90, 120, 3))
    image = np.clip(circle if source == "circle" else rng.uniform(0.0, 60.0, (90, 120, 3)), 0, 255).astype(np.uint8)
    turn = np.linspace(0.0, 6.2, 90)
    rays = Rays(np.array([60.3, 44.1]), np.stack([np.cos(turn), np.sin(turn)], -1), rng.uniform(38.0, 43.0, 90))
    depths, threshold = 43, 40.0
    found = first_light(image, rays, depths, threshold)
    radius = np.maximum(rays.border_px[:, None] - np.arange(depths), 0.0)
    place = np.rint(rays.centre + radius[..., None] * rays.way[:, None]).astype(int)
    light = image[place[..., 1], place[..., 0]].max(-1) > threshold
    window = np.arange(depths)[:, None] + np.arange(-(WINDOW // 2), WINDOW // 2)
    begun = light[:, window.clip(0, depths - 1)].sum(-1) >= LEAST_LIGHT
    np.testing.assert_array_equal(found, np.where(begun.any(-1), begun.argmax(-1), depths))
    assert (found < depths).sum() > 60 and (found > 2).any()
