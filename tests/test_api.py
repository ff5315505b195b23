"""The public API: its names are pinned and resolve, importing it loads nothing heavy, and the example of each verb runs."""

import ast
import doctest
import inspect
import math
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from types import FunctionType, ModuleType

import cv2
import numpy as np
import pytest
import torch

import camera_models
import omnilines as ol
from calib_patterns import pattern
from calib_patterns.board_poses import random_board_poses
from calib_patterns.rendering import render_target
from camera_models.pose import Pose
from omnilines.cli import main
from omnilines.options import with_settings

VIDEO = "frames ChosenFrames FrameOptions".split()  # the example of `frames` runs in test_frames.py
VERBS = "detect detect_rig calibrate calibrate_rig convert render validate".split()
RESULTS = "PhotoCorners RigCorners CalibrationResult RigResult ConversionResult CalibrationOptions DetectionOptions".split()
SCENE_VERBS = "extract directions given_arcs estimate_poses reconstruct adjust triangulate segments_of_arrays rectify".split()
SCENE_RESULTS = "PhotoArcs PhotoPoses Scene RectifiedViews ExtractionOptions PosingOptions MatchingOptions SceneOptions".split()
EXPORT = "export SceneExport".split()
DIRECTIONS = "PhotoDirections DirectionsOptions".split()
FROM_LINES = "check LineResult LinesOptions CheckResult CheckOptions".split()  # run in test_lines_camera.py
TRUTH_RESULTS = "RenderOptions RenderedTargets RenderedScene Validation SceneValidation".split()
TABLES = "Corners ImagePoses Segments Lines".split()
FILES = [
    *("load", "save", "read_corners", "read_rig_corners", "read_poses", "read_segments", "read_lines"),
    *("write_corners", "write_poses", "write_segments", "write_lines"),
]
OTHERS = "Calibration Pose OmnilinesError InputError GeometryError ProgressCallback Cancelled".split()
BOARD = "checkerboard:8x6:30mm"
LENS = camera_models.OpenCVFisheye([150.0, 150.0, 319.5, 239.5, 0.02, -0.004, 0.0, 0.0], (640, 480))


def test_exported_names_are_these() -> None:
    """A name that goes, or comes, is a decision: it stands here, in the changelog and in the documents."""
    assert sorted(ol.__all__) == sorted(
        [
            *VIDEO,
            *VERBS,
            *RESULTS,
            *SCENE_VERBS,
            *SCENE_RESULTS,
            *EXPORT,
            *DIRECTIONS,
            *FROM_LINES,
            *TRUTH_RESULTS,
            *TABLES,
            *FILES,
            *OTHERS,
        ]
    )
    assert dir(ol) == sorted(ol.__all__) and dir(camera_models) == sorted(camera_models.__all__)


@pytest.mark.parametrize("module", [ol, camera_models], ids=lambda module: module.__name__)
def test_every_name_resolves_where_type_checkers_find_it(module: ModuleType) -> None:
    tree = ast.parse(Path(str(module.__file__)).read_text())
    blocks = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    known = {alias.name: statement.module for block in blocks for statement in ast.walk(block)
             if isinstance(statement, ast.ImportFrom) for alias in statement.names}  # fmt: skip
    assert len(known) > 10
    for name in module.__all__:
        value = getattr(module, name)
        if name in known:
            assert value is getattr(sys.modules[str(known[name])], name)
    lazy = set(module.__all__) - {name for name in vars(module) if not name.startswith("_")}
    assert lazy <= known.keys() <= set(module.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = module.nothing


def test_the_version_is_that_of_the_package() -> None:
    assert ol.__version__ == version("omnilines")


def test_a_camera_of_another_name_is_answered_with_the_names() -> None:
    with pytest.raises(KeyError, match="a camera of the name left, right was expected, found 'cam0'"):
        ol.Calibration({"left": LENS, "right": LENS})["cam0"]


def test_import_loads_nothing_heavy_and_takes_no_time() -> None:
    script = (
        "import sys, time\nbefore = time.process_time()\nimport omnilines\nspent = time.process_time() - before\n"
        "heavy = {'torch', 'numpy', 'cv2', 'scipy', 'numba', 'plotly', 'yaml', 'typer'} & set(sys.modules)\n"
        "print(spent, sorted(heavy))"
    )
    runs = [subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True) for _ in range(3)]
    assert all(run.stdout.split(maxsplit=1)[1].strip() == "[]" for run in runs)
    assert min(float(run.stdout.split()[0]) for run in runs) < 0.1


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the examples read: photos of a board by one camera and by two side by side, and a calibration."""
    folder = tmp_path_factory.mktemp("examples")
    with pytest.raises(SystemExit):
        main(f"render targets --model opencv-fisheye --fov-deg 190 --views 8 --size 640x480 --pattern {BOARD} --seed 3 "
             f"--noise 2 --out {folder}/board".split())  # fmt: skip
    camera_models.save(folder / "calibration.yaml", {"cam0": LENS})
    board = pattern(BOARD)
    poses = random_board_poses(board, LENS, 8, math.radians(60), seed=1)
    for name, x_m in (("left", 0.0), ("right", 0.1)):
        (folder / "rig" / name).mkdir(parents=True)
        shift = Pose.exp(torch.tensor([0.0, 0.0, 0.0, -x_m, 0.0, 0.0], dtype=torch.float64))
        for k in range(8):
            photo = render_target(board, LENS, shift @ poses[k], blur_px=0.5, noise_grey=2.0, seed=k)
            assert cv2.imwrite(str(folder / "rig" / name / f"{k}.png"), photo)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("verb", VERBS)
def test_the_example_of_a_verb_holds(verb: str, rendered: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(rendered)
    function = getattr(ol, verb)
    assert isinstance(function, FunctionType) and "Raises " in inspect.getdoc(function), verb
    example = doctest.DocTestParser().get_doctest(str(inspect.getdoc(function)), {"ol": ol, "np": np}, verb, None, None)
    assert example.examples
    told: list[str] = []
    doctest.DocTestRunner().run(example, out=told.append)
    assert not told, "".join(told)


def test_verbs_print_nothing_and_write_nothing_unasked(
    rendered: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    told: list[str] = []
    found = ol.detect(rendered / "board", BOARD, progress=lambda stage, *_: told.append(stage))
    result = ol.calibrate(found, model="opencv-fisheye", progress=lambda stage, *_: told.append(stage))
    ol.convert(result.calibration, "cameras.txt")
    assert capfd.readouterr() == ("", "") and not list(tmp_path.iterdir())
    assert {"detecting corners", "refining the camera"} <= set(told)
    assert set(told) <= {"detecting corners", "refining the camera", "searching with the camera"}


@pytest.mark.slow
def test_results_say_in_one_line_what_they_hold(rendered: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As an interpreter or a notebook shows them."""
    monkeypatch.chdir(tmp_path)
    found = ol.detect(rendered / "board", BOARD)
    one = ol.calibrate(found, model="opencv-fisheye")
    several = ol.calibrate_rig(ol.detect_rig(rendered / "rig", BOARD), model="opencv-fisheye")
    arcs = ol.extract(rendered / "board", one.calibration)
    ways, views = ol.directions(arcs), ol.rectify(rendered / "board", one.calibration)
    results = {
        "PhotoCorners(Corners(corners=384, views=8), skipped=0)": found,
        f"CalibrationResult({one.camera}, views=8 of 8, rms_px_per_axis={one.rms_px_per_axis:.3g})": one,
        f"Calibration(cam0={one.camera}, rig=0, views=8)": one.calibration,
        f"ConversionResult({one.calibration}, format='kalibr', out='cam.yaml')": ol.convert(
            one.calibration, "cam.yaml", to_format="kalibr"
        ),
        f"RigResult(left, right, views=16 of 16, rms_px_per_axis={several.rms_px_per_axis:.3g})": several,
        "RigCorners(left, right, Corners(corners=768, views=16), skipped=0)": several.found,
        f"PhotoArcs(photos=8 of 8, arcs={len(arcs)})": arcs,
        f"PhotoDirections(photos=8, directions={len(ways)})": ways,
        f"RectifiedViews('perspective', views=8, photos=8, {views.camera})": views,
        f"FoundArcs('view00.png', arcs={len(arcs.photos[0])})": arcs.photos[0],
    }
    for shown, result in results.items():
        assert repr(result) == shown and "\n" not in shown


@pytest.mark.slow
def test_arrays_give_what_files_give(rendered: Path, tmp_path: Path) -> None:
    """Photos, corners and board points as arrays of NumPy and torch; the report is of the same sections but for the photos."""
    names = [f"view{k:02d}.png" for k in range(8)]
    photos = {name: cv2.imread(str(rendered / "board" / name), cv2.IMREAD_UNCHANGED) for name in names}
    first = ol.detect(rendered / "board", BOARD)
    assert first.corners.images == tuple(names)
    for given in (photos, {name: torch.from_numpy(photo) for name, photo in photos.items()}):
        found = ol.detect(given, pattern(BOARD))
        np.testing.assert_array_equal(found.corners.pixels, first.corners.pixels)
        assert found.photo_folder is None and found.inputs["photos"] == "in memory"
    whole = ol.calibrate(found, model="opencv-fisheye")
    table = whole.found.corners
    views = {name: (torch.from_numpy(table.board_m[table.view == v]), table.pixels[table.view == v])
             for v, name in enumerate(table.images)}  # fmt: skip
    options = ol.CalibrationOptions("opencv-fisheye", loss="none")
    alone = ol.calibrate(views, (640, 480), options)
    assert alone.selection is None and alone.calibration.provenance["inputs"] == {"corners": "in memory"}
    sigma = np.sqrt(np.diag(whole.covariance))
    off = (alone.camera.parameters - whole.camera.parameters).numpy() / sigma
    assert np.abs(off).max() < 3.0, "weights and rejection move the parameters within their standard deviations"
    from_files = ol.calibrate(first, model="opencv-fisheye")
    titles = [re.findall(r"<h2[^>]*>([^<]*)</h2>", result.report(tmp_path / "report.html").read_text())
              for result in (from_files, whole)]  # fmt: skip
    assert [title for title in titles[0] if title != "Photos"] == titles[1] and len(titles[0]) == len(titles[1]) + 1


@pytest.mark.slow
def test_thresholds_are_options(rendered: Path) -> None:
    """They reach what they decide: by `--set` they come as options too."""
    found = ol.detect(rendered / "board", BOARD)
    default = ol.CalibrationOptions("opencv-fisheye", searches=0)
    strict = with_settings(default, ["calibration.robust.reject_sigma=2"], "calibration.")
    kept = [int(ol.calibrate(found, options=options).fit.kept.sum()) for options in (default, strict)]
    assert kept[1] < kept[0] - 10
    blind = with_settings(ol.DetectionOptions(), ["detection.fit.max_sigma_px=0.0001"], "detection.")
    with pytest.raises(ol.InputError, match="found in none"):
        ol.detect(rendered / "board", BOARD, options=blind)
    many = with_settings(default, ["views.least_views=9"])
    with pytest.raises(ol.InputError, match="at least 9, found 8"):
        ol.calibrate(found, options=many)
    cameras = {"left": rendered / "rig" / "left", "right": rendered / "rig" / "right"}
    with pytest.raises((ol.InputError, ol.GeometryError), match="at least 9, found 8"):
        ol.calibrate_rig(ol.detect_rig(cameras, BOARD), options=many)


@pytest.mark.slow
def test_a_rig_from_folders_and_arrays_of_each_camera(rendered: Path, tmp_path: Path) -> None:
    """Photos by camera are those of one folder; so is the rig."""
    right = {f"{k}.png": cv2.imread(str(rendered / "rig" / "right" / f"{k}.png"), cv2.IMREAD_UNCHANGED) for k in range(8)}
    found = ol.detect_rig({"left": rendered / "rig" / "left", "right": right}, [BOARD])
    same = ol.detect_rig(rendered / "rig", BOARD)
    assert found.corners.images == same.corners.images and found.corners.frames == same.corners.frames
    np.testing.assert_array_equal(found.corners.pixels, same.corners.pixels)
    assert found.photo_folder is None and same.photo_folder == rendered / "rig"
    result = ol.calibrate_rig(found, model="opencv-fisheye")
    centre = result.rig["right"].cam_from_rig.centre.numpy()
    covariance = result.fit.member("right").pose_covariance[3:, 3:]
    assert np.abs(centre - [0.1, 0, 0]).max() < 5.0 * math.sqrt(np.linalg.eigvalsh(covariance)[-1]) < 0.001
    begun = ol.calibrate_rig(found.corners, (640, 480), start=result.cameras, hold=True)
    np.testing.assert_array_equal(begun.cameras["left"].parameters, result.cameras["left"].parameters)
    with pytest.raises(ol.InputError, match="`models`: cameras among left, right were expected, found 'middle'"):
        ol.calibrate_rig(found, models={"middle": "pinhole"})
    with pytest.raises(ol.InputError, match=r"`boards` known was expected with a corners\.csv"):
        ol.calibrate_rig(found, boards="known")
    page = result.report(tmp_path / "report.html").read_text()
    assert "left: parameters" in page and ">Photos with the largest residuals<" not in page


def test_what_calls_can_get_wrong(rendered: Path) -> None:
    found = ol.detect(rendered / "board", BOARD)
    cases = (
        (lambda: ol.calibrate(found.corners), "`image_size` was expected beside a table"),
        (lambda: ol.calibrate(found.corners, (300, 200)), "check `image_size`"),
        (lambda: ol.calibrate({}, (300, 200)), "found none"),
        (lambda: ol.calibrate({"a": (np.zeros((4, 3)), np.zeros((3, 2)))}, (300, 200)), "View a was expected"),
        (lambda: ol.calibrate(found, model="auto", degree=4), "`model` auto tries .* found `degree` beside it"),
        (lambda: ol.calibrate(found, degree=1), "`degree` was expected to be at least 2, found 1"),
        (lambda: ol.calibrate(found, refine_board=("tilt",)), "aspect and flatness, found 'tilt'"),
        (lambda: ol.calibrate_rig(found.corners, (640, 480)), "the camera of every view was expected"),
        (lambda: ol.calibrate_rig(found.corners), "`image_size` was expected"),
        (lambda: ol.calibrate_rig(found.corners, (640, 480), hold=True), "found no `start`"),
        (lambda: ol.detect({"a": np.zeros((3, 4))}, BOARD), "of 8 or 16 bits, found"),
        (lambda: ol.detect({}, BOARD), "an empty one"),
        (lambda: ol.detect(rendered / "board", BOARD, camera=camera_models.OpenCVFisheye.examples()[0]), "The `camera` of the"),
    )
    for call, words in cases:
        with pytest.raises(ol.InputError, match=words):
            call()
    with pytest.raises(TypeError):
        ol.calibrate(found, no_such_option=1)  # type: ignore[call-arg]


def test_progress_cancels(rendered: Path) -> None:
    def stop(stage: str, done: int, total: int) -> None:
        if done == 3:
            raise ol.Cancelled

    with pytest.raises(ol.Cancelled):
        ol.detect(rendered / "board", BOARD, progress=stop)


@pytest.mark.slow
def test_the_command_line_spells_parameters_as_its_options(rendered: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos = f"calibrate {rendered}/board --pattern {BOARD} --out {rendered}/out"
    cases = (
        (
            f"{photos} --model auto --coefficients 5",
            "omnilines: --model auto tries every number of coefficients itself, found --coef",
        ),
        (
            f"detect {rendered}/board --pattern {BOARD} --calibration {rendered}/large.yaml --out x",
            "omnilines: The --calibration of the",
        ),
        (f"convert {rendered}/calibration.yaml {rendered}/nothing", "name the format with --to."),
        (f"{photos} --set calibration.degree=1", "omnilines: --degree was expected to be at least 2, found 1"),
        (f"{photos} --set detection.fit.max_sigma_px=0.0001", "found in none"),
        (f"{photos} --set calibration.degree", "A value was expected behind calibration.degree, found none; give it as"),
        (f"{photos} --set calibration.degre=4", "found 'calibration.degre=4', of which no option has the name; did you mean"),
    )
    camera_models.save(rendered / "large.yaml", {"cam0": camera_models.OpenCVFisheye.examples()[0]})
    for command, words in cases:
        with pytest.raises(SystemExit):
            main(command.split())
        assert words in capsys.readouterr().err, command


def test_errors_have_one_base() -> None:
    assert issubclass(ol.InputError, ol.OmnilinesError) and issubclass(ol.GeometryError, ol.OmnilinesError)
    assert not issubclass(ol.Cancelled, ol.OmnilinesError), "who cancels catches that alone"


@pytest.mark.slow
def test_what_is_no_path_or_calibration_is_refused_in_a_sentence() -> None:
    """Without the hook, as users call: it would refuse the wrong type before the verb does."""
    script = """
import numpy as np, omnilines as ol
for call in (lambda: ol.load(np.zeros(3)), lambda: ol.check({"a": np.zeros((8, 8), np.uint8)}, None)):
    try:
        call()
    except ol.InputError as error:
        print(error)
"""
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines() == [
        "The path of a calibration file was expected, found ndarray; give a path.",
        "`camera` of check was expected as CameraModel or Calibration, found NoneType; give one.",
    ]
