"""Closed-form start of a calibration from planar boards: no guess of focal length, centre or pose.

1. The centre from the radial epipole of every view (R. Hartley, S. B. Kang, Parameter-free radial distortion correction with
   center of distortion estimation, PAMI 2007): a pixel, the centre and the homography image of its board point are collinear,
   u' F X = 0 with F = [e]x H.
2. With p = u - centre, p x (R X + t)_xy = 0 is linear in the first two rows of [r1 r2 t]; orthonormal columns give the third row
   of r1, r2 up to a sign and the scale. That p and (R X + t)_xy lie on the same half-line from the axis fixes the overall sign
   and needs no z > 0 (D. Scaramuzza et al., ICVS 2006; R. Y. Tsai 1987).
3. f(rho) s = rho z is linear in the polynomial f and the depth of every board; the sign of every view maximises the quadratic
   form of that least-squares problem.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.pose import Pose
from camera_models.repeatable import least_squares
from omnilines.least_squares import Cells

RADIAL_ORDERS = ((0, 2, 3, 4), (0, 2, 4), (0, 2), (0,))
"""Powers of rho tried for f, richest first; the first curve that grows over the data is taken."""


@dataclass(frozen=True, eq=False)
class BoardPoints:
    """Corners of planar boards as tensors: view of each row, position on the board (metres), pixel."""

    view: Int[Tensor, " n"]
    views: int
    board: Float[Tensor, "n 3"]
    pixels: Float[Tensor, "n 2"]

    @cached_property
    def cells(self) -> Cells:
        """The corners of every view."""
        return Cells(self.view, self.views)

    @cached_property
    def counts(self) -> Int[Tensor, " v"]:
        """Corners of every view."""
        return torch.bincount(self.view, minlength=self.views)

    def chosen(self, rows: Bool[Tensor, " n"]) -> "BoardPoints":
        """The chosen corners; views keep their numbers, also those without a corner left."""
        return BoardPoints(self.view[rows], self.views, self.board[rows], self.pixels[rows])

    def of_views(self, views: list[int]) -> "BoardPoints":
        """The corners of the chosen views, which are renumbered in the order given."""
        place = torch.full((self.views,), -1)
        place[views] = torch.arange(len(views))
        rows = place[self.view] >= 0
        return BoardPoints(place[self.view[rows]], len(views), self.board[rows], self.pixels[rows])

    def sum_by_view(self, values: Float[Tensor, "n *shape"]) -> Float[Tensor, "v *shape"]:
        """Sum of per-corner values over each view."""
        return values.new_zeros(self.views, *values.shape[1:]).index_add_(0, self.view, values)

    def mean_by_view(self, values: Float[Tensor, "n *shape"]) -> Float[Tensor, "v *shape"]:
        """Mean of per-corner values over each view."""
        counts = self.counts.clamp_min(1).to(values.dtype)
        return self.sum_by_view(values) / counts.view(-1, *([1] * (values.ndim - 1)))


@dataclass(frozen=True)
class RadialStart:
    """A radial curve sampled over the data, and the board poses that go with it."""

    centre: Float[Tensor, "2"]
    rho_px: Float[Tensor, " k"]
    theta: Float[Tensor, " k"]
    cam_from_board: Pose


def _null_vectors(rows: Tensor, points: BoardPoints) -> tuple[Tensor, Tensor]:
    """Right singular vector of the smallest singular value of every view's rows, and all singular values (ascending)."""
    values, vectors = torch.linalg.eigh(points.cells.gram(rows[:, None, :]))
    return vectors[..., 0], values.clamp_min(0).sqrt()


def _normalised(coordinates: Tensor, points: BoardPoints) -> tuple[Tensor, Tensor, Tensor]:
    """Homogeneous 2D coordinates with zero mean and unit spread in every view; the mean and the spread."""
    mean = points.mean_by_view(coordinates)
    centred = coordinates - mean[points.view]
    spread = points.mean_by_view((centred**2).sum(-1)).sqrt().clamp_min(1e-300)
    scaled = centred / spread[points.view, None]
    return torch.cat([scaled, torch.ones_like(scaled[:, :1])], -1), mean, spread


def radial_centres(points: BoardPoints) -> tuple[Float[Tensor, "v 2"], Float[Tensor, " v"]]:
    """Radial epipole of every view (px), and how well the view determines it: the ratio of its two smallest singular values."""
    u, mean, spread = _normalised(points.pixels, points)
    x, _, _ = _normalised(points.board[:, :2], points)
    flat, values = _null_vectors((u[:, :, None] * x[:, None, :]).flatten(1), points)
    _, _, right = torch.linalg.svd(flat.view(-1, 3, 3).mT)
    epipole = right[:, -1]
    finite = epipole[:, 2].abs() > 1e-6
    centre = mean + spread[:, None] * epipole[:, :2] / torch.where(finite, epipole[:, 2], torch.ones_like(epipole[:, 2]))[:, None]
    certainty = values[:, 1] / values[:, 0].clamp_min(1e-12 * values[:, -1].clamp_min(1e-300))
    enough = points.counts >= 9
    return centre, torch.where(finite & enough, certainty, torch.zeros_like(certainty))


def weighted_median(values: Float[Tensor, "n d"], weights: Float[Tensor, " n"]) -> Float[Tensor, " d"]:
    """Weighted median of every column."""
    order = torch.argsort(values, dim=0)
    cumulative = torch.cumsum(weights[order], 0)
    at = (cumulative < 0.5 * cumulative[-1]).sum(0, keepdim=True)
    return torch.gather(torch.gather(values, 0, order), 0, at)[0]


def centre_candidates(points: BoardPoints, image_size: tuple[int, int]) -> list[Tensor]:
    """The weighted median of the radial epipoles that fall inside the image, and the image centre."""
    middle = torch.tensor([(image_size[0] - 1) / 2, (image_size[1] - 1) / 2], dtype=torch.float64)
    centres, certainty = radial_centres(points)
    # A centre farther than a quarter of the image from the middle is a badly determined epipole, not a lens.
    usable = (certainty > 1.5) & ((centres - middle).abs() < torch.tensor(image_size) / 4).all(-1)
    if int(usable.sum()) < 2:
        return [middle]
    return [weighted_median(centres[usable], certainty[usable] - 1), middle]


def _upper_rows(points: BoardPoints, centre: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(r1, r2, t) with r1, r2 (v, 3) orthonormal, the third row up to a sign per view and t_xy (v, 2)."""
    p = points.pixels - centre
    p = p / p.norm(dim=-1).median().clamp_min(1e-300)
    scale = points.board[:, :2].abs().max().clamp_min(1e-300)
    x = points.board[:, :2] / scale
    one = torch.ones_like(x[:, :1])
    plane = torch.cat([x, one], -1)
    h, _ = _null_vectors(torch.cat([-p[:, 1:] * plane, p[:, :1] * plane], -1), points)
    rows = h.view(-1, 2, 3)
    rows = torch.cat([rows[..., :2] / scale, rows[..., 2:]], -1)
    seen = (rows[points.view] @ torch.cat([points.board[:, :2], one], -1)[..., None])[..., 0]
    side = torch.sign(points.sum_by_view(torch.sign((seen * p).sum(-1))))
    rows = rows * torch.where(side == 0, torch.ones_like(side), side)[:, None, None]
    a, b = (rows[..., 0] ** 2).sum(-1), (rows[..., 1] ** 2).sum(-1)
    c = (rows[..., 0] * rows[..., 1]).sum(-1)
    # r31^2 = s, r32^2 = s + a - b, r31 r32 = -c.
    s = 0.5 * ((b - a) + torch.sqrt((a - b) ** 2 + 4 * c * c))
    r31 = s.clamp_min(0).sqrt()
    r32 = torch.where(c <= 0, 1.0, -1.0) * (s + a - b).clamp_min(0).sqrt()
    size = (a + s).clamp_min(1e-300).rsqrt()[:, None]
    r1 = torch.cat([rows[..., 0], r31[:, None]], -1) * size
    r2 = torch.cat([rows[..., 1], r32[:, None]], -1) * size
    return r1, r2, rows[..., 2] * size


def _best_signs(gains: Float[Tensor, "v m"], matrix: Float[Tensor, "m m"]) -> Float[Tensor, " v"]:
    """Signs that maximise (sum s_i b_i)' M^-1 (sum s_i b_i): leading eigenvector, then single flips while they help."""
    values, vectors = torch.linalg.eigh(matrix)
    sound = values > 1e-14 * values[-1]
    # The quadratic form is G G' of rank m, never formed: it would be views x views.
    g = gains @ vectors[:, sound] * values[sound].rsqrt()
    signs = torch.sign(g @ torch.linalg.eigh(g.mT @ g)[1][:, -1])
    signs = torch.where(signs == 0, torch.ones_like(signs), signs)
    own = (g * g).sum(-1)
    for _ in range(10 * len(signs)):
        gain = own - signs * (g @ (g.mT @ signs))
        best = int(torch.argmax(gain))
        if float(gain[best]) <= 1e-12 * float(own.max()):
            break
        signs[best] = -signs[best]
    return signs


def radial_start(points: BoardPoints, centre: Float[Tensor, "2"]) -> RadialStart | None:
    """Curve and poses for a given centre; None when no curve that grows over the data fits (a wrong centre or bad views)."""
    r1, r2, t = _upper_rows(points, centre)
    rotation = torch.stack([r1, r2], -1)[points.view]
    turned = (rotation @ points.board[:, :2, None])[..., 0]
    planar = turned[:, :2] + t[points.view]
    s = planar.norm(dim=-1)
    rho = (points.pixels - centre).norm(dim=-1)
    top = rho.max()
    r = rho / top
    # Boards at every distance count alike.
    even = points.mean_by_view(s).clamp_min(1e-300)[points.view]
    depth = (r / even)[:, None]

    def without_depth(columns: Tensor) -> Tensor:
        share = points.sum_by_view(columns * depth) / points.sum_by_view(depth**2).clamp_min(1e-300)
        return columns - share[points.view] * depth

    tilt = without_depth((r * turned[:, 2] / even)[:, None])
    curve_r = torch.linspace(float(r.min()), 1.0, 100, dtype=r.dtype)
    for orders in RADIAL_ORDERS:
        powers = torch.tensor(orders, dtype=r.dtype)
        columns = without_depth(r[:, None] ** powers * (s / even)[:, None])
        gains = points.sum_by_view(columns * tilt)
        matrix = columns.mT @ columns
        signs = _best_signs(gains, matrix)
        a = least_squares(columns, signs[points.view, None] * tilt)[:, 0]
        flip = 1.0 if float(a.sum() if orders == (0,) else (curve_r[:1, None] ** powers @ a)[0]) > 0 else -1.0
        a, signs = a * flip, signs * flip
        theta = torch.atan2(curve_r, curve_r[:, None] ** powers @ a)
        if bool((torch.diff(theta) > 0).all()):
            break
    else:
        return None
    height = (r[:, None] ** powers @ a) * s / even
    tz = points.sum_by_view(depth * (height - r * signs[points.view] * turned[:, 2] / even)[:, None])[:, 0]
    tz = tz / points.sum_by_view(depth**2)[:, 0].clamp_min(1e-300)
    lift = torch.stack([torch.ones_like(signs), torch.ones_like(signs), signs], -1)
    poses = _proper(torch.stack([r1 * lift, r2 * lift], -1), torch.cat([t, tz[:, None]], -1))
    return RadialStart(centre, curve_r * top, theta, poses)


def equidistant_start(
    points: BoardPoints, centre: Float[Tensor, "2"], half_angle: float, reach_px: float
) -> tuple[Tensor, Tensor]:
    """Samples (rho, theta) of the equidistant lens that sees `half_angle` (rad) at `reach_px`, for where rays do not decide."""
    rho = torch.linspace(0.0, float((points.pixels - centre).norm(dim=-1).max()), 100, dtype=torch.float64)[1:]
    return rho, rho * half_angle / reach_px


def _proper(columns: Float[Tensor, "v 3 2"], translation: Float[Tensor, "v 3"]) -> Pose:
    """The poses whose first two rotation columns are nearest to the given ones."""
    u, _, vt = torch.linalg.svd(columns, full_matrices=False)
    first = u @ vt
    third = torch.linalg.cross(first[..., 0], first[..., 1], dim=-1)
    return Pose(torch.cat([first, third[..., None]], -1), translation)


def resect_boards(points: BoardPoints, bearings: Float[Tensor, "n 3"]) -> Pose:
    """`cam_from_board` of every view from bearings: b x (x r1 + y r2 + t) = 0, linear, any angle off axis."""
    x = points.board[:, :2]
    centre = points.mean_by_view(x)
    spread = points.mean_by_view(((x - centre[points.view]) ** 2).sum(-1)).sqrt().clamp_min(1e-300)
    local = (x - centre[points.view]) / spread[points.view, None]
    plane = torch.cat([local, torch.ones_like(local[:, :1])], -1)
    b = bearings
    zero = torch.zeros_like(b[:, 0])
    cross = torch.stack(
        [
            torch.stack([zero, -b[:, 2], b[:, 1]], -1),
            torch.stack([b[:, 2], zero, -b[:, 0]], -1),
            torch.stack([-b[:, 1], b[:, 0], zero], -1),
        ],
        -2,
    )
    rows = (cross[:, :, :, None] * plane[:, None, None, :]).flatten(2)
    h = torch.linalg.eigh(points.cells.gram(rows))[1][..., 0].view(-1, 3, 3)
    ahead = ((h[points.view] @ plane[..., None])[..., 0] * b).sum(-1)
    side = torch.sign(points.sum_by_view(torch.sign(ahead)))
    h = h * torch.where(side == 0, torch.ones_like(side), side)[:, None, None]
    size = 0.5 * (h[..., 0].norm(dim=-1) + h[..., 1].norm(dim=-1)).clamp_min(1e-300)
    pose = _proper(h[..., :2], h[..., 2] * (spread / size)[:, None])
    offset = torch.cat([centre, torch.zeros_like(centre[:, :1])], -1)
    return Pose(pose.rotation, pose.translation - (pose.rotation @ offset[..., None])[..., 0])
