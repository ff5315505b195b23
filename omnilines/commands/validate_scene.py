"""omnilines validate --scene: render a line scene, rebuild its lines from the photo files, compare with the truth."""

from pathlib import Path

from omnilines.commands.reconstruct import RESULTS, reconstruct_photos
from omnilines.commands.result import CommandResult
from omnilines.commands.validate import PAGE, PHOTOS
from omnilines.files.folders import WORK, check_results, check_work_folder
from omnilines.pages.scene_validation import scene_validation_data, scene_validation_summaries
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.render import MODEL, RenderOptions, render_scene
from omnilines.progress import ProgressCallback, silent
from omnilines.studies.scene_validation import compare_scene, read_rebuilt

SCENE = "scene"
"""Folder of the rebuilt lines, inside the output folder."""


def validate_scene(
    out: str | Path,
    scene: str = "room",
    model: str = MODEL,
    options: RenderOptions = RenderOptions(),
    *,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Check that the lines of a scene are rebuilt from its photos, with the calibration and poses they were rendered with.

    Renders a room, a flat or a street, finds arcs, matches, triangulates and adjusts lines as
    `omnilines reconstruct` does with its defaults, and compares what it wrote with the truth. docs/scenes.md lists the checks
    and why their limits are what they are. The result holds when every check does.

    Writes `photos/` (photos and truth), `scene/` (the scene folder) and report.html into `out`. Raises InputError for options out
    of range and GeometryError naming the stage where no line is left, or where no edge is seen by enough photos.
    """
    folder = Path(out)
    check_results(folder, [PAGE])
    check_results(folder / SCENE, RESULTS)
    check_work_folder(folder / SCENE / WORK)
    truth = render_scene(scene, model, options, progress=progress)
    shown = truth.save(folder / PHOTOS, progress)
    photos = [folder / PHOTOS / name for name in truth.photos]
    tables = [folder / PHOTOS / name for name in ("calibration.yaml", "poses.csv")]
    done = reconstruct_photos(photos, tables[0], str(tables[1]), folder / SCENE, SceneOptions(seed=truth.seed), progress=progress)
    progress("comparing with the truth", 0, 0)
    validation = compare_scene(truth, read_rebuilt(folder / SCENE, done.data))
    page = validation.report(folder / PAGE, folder / PHOTOS)
    summaries, data = scene_validation_summaries(validation), scene_validation_data(validation)
    return CommandResult(summaries, data, validation.checks, (*shown, *done.files, page), page, done.warnings)
