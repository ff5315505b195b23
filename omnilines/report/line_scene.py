"""Sections of a line scene: what every stage kept, families of parallel lines, the lines themselves, and the photos with both."""

import os
from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from markupsafe import Markup
from torch import Tensor

from camera_models import CameraModel
from camera_models.errors import InputError
from camera_models.wording import rounded
from omnilines.geometry.line import end_radius_sigmas
from omnilines.geometry.sphere import points_on_arc
from omnilines.records import ImagePoses, Lines, PhotoCount, Polyline, Segments, StageCount
from omnilines.report.numbers import figure
from omnilines.report.page import Section
from omnilines.report.photos import drawn_photos_section
from omnilines.report.tables import table

SHOWN_LINES = 300
"""Rows of the table of lines; more are in the file."""
CURVE_POINTS, ARC_POINTS = 25, 9
"""Bearings along the image of a line, and along an observed arc."""


@runtime_checkable
class FamiliesLike(Protocol):
    """What the report shows of `omnilines.structure.families.Families`, a module beside this one that it does not import."""

    @property
    def direction(self) -> Float[np.ndarray, "k 3"]: ...
    @property
    def sigma_rad(self) -> Float[np.ndarray, " k"]: ...
    @property
    def members(self) -> Int[np.ndarray, " k"]: ...
    @property
    def spread_rad(self) -> Float[np.ndarray, " k"]: ...
    @property
    def chi_square(self) -> Float[np.ndarray, " k"]: ...
    @property
    def probability(self) -> Float[np.ndarray, " k"]: ...
    @property
    def right_angles(self) -> Int[np.ndarray, "m 2"]: ...
    @property
    def angle_rad(self) -> Float[np.ndarray, " m"]: ...
    @property
    def angle_sigma_rad(self) -> Float[np.ndarray, " m"]: ...
    @property
    def tolerance_rad(self) -> float: ...
    @property
    def considered(self) -> int: ...


def stage_section(stages: Sequence[StageCount], title: str = "Stages") -> Section:
    """What every stage kept and dropped, and why; a stage that kept nothing, the first of them, is named above the table."""
    rows = []
    for s in stages:
        reasons = "; ".join(f"{count:,} {reason}" for reason, count in s.dropped if count)
        rows.append((s.stage, f"{s.kept:,}", f"{sum(count for _, count in s.dropped):,}", reasons or "–"))
    empty = next((s for s in stages if not s.kept), None)
    said = Markup("")
    if empty is not None:
        most = max(empty.dropped, key=lambda item: item[1], default=("nothing came to it", 0))[0]
        said = Markup("<p>Nothing is left after the stage <strong>{}</strong>: {}.</p>\n").format(empty.stage, most)
    return Section(title, said + table(("Stage", "#Kept", "#Dropped", "Why"), rows))


def photo_arcs_section(photos: Sequence[PhotoCount], title: str = "Arcs of every photo") -> Section:
    """How many arcs of each photo came through each stage, the photo with the smallest share in lines first."""
    head = ("Photo", "#Arcs", "#Matched", "#Confirmed by a third", "#By enough", "#In tracks", "#In lines", "#Share in lines")
    rows = [
        (
            p.image,
            *(f"{n:,}" for n in (p.arcs, p.matched, p.confirmed, p.in_enough, p.in_tracks, p.in_lines)),
            f"{100 * p.share:.0f} %",
        )
        for p in sorted(photos, key=lambda photo: photo.share)
    ]
    text = Markup(
        "<p>Matched: an arc of another photo could show its line and looks like it. Confirmed: a third photo agrees, and as many "
        "as have to see a line. A photo that loses far more arcs than the others before they are confirmed has a wrong pose, or "
        "sees what no other does.</p>\n"
    )
    return Section(title, text + table(head, rows))


def families_section(families: FamiliesLike, title: str = "Parallel lines") -> Section:
    """The families of parallel lines with the uncertainty of their directions, and those at right angles.

    The first is family 1, as in the legend of the scene.
    """
    degrees = np.degrees
    known = int(families.members.sum())
    intro = Markup(
        "<p>{} of {} lines whose direction is known well enough belong to {} families of parallel lines. Lines may stray from "
        "their family by a tolerance of {:.3g} degrees (one standard deviation) beyond their noise; chi-square and its "
        "probability compare them without it: a probability near 0 says that they are parallel only within the tolerance.</p>\n"
    ).format(known, families.considered, len(families.members), float(degrees(families.tolerance_rad)))
    if not len(families.members):
        return Section(title, intro)
    numbers = zip(
        families.direction.tolist(),
        degrees(families.sigma_rad).tolist(),
        families.members.tolist(),
        degrees(families.spread_rad).tolist(),
        families.chi_square.tolist(),
        families.probability.tolist(),
        strict=True,
    )
    rows = [
        (
            str(k + 1),
            f"{members:,}",
            " ".join(f"{c + 0.0:.4f}" for c in direction),
            f"{sigma:.3g}",
            f"{spread:.3g}",
            f"{chi:.1f} of {2 * (members - 1)}",
            rounded(p),
        )
        for k, (direction, sigma, members, spread, chi, p) in enumerate(numbers)
    ]
    head = ("Family", "#Lines", "Direction", "#Its sigma (°)", "#RMS angle of the lines (°)", "#Chi-square", "#Probability")
    pairs = zip(families.right_angles.tolist(), degrees(families.angle_rad), degrees(families.angle_sigma_rad), strict=True)
    right = [(f"{a + 1} and {b + 1}", f"{angle:.3f}", rounded(sigma)) for (a, b), angle, sigma in pairs]
    below = (
        Markup("<h3>At right angles</h3>\n") + table(("Families", "#Angle (°)", "#Its sigma (°)"), right) if right else Markup("")
    )
    none = Markup("") if right else Markup("<p>No two families are at a right angle within their uncertainty.</p>\n")
    return Section(title, intro + table(head, rows) + below + none)


def line_table_section(lines: Lines, covariance_file: str | None = "covariance.npz", title: str = "Lines") -> Section:
    """The lines, the least certain first, with their uncertainty in short; the whole covariances are in `covariance_file`."""
    known = np.flatnonzero(lines.known)
    order = known[np.argsort(-np.nan_to_num(lines.sigma_m[known], nan=np.inf), kind="stable")]
    sigma_deg = np.degrees(_direction_sigma_rad(lines))
    length = np.linalg.norm(lines.ends_m[:, 1] - lines.ends_m[:, 0], axis=-1)
    share = lines.chance_share
    rows = [
        (
            lines.tracks[k],
            lines.status[k],
            f"{lines.views[k]:,}",
            f"{length[k]:.3f}",
            figure(1e3 * lines.sigma_m[k]),
            figure(sigma_deg[k]),
            figure(lines.rms_px[k]),
            *(() if share is None else (figure(100 * share[k], ".2g"),)),
        )
        for k in order[:SHOWN_LINES].tolist()
    ]
    text = Markup("<p>{:,} of {:,} tracks have a line, the least certain first").format(len(known), len(lines))
    text += Markup("; {:,} are shown, all are in lines.csv").format(len(rows)) if len(rows) < len(known) else Markup("")
    text += Markup(
        ". Sigma is the largest standard deviation in any one direction, across the line at its worse end and of its direction; "
        "both ends are within {:.3g} of the former with a probability of 95 percent or more"
    ).format(end_radius_sigmas(2))
    if covariance_file is not None and lines.covariance is not None:
        text += Markup('; the whole covariances are in <a href="{0}">{0}</a>').format(covariance_file)
    if share is not None:
        text += Markup(". Chance: how many of a hundred lines like it are not there, as photos that are moved a little tell")
    head = (
        "Track",
        "Status",
        "#Views",
        f"#Length ({lines.unit.sign})",
        f"#Sigma across ({lines.unit.thousandth})",
        "#Sigma of direction (°)",
        "#RMS (px)",
        *(() if share is None else ("#Chance (%)",)),
    )
    return Section(title, text + Markup(".</p>\n") + table(head, rows))


def line_photos_section(
    photo_folder: str | os.PathLike[str],
    lines: Lines,
    segments: Segments,
    poses: ImagePoses,
    cameras: Mapping[str, CameraModel],
    *,
    images: Sequence[str] | None = None,
    title: str = "Lines over the photos",
) -> Section:
    """The photos with the observed arcs as points and the images of the lines as curves (`line_curves`), as `photos_section`."""
    curves = _LineCurves(lines, segments, poses, cameras)
    return drawn_photos_section(photo_folder, curves.images if images is None else images, curves.of, title=title)


def line_curves(lines: Lines, segments: Segments, poses: ImagePoses, cameras: Mapping[str, CameraModel]) -> list[Polyline]:
    """Of each photo with a pose: every matched arc (`observed`), and each line with an arc in it as it is imaged (`model`).

    Both are images of great arcs. Curves break where the camera does not see, and where the image closes around the sphere.
    Raises InputError where a photo has no camera.
    """
    curves = _LineCurves(lines, segments, poses, cameras)
    return [curve for image in curves.images for curve in curves.of(image)]


class _LineCurves:
    """The curves of each photo, drawn where they are asked for. Raises InputError where a photo has no camera."""

    def __init__(self, lines: Lines, segments: Segments, poses: ImagePoses, cameras: Mapping[str, CameraModel]) -> None:
        self._lines, self._segments, self._poses, self._cameras = lines, segments, poses, cameras
        track = {name: k for k, name in enumerate(lines.tracks)}
        self._line_of = np.array([track.get(name, -1) for name in segments.tracks] + [-1])[segments.track]
        self._row = {name: k for k, name in enumerate(poses.images)}
        self._place = {name: k for k, name in enumerate(segments.images)}
        for image in segments.images:
            if image in self._row and self._camera(image) not in cameras:
                known = ", ".join(cameras)
                raise InputError(
                    f"The camera of {image} was expected to be one of {known}, found '{self._camera(image)}'; correct it."
                )
        matched = np.unique(segments.image[segments.track >= 0])
        self.images = tuple(segments.images[k] for k in matched if segments.images[k] in self._row)
        """Photos that have a pose and a matched arc."""

    def _camera(self, image: str) -> str:
        of_photos = self._poses.cameras
        return next(iter(self._cameras)) if of_photos is None else of_photos[self._row[image]]

    def of(self, image: str) -> list[Polyline]:
        """Those of one photo; none where it has no pose."""
        if image not in self._row or image not in self._place:
            return []
        lines, segments, model = self._lines, self._segments, self._cameras[self._camera(image)]
        own = np.flatnonzero((segments.image == self._place[image]) & (segments.track >= 0))
        line = self._line_of[own]
        with torch.no_grad():
            ends, valid = model.unproject(torch.from_numpy(segments.endpoints_px[own]))
            arcs = _imaged(model, torch.where(valid[..., None], ends, torch.nan), ARC_POINTS)
            shown = np.unique(line[np.append(lines.known, False)[line]])
            seen = self._poses.cam_from_world[self._row[image]].transform(torch.from_numpy(lines.ends_m[shown]))
            images = _imaged(model, torch.nn.functional.normalize(seen, dim=-1), CURVE_POINTS)
        labels = [segments.tracks[t] for t in segments.track[own]]
        observed = [Polyline(image, arc, label, "observed") for arc, label in zip(arcs, labels, strict=True)]
        return observed + [Polyline(image, curve, lines.tracks[t], "model") for curve, t in zip(images, shown, strict=True)]


def _imaged(model: CameraModel, ends: Float[Tensor, "n 2 3"], count: int) -> Float[np.ndarray, "n k 2"]:
    """The images of great arcs between bearings, NaN where they are not seen and between two sides of a closed image."""
    fractions = torch.linspace(0, 1, count, dtype=torch.float64)
    pixels, valid = model.project(points_on_arc(ends[:, 0], ends[:, 1], fractions))
    pixels = torch.where(valid[..., None], pixels, torch.nan)
    if model.PERIODIC:
        across = (pixels[:, 1:, :1] - pixels[:, :-1, :1]).abs() > 0.5 * model.image_size[0]
        between = torch.where(across, torch.nan, 0.5 * (pixels[:, 1:] + pixels[:, :-1]))
        # With the middle between every two points the pen has where to be lifted.
        every = torch.stack([pixels[:, :-1], between], 2).flatten(1, 2)
        pixels = torch.cat([every, pixels[:, -1:]], 1)
    return pixels.numpy()


def _direction_sigma_rad(lines: Lines) -> Float[np.ndarray, " n"]:
    """Largest standard deviation of each direction, which the chart turns by its second and third coordinate; NaN if unknown."""
    if lines.covariance is None:
        return np.full(len(lines), np.nan)
    part = lines.covariance[:, 1:3, 1:3]
    finite = np.isfinite(part).all((1, 2))
    largest = np.linalg.eigvalsh(np.where(finite[:, None, None], part, 0.0))[:, -1]
    return np.where(finite, np.sqrt(largest.clip(0)), np.nan)
