"""Commands on cameras: calibrate, validate."""

from typing import TYPE_CHECKING, Annotated

import typer

from camera_models.errors import InputError
from omnilines.cli._shared import Json, LossName, Mirror, Model, Out, PatternSpec, Photos, Seed, Size, app, parse_size, run

if TYPE_CHECKING:
    from omnilines.commands._common import CommandResult, ProgressCallback


@app.command()
def calibrate(
    photos: Photos,
    out: Out,
    pattern: Annotated[str | None, typer.Option("--pattern", help="Target, such as checkerboard:8x6:32.5mm.")] = None,
    image_size: Annotated[str | None, typer.Option("--image-size", help="WIDTHxHEIGHT, with corners.csv.")] = None,
    model: Annotated[str, typer.Option("--model", help="A camera model, or auto: fit all, take the best.")] = "scaramuzza",
    degree: Annotated[int | None, typer.Option("--degree", help="Degree of the scaramuzza polynomial (4).")] = None,
    coefficients: Annotated[int | None, typer.Option("--coefficients", help="Distortion of the pinhole: 0, 5 or 8 (5).")] = None,
    refine_board: Annotated[str, typer.Option("--refine-board", help="aspect, flatness or both, with a comma.")] = "",
    loss: LossName = "cauchy",
    mirror: Mirror = False,
    as_json: Json = False,
) -> None:
    """Photos or corners.csv of one camera -> calibration.yaml, report.html."""
    from omnilines.commands.calibrate import calibrate_corners, calibrate_photos

    tables = [path for path in photos if path.suffix.lower() == ".csv"]
    if tables and (len(photos) > 1 or image_size is None):
        wanted = "one corners.csv alone" if len(photos) > 1 else "--image-size WIDTHxHEIGHT beside corners.csv"
        raise InputError(
            f"{wanted} was expected, found {' '.join(map(str, photos))}; a table does not hold the size of the photos."
        )
    if not tables and pattern is None:
        raise InputError("--pattern was expected with photos, found none; give the target, such as checkerboard:8x6:32.5mm.")
    size = parse_size(image_size, "--image-size") if image_size else None
    board = tuple(name.strip() for name in refine_board.split(",") if name.strip())

    def command(progress: "ProgressCallback") -> "CommandResult":
        if size is not None and tables:
            return calibrate_corners(
                tables[0], size, out, model=model, degree=degree, coefficients=coefficients, loss=loss, mirror=mirror,
                refine_board=board, progress=progress,
            )  # fmt: skip
        return calibrate_photos(
            photos, pattern or "", out, model=model, degree=degree, coefficients=coefficients, loss=loss, mirror=mirror,
            refine_board=board, progress=progress,
        )  # fmt: skip

    run(command, as_json)


@app.command()
def validate(
    out: Out,
    model: Model = "opencv-fisheye",
    fov_deg: Annotated[float, typer.Option("--fov-deg", help="Field of view of the camera, degrees.")] = 190.0,
    views: Annotated[int, typer.Option("--views", help="Number of photos.")] = 20,
    size: Size = "1280x960",
    noise: Annotated[float, typer.Option("--noise", help="Standard deviation of the image noise, grey levels of 255.")] = 2.0,
    blur: Annotated[float, typer.Option("--blur", help="Standard deviation of the blur, pixels.")] = 0.5,
    seed: Seed = 0,
    pattern: PatternSpec = "checkerboard:8x6:30mm",
    as_json: Json = False,
) -> None:
    """Render photos with a known camera, calibrate and reconstruct from the files, compare with the truth."""
    from omnilines.commands.validate import validate as command

    image_size = parse_size(size, "--size")
    run(
        lambda progress: command(
            out, model=model, fov_deg=fov_deg, views=views, size=image_size, noise=noise, blur=blur, seed=seed,
            pattern_spec=pattern, progress=progress,
        ),
        as_json,
    )  # fmt: skip
