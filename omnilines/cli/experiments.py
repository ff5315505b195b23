"""The experiments: board, wide, short, room, house, book."""

from pathlib import Path
from typing import Annotated

import typer

from camera_models.errors import InputError
from omnilines.cli._shared import Json, Model, NoiseGrey, Out, PatternSpec, Seed, Size, experiment_app, run
from omnilines.cli.lines import Bandwidth, Cost, Subset, Triangulation, Weights
from omnilines.cli.values import parse_size
from omnilines.triangulation import method_options


@experiment_app.command()
def board(
    data: Annotated[Path, typer.Option("--data", help="Folder of board photos, or of corners.csv.", show_default=False)],
    out: Out,
    pattern: PatternSpec = "checkerboard:8x6:32.5mm",
    model: Model = "scaramuzza",
    perturb_deg: Annotated[float, typer.Option("--perturb-deg", help="Turn of every pose before the adjustment.")] = 1.0,
    perturb_m: Annotated[float, typer.Option("--perturb-m", help="Shift of every pose before the adjustment.")] = 0.01,
    seed: Seed = 0,
    triangulation: Triangulation = "dual",
    subset: Subset = None,
    bandwidth: Bandwidth = None,
    weights: Weights = None,
    cost: Cost = "sector",
    as_json: Json = False,
) -> None:
    """Calibrate from photos of a board, rebuild its rows and columns as 3D lines from disturbed poses, before and after."""
    from omnilines.commands.experiment_board import experiment_board
    from omnilines.studies.board import BoardOptions

    method = method_options(triangulation, subset=subset, bandwidth=bandwidth, weights=weights)
    options = BoardOptions(perturb_deg, perturb_m, seed, triangulation, method, cost)
    run(lambda progress: experiment_board(data, out, pattern, model, options, progress=progress), as_json)


Noise = Annotated[str, typer.Option("--noise", help="Standard deviations of the end points, pixels, with commas.")]
Trials = Annotated[int, typer.Option("--trials", help="Trials at each noise.")]
PerturbDeg = Annotated[float, typer.Option("--perturb-deg", help="Turn of every pose before it is estimated.")]
PerturbM = Annotated[float, typer.Option("--perturb-m", help="Shift of every pose before it is estimated.")]


STUDIES = {
    "wide": "Lines in a cube, cameras 45 degrees apart: every triangulation and cost against noise, with the Cramer-Rao bound.",
    "short": "The same with cameras 9 degrees apart.",
    "room": "The same in a room of lines through a fisheye of 190 degrees.",
}


def parse_noise(text: str) -> tuple[float, ...]:
    """Numbers with commas between, such as 0.5,1,2. Raises InputError on anything else."""
    try:
        return tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        raise InputError(f"--noise was expected as numbers with commas between, such as 0.5,1,2, found '{text}'.") from None


def _add_study(name: str) -> None:
    @experiment_app.command(name, help=STUDIES[name])
    def study(
        out: Out,
        trials: Trials = 50,
        noise: Noise = "0.2,0.5,1,1.5,2,2.5,3",
        perturb_deg: PerturbDeg = 1.0,
        perturb_m: PerturbM = 0.05,
        seed: Seed = 0,
        subset: Subset = None,
        bandwidth: Bandwidth = None,
        as_json: Json = False,
    ) -> None:
        """One set-up of STUDIES, with noise and errors of the first poses as asked."""
        from omnilines.commands.experiment_lines import experiment_lines
        from omnilines.studies.line_experiments import LineStudyOptions

        averaging = method_options("averaging", subset=subset, bandwidth=bandwidth)
        options = LineStudyOptions(parse_noise(noise), trials, perturb_deg, perturb_m, seed, averaging)
        run(lambda progress: experiment_lines(name, out, options, progress=progress), as_json)


for _name in STUDIES:
    _add_study(_name)


@experiment_app.command()
def house(
    data: Annotated[Path, typer.Option("--data", help="Folder of the model house, with 2D and 3D in it.", show_default=False)],
    out: Out,
    subset: Subset = None,
    bandwidth: Bandwidth = None,
    as_json: Json = False,
) -> None:
    """Lines of the Oxford model house: every triangulation and every cost, residuals in pixels."""
    from omnilines.commands.experiment_house import experiment_house

    averaging = method_options("averaging", subset=subset, bandwidth=bandwidth)
    run(lambda progress: experiment_house(data, out, averaging=averaging, progress=progress), as_json)


@experiment_app.command()
def book(
    out: Out,
    model: Model = "pinhole",
    fov_deg: Annotated[
        float | None, typer.Option("--fov-deg", help="Across the shorter side, degrees; default 190, pinhole 60.")
    ] = None,
    views: Annotated[int, typer.Option("--views", help="Number of photos.")] = 9,
    size: Size = "1280x960",
    noise: NoiseGrey = 2.0,
    hand_px: Annotated[float, typer.Option("--hand-px", help="Standard deviation of corners and ends picked by hand.")] = 1.0,
    lines: Annotated[int, typer.Option("--lines", help="Lines at most, the longest that all photos show.")] = 25,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Poses from a sheet of paper, lines of the books around it before and after adjustment, in rendered photos."""
    from omnilines.commands.experiment_book import experiment_book
    from omnilines.pipelines.render import RenderOptions
    from omnilines.studies.book import BookOptions

    rendered = RenderOptions(fov_deg, views, parse_size(size, "--size"), noise, seed=seed)
    run(lambda progress: experiment_book(out, model, rendered, BookOptions(hand_px, lines), progress=progress), as_json)
