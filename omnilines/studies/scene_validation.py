"""What `omnilines validate --scene` compares: the arcs and lines of a scene folder against the rendered truth."""

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats
import torch
from jaxtyping import Bool, Float, Int

from camera_models import Calibration, GeometryError, load
from camera_models.formats.disk import read_bytes
from camera_models.typed import typed
from omnilines.adjustment.lines import motion_across
from omnilines.evaluation.arcs import MIN_PX, ArcScores, arc_scores
from omnilines.evaluation.scene import MIN_VIEWS, THRESHOLDS_M, SceneScores, scene_scores
from omnilines.files import read_lines, read_poses, read_segments
from omnilines.geometry.line import PlueckerLines, end_radius_sigmas
from omnilines.geometry.line_chart import LineChart
from omnilines.pipelines.pages import claimed_report
from omnilines.pipelines.rendered import RenderedScene
from omnilines.pipelines.scene import Scene
from omnilines.records import Check, ImagePoses, Lines, Segments, StageCount

TOLERANCE_PX = 1.5
"""A line is right within so many pixels, as large as a pixel is at the median distance of the edges that photos show."""
INTERVAL = 0.95
SHARE_INSIDE = 0.8
"""Of the ends have to lie within their 95 percent interval; the rest is left to lines that mix two edges a few pixels apart."""
SHARE_RIGHT = 0.9
"""Of the lines that would be within the tolerance if each erred as it states have to be; the rest is left to wrong matches."""
SHARE_FOUND = 0.5
"""Of the visible length has to be found: less means that a stage fails, not that a scene is hard."""
SHARE_ON_EDGE = 0.7
"""Of the arcs have to lie on true edges, with the poses and calibration that were used."""
SHARE_OF_MEDIAN = 2.0 / 3.0
"""A photo whose arcs lie on edges less than so much as those of the median photo stands elsewhere than its pose says."""
SLACK_LIMIT_PX = 0.5
"""Poses and calibration are exact: arcs need no slack for them."""
BINOMIAL_SIGMAS = 3.0
"""A share of n lines may fall short of its limit by so many standard deviations of a count."""
OVERLAP = 0.5
"""A line belongs to an edge where one lies beside the other over this share of the shorter."""
_PAIRS = 1 << 18
"""Pairs of a line and an edge that are looked at together: bounds the memory."""


@dataclass(frozen=True)
class RebuiltScene:
    """A scene folder and what the command that wrote it says of its stages."""

    lines: Lines
    segments: Segments
    poses: ImagePoses
    cameras: Calibration
    covariance: Float[np.ndarray, "n 4 4"]
    chart_centre_m: Float[np.ndarray, "n 3"]
    chart_scale_m: Float[np.ndarray, " n"]
    stages: tuple[StageCount, ...]
    slack_px: float
    rms_px: float

    @staticmethod
    def of(scene: Scene) -> "RebuiltScene":
        """A scene that was rebuilt from photos, in memory."""
        lines, of_photos = scene.lines, scene.from_photos
        assert of_photos is not None and lines.covariance is not None
        assert lines.chart_centre_m is not None and lines.chart_scale_m is not None
        return RebuiltScene(
            lines,
            scene.segments,
            scene.poses,
            scene.cameras,
            lines.covariance,
            lines.chart_centre_m,
            lines.chart_scale_m,
            scene.stages,
            of_photos.tolerance_px,
            scene.adjusted.rms_px(),
        )


def read_rebuilt(folder: Path, said: Mapping[str, Any]) -> RebuiltScene:
    """The scene folder of `reconstruct PHOTOS` as any user would read it, and its JSON."""
    with np.load(io.BytesIO(read_bytes(folder / "covariance.npz"))) as file:
        covariance, centre, scale = (file[name] for name in ("line_covariance", "line_chart_centre_m", "line_chart_scale_m"))
    return RebuiltScene(
        read_lines(folder / "lines.csv"),
        read_segments(folder / "segments.csv"),
        read_poses(folder / "poses.csv"),
        load(folder / "calibration.yaml"),
        covariance,
        centre,
        scale,
        tuple(StageCount(one["stage"], one["kept"], tuple((text, n) for text, n in one["dropped"])) for one in said["stages"]),
        said["slack_px"],
        said["rms_px"],
    )


@dataclass(frozen=True)
class SceneValidation:
    """The truth, what was rebuilt from the photo files, and the errors."""

    truth: RenderedScene
    rebuilt: RebuiltScene
    distance_m: float
    """Median distance between a photo and the edges that it shows, by their length in the photo."""
    pixel_m: float
    """Median size of a pixel there."""
    scores: SceneScores
    """At THRESHOLDS_M and, last, the tolerance; recall of edges of at least MIN_PX in a photo."""
    arcs: ArcScores
    on_edge_of_photo: Float[np.ndarray, " m"]
    """Share of the arcs of each photo that lie on a true edge, edges on one straight line counting as one."""
    in_line_of_photo: Float[np.ndarray, " m"]
    """Share of the arcs of each photo that support a line."""
    across_m: Float[np.ndarray, "n 2"]
    """Distance of both ends of every line from the straight line that its edge lies on; infinite where it belongs to none."""
    mahalanobis2: Float[np.ndarray, " n"]
    """Of every line from its edge, in the metric of its covariance: chi-square of 4 degrees of freedom; infinite likewise."""

    @property
    def holds(self) -> bool:
        """Whether every check holds."""
        return all(check.holds for check in self.checks)

    @typed
    def report(self, path: str | Path, photo_folder: str | Path | None = None, *, plots: str | Path | None = None) -> Path:
        """Write the page that shows all of it, with the photos where they are files in a folder; its path. Its figures
        are written as PNG and SVG into the folder `plots`, where one is given."""
        from omnilines.pages.scene_validation import write_scene_validation_page

        with claimed_report(path, plots):
            return write_scene_validation_page(self, path, photo_folder)

    @property
    def tolerance_m(self) -> float:
        """Within which a line is right."""
        return TOLERANCE_PX * self.pixel_m

    @property
    def own(self) -> Bool[np.ndarray, " n"]:
        """Lines that lie on an edge: within the tolerance, or twice the interval where that is wider.

        So lines count, too, whose interval is too short.
        """
        reach = np.maximum(self.tolerance_m, 2.0 * end_radius_sigmas() * self.rebuilt.lines.sigma_m)
        return self.across_m.max(-1) <= reach

    @property
    def inside_share(self) -> float:
        """Of the ends of such lines, those within the 95 percent circle of sigma_m; 0 where there is none."""
        inside = self.across_m <= end_radius_sigmas() * self.rebuilt.lines.sigma_m[:, None]
        return float(inside[self.own].mean()) if self.own.any() else 0.0

    @property
    def covariance_share(self) -> float:
        """Of such lines, those within the 95 percent ellipsoid of their covariance; 0 where there is none."""
        inside = self.mahalanobis2 <= scipy.stats.chi2.ppf(INTERVAL, 4)
        return float(inside[self.own].mean()) if self.own.any() else 0.0

    @property
    def expected_precision(self) -> float:
        """Share of the lines within the tolerance if each erred by its sigma_m in all directions across."""
        return float(-np.expm1(-0.5 * (self.tolerance_m / self.rebuilt.lines.sigma_m) ** 2).mean())

    @property
    def checks(self) -> tuple[Check, ...]:
        """What has to hold, each figure with its limit."""
        slack = self.rebuilt.slack_px
        worst, typical = float(self.on_edge_of_photo.min()), float(np.median(self.on_edge_of_photo))
        right = _count_limit(SHARE_RIGHT * self.expected_precision, self.scores.lines)
        inside = _count_limit(SHARE_INSIDE, int(self.own.sum()))
        return (
            _at_least("arcs on true edges, share", self.arcs.on_line_share, SHARE_ON_EDGE),
            _at_least("arcs on true edges in the worst photo, share", worst, SHARE_OF_MEDIAN * typical),
            Check("slack for poses and calibration, at most", slack, SLACK_LIMIT_PX, "px", slack <= SLACK_LIMIT_PX),
            _at_least("lines near true edges, share", float(self.scores.precision[-1]), right),
            _at_least("ends inside their 95 percent interval, share", self.inside_share, inside),
            _at_least("visible edges near lines, share of the length", float(self.scores.recall[-1]), SHARE_FOUND),
        )


def compare_scene(truth: RenderedScene, rebuilt: RebuiltScene) -> SceneValidation:
    """Compare a scene folder with the rendered truth, in whose frame its poses are.

    Arcs are compared with the true edges as the calibration and poses of the folder show them: errors of these move all arcs
    beside the edges. Raises GeometryError where no piece of an edge is seen by MIN_VIEWS photos.
    """
    distance, pixel = _pixel_at_edges(truth)
    lines, edges = rebuilt.lines, truth.edges.ends_m
    thresholds = (*THRESHOLDS_M, TOLERANCE_PX * pixel)
    scores = scene_scores(lines.ends_m, truth.edges, truth.stretches, thresholds, min_px=MIN_PX)
    if not scores.visible_m > 0:
        raise GeometryError(
            f"Edges of {MIN_PX:g} px or more in at least {MIN_VIEWS} photos were expected, found none; give more photos, or "
            "larger ones."
        )
    arcs = arc_scores(rebuilt.cameras["cam0"], rebuilt.poses, truth.edges, truth.stretches, rebuilt.segments)
    edge, offset = own_edges(lines.ends_m, edges)
    known = edge >= 0
    across = np.where(known[:, None], np.linalg.norm(offset, axis=-1), np.inf)
    squared = np.where(known, _mahalanobis2(rebuilt, offset), np.inf)
    images = truth.poses.images
    supports = rebuilt.segments.track >= 0
    return SceneValidation(
        truth,
        rebuilt,
        distance,
        pixel,
        scores,
        arcs,
        _by_photo(rebuilt.segments, arcs.on_line, images),
        _by_photo(rebuilt.segments, supports, images),
        across,
        squared,
    )


def own_edges(
    ends_m: Float[np.ndarray, "n 2 3"], edges_m: Float[np.ndarray, "e 2 3"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2 3"]]:
    """The edge that each line belongs to, -1 for none, and how far both its ends are from the straight line of that edge.

    Of the edges beside it (OVERLAP) it is the one whose straight line is nearest to the farther end. A line over a gap between
    two edges on one straight line belongs to either, with the same distance.
    """
    edge, offset = np.full(len(ends_m), -1), np.zeros((len(ends_m), 2, 3))
    along = edges_m[:, 1] - edges_m[:, 0]
    length = np.linalg.norm(along, axis=-1)
    axis = along / length[:, None]
    rows_at_once = max(1, _PAIRS // max(len(edges_m), 1))
    for first in range(0, len(ends_m), rows_at_once):
        part = ends_m[first : first + rows_at_once]
        step = part[:, None] - edges_m[:, None, 0]
        place = (step * axis[:, None]).sum(-1)
        away = step - place[..., None] * axis[:, None]
        span = np.clip(np.sort(place, axis=-1), 0.0, length[:, None])
        shorter = np.minimum(np.linalg.norm(part[:, 1] - part[:, 0], axis=-1)[:, None], length)
        beside = span[..., 1] - span[..., 0] >= OVERLAP * shorter
        farther = np.where(beside, np.linalg.norm(away, axis=-1).max(-1), np.inf)
        best = farther.argmin(1)
        rows = np.arange(len(part))
        edge[first + rows] = np.where(np.isfinite(farther[rows, best]), best, -1)
        offset[first + rows] = away[rows, best]
    return edge, offset


def _mahalanobis2(rebuilt: RebuiltScene, offset_m: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, " n"]:
    """Of the step in the chart of each line that moves its ends by their offsets across."""
    ends = torch.as_tensor(rebuilt.lines.ends_m)
    lines = PlueckerLines.from_points(ends[:, 0], ends[:, 1])
    chart = LineChart.from_lines(lines, torch.as_tensor(rebuilt.chart_centre_m), torch.as_tensor(rebuilt.chart_scale_m))
    across = motion_across(chart, ends).flatten(1, 2)
    step = torch.linalg.pinv(across) @ torch.as_tensor(offset_m).flatten(1)[..., None]
    covariance = torch.as_tensor(rebuilt.covariance)
    return (step.mT @ torch.linalg.solve(covariance, step)).flatten().numpy()


def _pixel_at_edges(truth: RenderedScene) -> tuple[float, float]:
    """Median distance (m) of the edges that photos show, by length in the photo, and median size (m) of a pixel there."""
    stretches = truth.stretches
    ends = truth.edges.ends_m[stretches.edge]
    middle = ends[:, 0] + stretches.t.mean(1)[:, None] * (ends[:, 1] - ends[:, 0])
    rows = {name: k for k, name in enumerate(truth.poses.images)}
    view = np.array([rows[name] for name in stretches.images], dtype=np.int64)[stretches.image]
    poses = truth.poses.cam_from_world[torch.as_tensor(view)]
    points = (poses.rotation @ torch.as_tensor(middle)[..., None])[..., 0] + poses.translation
    with torch.no_grad():
        pixels, seen = truth.camera.project(points)
        by_pixel = truth.camera.unproject_jacobian(pixels)
    # The solid angle of a pixel is the area that its two steps span on the sphere.
    angle = torch.linalg.cross(by_pixel[..., 0], by_pixel[..., 1]).norm(dim=-1).sqrt()
    distance = points.norm(dim=-1)
    usable = (seen & torch.isfinite(angle)).numpy()
    weight = stretches.length_px[usable]
    return _median(distance.numpy()[usable], weight), _median((angle * distance).numpy()[usable], weight)


def _median(values: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"]) -> float:
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def _by_photo(segments: Segments, counts: Bool[np.ndarray, " n"], images: Sequence[str]) -> Float[np.ndarray, " m"]:
    """Share of the arcs of each photo that count; 0 of a photo without arcs."""
    place = {name: k for k, name in enumerate(images)}
    photo = np.array([place[name] for name in segments.images], dtype=np.int64)[segments.image]
    return np.bincount(photo[counts], minlength=len(images)) / np.maximum(np.bincount(photo, minlength=len(images)), 1)


def _count_limit(share: float, count: int) -> float:
    """A share of which a count of that many falls short by BINOMIAL_SIGMAS only where more than chance is at work."""
    return share - BINOMIAL_SIGMAS * math.sqrt(share * (1.0 - share) / max(count, 1))


def _at_least(name: str, value: float, limit: float) -> Check:
    return Check(f"{name}, at least", value, limit, "", bool(value >= limit))
