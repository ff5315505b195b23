"""Poses from a sheet of paper, lines of the books around it (Srestasathiern 2012, table 5.2).

The dissertation's photos are not public: a rendered table stands in for them. Everything is done twice: with the sides of the
sheet and the lines as they are found in the photos, and as a hand would pick them, four corners and two ends of each line.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from camera_models import Calibration, CameraModel, GeometryError, InputError
from camera_models.pose import Pose
from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.adjustment.scene import AdjustedScene, reconstruct_lines
from omnilines.costs import COSTS
from omnilines.evaluation.arcs import arc_scores
from omnilines.files import PhotoRef
from omnilines.geometry.line import PlueckerLines
from omnilines.pipelines.arcs import extract
from omnilines.pipelines.photo_arcs import in_order, segments_of
from omnilines.pipelines.poses import estimate_poses
from omnilines.pipelines.rendered import RenderedScene
from omnilines.posing.from_corners import poses_from_corners
from omnilines.posing.rectangle import PREFIX, Rectangle
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Check, Corners, ImagePoses, Segments
from omnilines.scenes import sheet_from_world
from omnilines.scenes.books import SHEET_M
from omnilines.studies.distances import NUMBERS, DistanceFigures, figures_of
from omnilines.studies.line_errors import aligned_rms_m
from omnilines.synthetic.targets import generator
from omnilines.triangulation import TRIANGULATIONS, WEIGHTS, method_options, triangulate
from omnilines.triangulation.observations import PlaneObservations

MODEL, NARROW_DEG, VIEWS = "pinhole", 60.0, 9
"""Camera of the rendered photos, its field of view, and their number."""
SHEET = Rectangle(*SHEET_M)
FOUND, BY_HAND = "found", "by hand"
TRIANGULATION, ADJUSTMENT = "triangulation", "adjustment"
SHOWN = "sector"
"""The cost whose lines and poses are written."""
COLUMNS = (*NUMBERS[:-1], "rms_3d_m")
POSE_LIMIT, LEAST_GAIN = 2.0, 1.0
"""Errors of poses may exceed what they state by so much in RMS; adjusted lines may not fit worse than those they start from."""
LEAST_LINES = 4


@dataclass(frozen=True)
class BookOptions:
    """What a hand picks."""

    hand_px: float = 1.0
    """Standard deviation of corners and ends that are picked."""
    lines: int = 25
    """Lines at most, the longest first."""

    def __post_init__(self) -> None:
        """Refuse what determines nothing."""
        if not (self.hand_px > 0 and self.lines >= LEAST_LINES):
            raise InputError(
                f"`hand_px` above 0 and `lines` of {LEAST_LINES} or more were expected, found {self.hand_px:g} and {self.lines}; "
                "give others."
            )


@dataclass(frozen=True)
class BookSetting:
    """One way of measuring, in the world of the sheet."""

    name: str
    poses: ImagePoses
    segments: Segments
    figures: tuple[DistanceFigures, ...]
    before: AdjustedScene
    after: AdjustedScene
    pose_errors: Float[np.ndarray, "n 3"]
    """Of each photo: turn (degrees), shift of the camera (m), and both over what is stated, RMS of six."""


def rms_of_each(values: Float[np.ndarray, "n k"]) -> list[float]:
    """Root mean square of every column."""
    rms: list[float] = np.sqrt((values**2).mean(0)).tolist()
    return rms


def book_checks(rendered: RenderedScene, settings: Sequence[BookSetting]) -> tuple[Check, ...]:
    """Whether every sheet was found, poses err as they state, and the adjustment lowers the residuals."""
    posed, views = float(len(settings[0].poses)), float(len(rendered.poses))
    checks = [Check("photos whose sheet was found", posed, views, "photos", posed == views)]
    for setting in settings:
        stated = rms_of_each(setting.pose_errors)[2]
        checks.append(Check(f"error of poses over what they state, {setting.name}", stated, POSE_LIMIT, "", stated <= POSE_LIMIT))
        by_stage = {(f.stage.split(", ")[1], f.method): f.rms_px for f in setting.figures}
        gain = by_stage[ADJUSTMENT, SHOWN] / by_stage[TRIANGULATION, TRIANGULATIONS[0][0]]
        checks.append(Check(f"RMS after adjustment over before, {setting.name}", gain, LEAST_GAIN, "", gain <= LEAST_GAIN))
    return tuple(checks)


def book_study(
    rendered: RenderedScene,
    photos: Sequence[PhotoRef],
    cameras: Calibration,
    work: Path,
    options: BookOptions = BookOptions(),
    *,
    progress: ProgressCallback = silent,
) -> list[BookSetting]:
    """Find the sheet, triangulate lines that all photos show with every method, adjust with every cost: as found and by hand.

    `photos` are those of the table, `cameras` their camera, `work` the folder in which what is found in them is kept. Which arcs
    are one line is told by the truth, as a person would. Raises GeometryError where too few photos show the sheet.
    """
    if len(photos) < 2:
        raise InputError(f"2 photos or more were expected, found {len(photos)}; give more views.")
    posed, segments = _found(rendered, photos, cameras, options.lines, work, progress)
    world_from_sheet = _world_from_sheet(rendered, posed)
    hand_px, rng = options.hand_px, generator(rendered.seed, "picked by hand")
    picked = replace(
        segments,
        endpoints_px=segments.endpoints_px + hand_px * rng.standard_normal(segments.endpoints_px.shape),
        covariance_px2=None,
        sigma_px=np.full(len(segments), hand_px),
    )
    corners = _picked_corners(rendered, posed, world_from_sheet, hand_px, rng)
    of_hand = poses_from_corners(corners, cameras, dict.fromkeys(posed.images, "cam0")).poses
    settings: list[BookSetting] = []
    for name, poses, own in ((FOUND, posed, segments), (BY_HAND, of_hand, picked)):
        progress(f"lines as they are {name}", len(settings), 2)
        settings.append(_measured(name, poses, own, rendered, cameras, world_from_sheet=world_from_sheet))
    return settings


def _found(
    rendered: RenderedScene,
    photos: Sequence[PhotoRef],
    cameras: Calibration,
    lines: int,
    work: Path,
    progress: ProgressCallback,
) -> tuple[ImagePoses, Segments]:
    """Poses from the sheet, and the arcs of the longest edges that all of these photos show, a track each."""
    arcs = extract(photos, cameras, work=work, progress=progress)
    source = f"{PREFIX}{1e3 * SHEET.width_m:g}x{1e3 * SHEET.height_m:g}mm"
    poses = estimate_poses(arcs, cameras, source, seed=rendered.seed, work=work, progress=progress).poses
    segments = segments_of(in_order(arcs.photos, poses))
    scores = arc_scores(rendered.camera, rendered.poses, rendered.edges, rendered.stretches, segments)
    ends = segments.endpoints_px
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
    rows = np.flatnonzero(scores.on_edge)
    # The longest arc of each edge in each photo.
    rows = rows[np.argsort(-length[rows], kind="stable")]
    key = scores.edge[rows] * len(poses) + segments.image[rows]
    rows = rows[np.unique(key, return_index=True)[1]]
    edge = scores.edge[rows]
    seen = np.bincount(edge, minlength=len(rendered.edges))
    total = np.bincount(edge, length[rows], minlength=len(rendered.edges)) * (seen == len(poses))
    chosen = np.sort(np.argsort(-total, kind="stable")[: min(lines, int((total > 0).sum()))])
    if len(chosen) < LEAST_LINES:
        raise GeometryError(
            f"{LEAST_LINES} edges that all {len(poses)} photos show were expected, found {len(chosen)}; take another seed, a "
            "larger --size or fewer --views."
        )
    track = np.full(len(rendered.edges), -1)
    track[chosen] = np.arange(len(chosen))
    rows = rows[track[edge] >= 0]
    names = tuple(rendered.edges.names[k] for k in chosen.tolist())
    assert segments.covariance_px2 is not None
    return poses, Segments(
        segments.image[rows], segments.images, track[scores.edge[rows]], names, ends[rows],
        covariance_px2=segments.covariance_px2[rows], cameras=segments.cameras,
    )  # fmt: skip


def _true_poses(rendered: RenderedScene, poses: ImagePoses) -> Pose:
    place = {name: k for k, name in enumerate(rendered.poses.images)}
    return rendered.poses.cam_from_world[torch.tensor([place[name] for name in poses.images])]


def _world_from_sheet(rendered: RenderedScene, posed: ImagePoses) -> Pose:
    """Where the sheet lies, its ends as the poses have them."""
    true, lies = _true_poses(rendered, posed), sheet_from_world().inverse()
    ways = [lies, lies @ SHEET.half_turn]
    return min(ways, key=lambda way: float(((true @ way).centre - posed.cam_from_world.centre).norm(dim=-1).sum()))


def _picked_corners(
    rendered: RenderedScene, posed: ImagePoses, world_from_sheet: Pose, hand_px: float, rng: np.random.Generator
) -> Corners:
    """The four corners in each photo, as a hand would pick them."""
    points, count = SHEET.corners_m, len(posed)
    seen = (_true_poses(rendered, posed) @ world_from_sheet).rotation @ torch.as_tensor(points.T)
    seen = seen.mT + (_true_poses(rendered, posed) @ world_from_sheet).translation[:, None]
    pixels = rendered.camera.project(seen)[0].numpy().reshape(-1, 2)
    return Corners(
        np.repeat(np.arange(count), 4),
        posed.images,
        posed.images,
        np.tile(points, (count, 1)),
        pixels + hand_px * rng.standard_normal(pixels.shape),
        np.full(4 * count, max(hand_px, 1e-3)),
    )


def _measured(
    name: str,
    poses: ImagePoses,
    segments: Segments,
    rendered: RenderedScene,
    cameras: Mapping[str, CameraModel],
    *,
    world_from_sheet: Pose,
) -> BookSetting:
    """Every triangulation from the poses of the sheet, and every adjustment of lines and poses."""
    place = {edge: k for k, edge in enumerate(rendered.edges.names)}
    ends = torch.as_tensor(rendered.edges.ends_m[[place[edge] for edge in segments.tracks]])
    true = world_from_sheet.inverse().transform(ends)
    arcs = arcs_from_segments(segments, poses, cameras).arcs
    seen_from = poses.cam_from_world[arcs.image]
    planes = PlaneObservations.from_arcs(
        arcs.bearings,
        seen_from,
        arcs.track,
        arcs.tracks,
        arcs.by_pixel,
        covariance_px2=arcs.covariance_px2 if arcs.sigma_known else None,
    )
    methods: list[tuple[str, str, dict[str, Any]]] = [(method, method, {}) for method, _ in TRIANGULATIONS]
    methods += [(f"dual, {weights} weights", "dual", method_options("dual", weights=weights)) for weights in WEIGHTS[1:]]
    figures = []
    for label, method, options in methods:
        result = triangulate(method, planes, **options)
        distance = arcs.orthogonal_px(result.lines[arcs.track].projection_normal(seen_from)).abs().numpy()
        off = _rms_3d_m(result.lines, result.known, true)
        figures.append(figures_of(f"{name}, {TRIANGULATION}", label, int(result.known.sum()), distance, rms_3d_m=off))
    scenes = {cost: reconstruct_lines(segments, poses, cameras, cost=cost, refine_poses=True) for cost, _ in COSTS}
    for cost, scene in scenes.items():
        known = torch.as_tensor(scene.lines.known)
        points = torch.as_tensor(np.where(known.numpy()[:, None, None], scene.lines.ends_m, true.numpy()))
        off = _rms_3d_m(PlueckerLines.from_points(points[:, 0], points[:, 1]), known, true)
        figures.append(figures_of(f"{name}, {ADJUSTMENT}", cost, int(known.sum()), np.abs(scene.residual_px), rms_3d_m=off))
    before = reconstruct_lines(segments, poses, cameras)
    return BookSetting(
        name, poses, segments, tuple(figures), before, scenes[SHOWN], _pose_errors(rendered, poses, world_from_sheet)
    )


def _rms_3d_m(lines: PlueckerLines, known: torch.Tensor, true_m: Float[torch.Tensor, "t 2 3"]) -> float:
    """After the best turn and shift; the scale is the sheet's."""
    batch = PlueckerLines(lines.direction[None], lines.moment[None])
    return float(aligned_rms_m(batch, known[None], true_m, with_scale=False)[0])


def _pose_errors(rendered: RenderedScene, poses: ImagePoses, world_from_sheet: Pose) -> Float[np.ndarray, "n 3"]:
    true = _true_poses(rendered, poses) @ world_from_sheet
    off = (poses.cam_from_world @ true.inverse()).log().numpy()
    assert poses.covariance is not None
    stated = np.einsum("ni,nij,nj->n", off, np.linalg.inv(poses.covariance), off)
    shift = (poses.cam_from_world.centre - true.centre).norm(dim=-1).numpy()
    return np.stack([np.degrees(np.linalg.norm(off[:, :3], axis=-1)), shift, np.sqrt(stated / 6.0)], -1)
