"""The experiments: board, wide, short, room, house, book."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omnilines.cli._shared import (
    Json,
    Model,
    NoiseGrey,
    Out,
    PatternSpec,
    Seed,
    Size,
    experiment_app,
    parse_size,
    run,
)

if TYPE_CHECKING:
    pass


from omnilines.cli.lines import Bandwidth, Cost, Subset, Triangulation, Weights
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
    from omnilines.commands.experiment import experiment_board

    options = method_options(triangulation, subset=subset, bandwidth=bandwidth, weights=weights)
    run(
        lambda progress: experiment_board(
            data, out, pattern_spec=pattern, model=model, perturb_deg=perturb_deg, perturb_m=perturb_m, seed=seed,
            triangulation=triangulation, triangulation_options=options, cost=cost, progress=progress,
        ),
        as_json,
    )  # fmt: skip


Noise = Annotated[str, typer.Option("--noise", help="Standard deviations of the end points, pixels, with commas.")]
Trials = Annotated[int, typer.Option("--trials", help="Trials at each noise.")]
PerturbDeg = Annotated[float, typer.Option("--perturb-deg", help="Turn of every pose before it is estimated.")]
PerturbM = Annotated[float, typer.Option("--perturb-m", help="Shift of every pose before it is estimated.")]


STUDIES = {
    "wide": "Lines in a cube, cameras 45 degrees apart: every triangulation and cost against noise, with the Cramer-Rao bound.",
    "short": "The same with cameras 9 degrees apart.",
    "room": "The same in a room of lines through a fisheye of 190 degrees.",
}


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
        from omnilines.commands.experiment_lines import experiment_lines, parse_noise

        levels = parse_noise(noise)
        averaging = method_options("averaging", subset=subset, bandwidth=bandwidth)
        run(
            lambda progress: experiment_lines(
                name, out, noise_px=levels, trials=trials, perturb_deg=perturb_deg, perturb_m=perturb_m, seed=seed,
                averaging=averaging, progress=progress,
            ),
            as_json,
        )  # fmt: skip


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
    fov_deg: Annotated[float | None, typer.Option("--fov-deg", help="Field of view, degrees; default 190, pinhole 60.")] = None,
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

    image_size = parse_size(size, "--size")
    run(
        lambda progress: experiment_book(
            out, model=model, fov_deg=fov_deg, views=views, size=image_size, noise=noise, hand_px=hand_px, lines=lines, seed=seed,
            progress=progress,
        ),
        as_json,
    )  # fmt: skip
