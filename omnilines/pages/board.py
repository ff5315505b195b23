"""Tables, checks and the report of the board experiment."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from omnilines import report
from omnilines.records import ImagePoses, Lines, Polyline, Summary
from omnilines.report import Section
from omnilines.report.numbers import figure
from omnilines.studies.board_figures import FIGURES, Agreement, BoardExperiment, LineState

STEPS_PER_LINE = 40
"""Points per reprojected line: a fisheye bends it."""


def board_summaries(experiment: BoardExperiment) -> tuple[Summary, ...]:
    """What was done, the figures before and after, and the agreement with the board."""
    calibration = experiment.calibration
    used = sum(view.used for view in calibration.views)
    setting = Summary(
        "Board experiment",
        (
            ("camera model", calibration.model.NAME),
            ("photos used", f"{used} of {len(calibration.views)}"),
            ("rms_px_per_axis of the calibration", f"{calibration.rms_px_per_axis:.4f}"),
            ("rms_px_per_point of the calibration", f"{calibration.rms_px_per_point:.4f}"),
            ("board lines", f"{int((~experiment.board.column).sum())} rows, {int(experiment.board.column.sum())} columns"),
            ("segments", f"{len(experiment.arcs)}"),
            ("adjustment", f"{experiment.cost}: {experiment.adjusted.outcome.value}"),
        ),
        experiment.notes,
    )
    figures = tuple(
        (name, f"{experiment.before.figures[key]:.4g} → {experiment.after.figures[key]:.4g} {unit}".strip())
        for key, name, unit in FIGURES
    )
    note = (
        "Lengths are in the scale of the board, after the similarity that brings the lines closest to it. Residuals are over "
        "both ends of all segments. The deviation of the mean directions from a right angle is one number, which random poses "
        "can bring near zero by luck: it has no check."
    )
    return setting, Summary("Before → after", figures, (note,)), _agreement_summary(experiment)


def _agreement_summary(experiment: BoardExperiment) -> Summary:
    noise, photos = experiment.by_noise, experiment.by_photos
    rows = (
        ("RMS distance of the lines' ends from the board's", f"{1e3 * noise.actual_m:.4g} mm"),
        ("predicted from independent noise of the end points", _described(noise)),
        ("predicted from the scatter between photos", _described(photos)),
        ("noise of the end points", figure(experiment.adjusted.noise_factor, ".4g", "px")),
        ("effective degrees of freedom of the error", f"{experiment.predicted.effective_freedom:.1f}"),
    )
    notes = (
        "Limits are what the ratio exceeds once in 1000 when the prediction is right. The first prediction holds for corners "
        "with independent noise, a perfect board and a perfect lens model; the second, by leaving out one photo in turn, also "
        "counts errors that the corners of one photo share, and is the one that is checked.",
        "Neither knows what is the same in all photos: a print that is off its nominal grid or not flat, and the camera. A ratio "
        "to the first prediction above its limit is due to that or to errors that the corners of one photo share.",
    )
    return Summary("Agreement with the board", rows, notes)


def _described(agreement: Agreement) -> str:
    return f"{1e3 * agreement.predicted_m:.4g} mm, ratio {agreement.ratio:.3g} (limit {agreement.limit:.3g})"


def board_data(experiment: BoardExperiment, seed: int) -> dict[str, Any]:
    """For `--json`."""

    def of(agreement: Agreement) -> dict[str, float]:
        return {
            "actual_rms_mm": 1e3 * agreement.actual_m,
            "predicted_rms_mm": 1e3 * agreement.predicted_m,
            "ratio": agreement.ratio,
            "limit": agreement.limit,
        }

    calibration = experiment.calibration
    return {
        "model": calibration.model.NAME,
        "photos_used": sum(view.used for view in calibration.views),
        "photos": len(calibration.views),
        "rms_px_per_axis": calibration.rms_px_per_axis,
        "rms_px_per_point": calibration.rms_px_per_point,
        "lines": len(experiment.tracks),
        "board_lines": len(experiment.status),
        "segments": len(experiment.arcs),
        "seed": seed,
        "outcome": experiment.adjusted.outcome.name.lower(),
        "iterations": experiment.adjusted.iterations,
        "units": {key: unit for key, _, unit in FIGURES},
        "before": experiment.before.figures,
        "after": experiment.after.figures,
        "agreement_by_noise": of(experiment.by_noise),
        "agreement_by_photos": of(experiment.by_photos),
        "end_point_noise_px": experiment.adjusted.noise_factor,
        "effective_freedom": experiment.predicted.effective_freedom,
    }


def scene_tables(experiment: BoardExperiment) -> tuple[Lines, ImagePoses]:
    """Adjusted lines, one row a board line, and poses in the frame of the board; sigma is that of the error after alignment."""
    return line_table(experiment, experiment.after, experiment.predicted.sigma_m.amax(-1)), aligned_poses(experiment)


def aligned_poses(experiment: BoardExperiment) -> ImagePoses:
    """Adjusted poses in the frame of the board."""
    state = experiment.after
    return ImagePoses(
        experiment.perturbed.images, state.aligned.transform_poses(state.cam_from_world), experiment.perturbed.cameras
    )


def line_table(experiment: BoardExperiment, state: LineState, sigma_m: Float[torch.Tensor, " t"]) -> Lines:
    """The lines of one stage in the frame of the board."""
    total, tracks, arcs = len(experiment.status), experiment.tracks.numpy(), experiment.arcs
    views = torch.bincount(arcs.track, minlength=len(tracks))
    squares = torch.zeros(len(tracks), dtype=torch.float64).index_add_(0, arcs.track, state.orthogonal_px.square().sum(-1))
    ends, rms, sigma = np.full((total, 2, 3), np.nan), np.full(total, np.nan), np.full(total, np.nan)
    ends[tracks] = state.aligned_ends_m.numpy()
    rms[tracks], sigma[tracks] = (squares / (2 * views)).sqrt().numpy(), sigma_m.numpy()
    counts = np.bincount(experiment.board.segments.track, minlength=total)
    return Lines(experiment.board.segments.tracks, ends, counts, rms, sigma, experiment.status)


def board_sections(experiment: BoardExperiment, photo_folder: Path | None) -> list[Section]:
    """All sections, in reading order; photos only where their folder is known."""
    setting, figures, agreement = board_summaries(experiment)
    distances = {
        name: state.orthogonal_px.abs().numpy().ravel()
        for name, state in (("before", experiment.before), ("after", experiment.after))
    }
    caption = "Both ends of every segment, from the projection of its line: with perturbed poses, and after the adjustment."
    sections = [
        report.summary_section(setting, figures, agreement),
        report.checks_section(experiment.checks),
        report.histogram_section("Residuals before and after", distances, "orthogonal distance (px)", caption, logarithmic=True),
    ]
    if photo_folder is not None:
        sections.append(report.photos_section(photo_folder, reprojections(experiment), title="Adjusted lines over the photos"))
    return [*sections, _scene(experiment), report.views_section(experiment.calibration.views)]


def reprojections(experiment: BoardExperiment) -> list[Polyline]:
    """The adjusted lines projected into every photo that observes them, and the end points that were observed."""
    state, arcs = experiment.after, experiment.arcs
    steps = torch.linspace(0, 1, STEPS_PER_LINE, dtype=torch.float64)[:, None]
    points = state.ends_m[:, :1] * (1 - steps) + state.ends_m[:, 1:] * steps
    seen = state.cam_from_world[arcs.image].transform(points[arcs.track])
    pixels, valid = experiment.calibration.model.project(seen)
    # NaN lifts the pen between lines.
    drawn = torch.cat([torch.where(valid[..., None], pixels, torch.nan), pixels.new_full((len(arcs), 1, 2), torch.nan)], 1)
    segments = experiment.board.segments
    curves = []
    for k, image in enumerate(experiment.perturbed.images):
        mine = drawn[arcs.image == k].reshape(-1, 2).numpy()
        ends = segments.endpoints_px[segments.image == segments.images.index(image)].reshape(-1, 2)
        curves.append(Polyline(image, mine, "adjusted 3D lines, reprojected", "model"))
        curves.append(Polyline(image, ends, "observed ends of rows and columns", "observed"))
    return curves


def _scene(experiment: BoardExperiment) -> Section:
    blank = torch.full((len(experiment.tracks),), torch.nan, dtype=torch.float64)
    stages = [line_table(experiment, experiment.before, blank), scene_tables(experiment)[0]]
    both = Lines(
        tuple(f"{track} {when}" for when, stage in zip(("before", "after"), stages, strict=True) for track in stage.tracks),
        np.concatenate([stage.ends_m for stage in stages]),
        np.concatenate([stage.views for stage in stages]),
        np.concatenate([stage.rms_px for stage in stages]),
        np.concatenate([stage.sigma_m for stage in stages]),
        stages[0].status + stages[1].status,
    )
    ends = experiment.board.ends_m
    low, high = ends.reshape(-1, 3).min(0), ends.reshape(-1, 3).max(0)
    outline = np.array([[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0], [low[0], high[1], 0]])
    count = len(experiment.status)
    return report.scene_section(
        boards=[("board", outline)],
        lines=both,
        groups=["before"] * count + ["after"] * count,
        cameras=aligned_poses(experiment),
        truth_m=ends,
        up=(0.0, -1.0, 0.0),
        title="Board, lines and cameras",
        caption="Lines triangulated from the perturbed poses (before) and adjusted (after), each aligned with the board.",
    )
