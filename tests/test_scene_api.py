"""From arcs to the scene in Python: objects in, objects out, what is kept on disk and when it is made anew."""

import doctest
import inspect
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import omnilines as ol
from camera_models import Calibration, InputError, load
from camera_models.pose import Pose
from omnilines.adjustment.prior import KnownPoses
from omnilines.commands.reconstruct import reconstruct_photos
from omnilines.commands.resume import NOTE, Stamp
from omnilines.files import find_photos, read_lines, read_photo, read_poses, read_segments, write_segments
from omnilines.machine import THREADS
from omnilines.pages.scene import scene_summary
from omnilines.pipelines import arcs as arcs_module
from omnilines.pipelines.adjust import adjust, segments_of_arrays, triangulate
from omnilines.pipelines.arcs import extract
from omnilines.pipelines.given_arcs import given_arcs
from omnilines.pipelines.lines import still_held
from omnilines.pipelines.options import RoundOptions, SceneOptions
from omnilines.pipelines.photo_arcs import PhotoArcs
from omnilines.pipelines.pose_tables import given_poses
from omnilines.pipelines.poses import estimate_poses
from omnilines.pipelines.reconstruct import reconstruct
from omnilines.pipelines.rectify import rectify
from omnilines.pipelines.render import RenderOptions, render_scene
from omnilines.pipelines.scene import Scene
from omnilines.progress import Cancelled
from omnilines.records import Check, ImagePoses, LengthUnit

VIEWS, SIZE = 6, (400, 400)
VERBS = "extract given_arcs estimate_poses reconstruct adjust triangulate segments_of_arrays rectify export".split()


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of photos of a plain room, with its calibration and poses."""
    folder = tmp_path_factory.mktemp("room") / "photos"
    render_scene("plain-room", "opencv-fisheye", RenderOptions(views=VIEWS, size_px=SIZE, seed=4)).save(folder)
    for name in ("calibration.yaml", "poses.csv"):
        (folder / name).rename(folder.parent / name)
    return folder


@pytest.fixture(scope="module")
def cameras(room: Path) -> Calibration:
    return load(room.parent / "calibration.yaml")


@pytest.fixture(scope="module")
def poses(room: Path) -> ImagePoses:
    return read_poses(room.parent / "poses.csv")


@pytest.fixture(scope="module")
def found(room: Path, cameras: Calibration) -> PhotoArcs:
    return extract(room, cameras)


@pytest.fixture(scope="module")
def scene(found: PhotoArcs, poses: ImagePoses, cameras: Calibration) -> Scene:
    return reconstruct(found, poses, cameras["cam0"])


@pytest.mark.full
def test_a_scene_is_the_same_to_the_last_bit_on_any_number_of_cores(
    found: PhotoArcs, poses: ImagePoses, cameras: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads, scenes = torch.get_num_threads(), []
    try:
        for number in (1, 2):
            monkeypatch.setenv(THREADS, str(number))
            torch.set_num_threads(number)
            scenes.append(reconstruct(found, poses, cameras["cam0"], SceneOptions(refine=("lines", "poses"))))
    finally:
        torch.set_num_threads(threads)
    one, two = scenes
    assert len(one.lines) > 40
    for name in ("ends_m", "covariance", "rms_px", "sigma_m", "shown_share"):
        np.testing.assert_array_equal(getattr(one.lines, name), getattr(two.lines, name))
    assert torch.equal(one.poses.cam_from_world.rotation, two.poses.cam_from_world.rotation)
    assert torch.equal(one.poses.cam_from_world.translation, two.poses.cam_from_world.translation)
    np.testing.assert_array_equal(one.poses.covariance, two.poses.covariance)


@pytest.mark.slow
def test_a_scene_in_a_few_lines_prints_nothing_and_writes_nothing_unasked(
    room: Path, cameras: Calibration, poses: ImagePoses, found: PhotoArcs, scene: Scene, tmp_path: Path, capfd, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    capfd.readouterr()
    stages: list[str] = []
    again = reconstruct(found, poses, cameras["cam0"], progress=lambda stage, *_: stages.append(stage))
    assert capfd.readouterr() == ("", "") and not list(tmp_path.iterdir()) and "building tracks" in stages
    np.testing.assert_array_equal(again.lines.ends_m, scene.lines.ends_m)
    assert len(scene.lines) > 30 and scene.lines.covariance is not None
    assert len(scene.photos) == VIEWS and scene.stages[-1].kept == len(scene.lines) and scene.families is not None
    assert scene.provenance["inputs"]["photos"] == str(room) and "min_views=4" in scene.provenance["inputs"]["options"]
    files = scene.save(tmp_path / "scene")
    assert {file.name for file in files} == {path.name for path in (tmp_path / "scene").glob("[!.]*")}
    assert len(read_lines(tmp_path / "scene" / "lines.csv")) == len(scene.lines)
    assert "Stages" in scene.report(tmp_path / "report.html").read_text()


def test_a_scene_says_what_it_comes_to_and_when_it_is_not_to_be_trusted(scene: Scene) -> None:
    sigma_m = scene.median_sigma_m()
    assert scene_summary(scene).verdict.startswith(
        f"{int(scene.lines.known.sum())} lines from {VIEWS} photos, half of them known across to {1e3 * sigma_m:.2g} mm"
    )
    assert scene_summary(scene).advice
    open_scale = replace(scene, adjusted=replace(scene.adjusted, lines=replace(scene.lines, unit=LengthUnit.OPEN)))
    assert " percent of their distance or better" in scene_summary(open_scale).verdict
    centres = scene.poses.cam_from_world.centre
    apart = [(float((a - b).norm()), i, j) for i, a in enumerate(centres) for j, b in enumerate(centres[:i])]
    _, first, last = max(apart)
    (scale,) = [one for one in scene_summary(open_scale).advice if "how large" in one.limit]
    assert all(scene.poses.images[k] in scale.do for k in (first, last)) and "`scale_from`" in scale.do
    assert open_scale.from_photos is not None
    weak = [replace(one, in_lines=0) if one.image == scene.poses.images[last] else one for one in scene.photos]
    unexplained = replace(open_scale, from_photos=replace(open_scale.from_photos, photos=tuple(weak)))
    rest = max(one for one in apart if last not in one[1:])
    (scale,) = [one for one in scene_summary(unexplained).advice if "how large" in one.limit]
    assert all(scene.poses.images[k] in scale.do for k in rest[1:]) and scene.poses.images[last] not in scale.do
    doubtful = replace(scene, checks=(Check("agreement", 2.0, 1.0, "px", False),))
    assert scene_summary(doubtful).advice[0].limit == "Agreement: 2 px, where 1 is the limit."
    assert scene_summary(doubtful).verdict == "These lines are not to be trusted: agreement is beyond the limit."


def test_a_rig_that_stood_once_is_advised_what_can_be_done(scene: Scene) -> None:
    once = replace(scene.adjusted, poses=replace(scene.poses, frames=("one",) * VIEWS))
    weak = replace(once, lines=replace(once.lines, status=("weak",) * 60 + once.lines.status[60:]))
    for adjusted in (once, weak):
        (told,) = scene_summary(replace(scene, adjusted=adjusted, advice=(), supposed=None, asked=())).advice
        assert told.do == "Take photos of more instants, with poses from the photos (`poses` sfm)."


def test_skipped_photos_are_in_verdict_and_advice(found: PhotoArcs, scene: Scene) -> None:
    assert scene.from_photos is not None
    names, reason = scene.segments.images, "a photo of 768x512 px was expected, found 1152x768 px."
    one = replace(scene, from_photos=replace(scene.from_photos, given=VIEWS + 1, skipped={"large.png": reason}))
    told = scene_summary(one)
    assert f" lines from {len(names)} of {VIEWS + 1} photos" in str(told.verdict)
    assert told.advice[0].limit == f"1 of {VIEWS + 1} photos is skipped; of large.png it is said: {reason}"
    assert "large.png" in told.advice[0].do and not any("as many photos again" in one.do.lower() for one in told.advice)


def test_a_table_that_names_other_cameras_is_told(found: PhotoArcs, poses: ImagePoses, cameras: Calibration) -> None:
    names = [one.photo.name for one in found.used]
    others = replace(poses, cameras=("small", "cam0", *("large",) * (VIEWS - 2)))
    for table, count in ((others, VIEWS - 1), (poses, 0), (replace(poses, cameras=None), 0)):
        notes = given_poses(table, names, cameras, found.camera_of, path="room/poses.csv").notes
        assert len(notes) == (count > 0)
        assert not count or (f"The camera of {count} photos" in notes[0] and "is small, large in poses.csv" in notes[0])


@pytest.mark.slow
def test_of_three_photos_all_have_to_see_a_line(found: PhotoArcs, poses: ImagePoses, cameras: Calibration) -> None:
    three = replace(found, photos=found.photos[:3])
    own, asked = (reconstruct(three, poses, cameras["cam0"], SceneOptions(min_views=k)) for k in (4, 3))
    np.testing.assert_array_equal(own.lines.ends_m, asked.lines.ends_m)
    assert len(own.lines) >= 10 and not any("4 photos" in reason for stage in own.stages for reason, _ in stage.dropped)
    assert any("All 3 photos have to see a line:" in one for one in own.notes)
    four = reconstruct(replace(found, photos=found.photos[:4]), poses, cameras["cam0"])
    assert any("All 4 photos have to see a line, or 3 whose arcs all agree:" in one for one in four.notes)
    assert set(four.lines.views.tolist()) == {3, 4}
    assert " lines from 3 photos" in str(scene_summary(own).verdict)


@pytest.mark.slow
def test_a_prior_holds_given_poses_but_that_of_a_photo_which_lines_put_elsewhere(
    found: PhotoArcs, poses: ImagePoses, cameras: Calibration
) -> None:
    wrong, true, sigma = 2, poses.cam_from_world, (math.radians(0.02), 0.001)
    turn = torch.zeros(VIEWS, 6, dtype=torch.float64)
    turn[wrong, :3] = torch.tensor([0.05, -0.04, 0.03])
    given = replace(poses, cam_from_world=Pose.exp(turn) @ true)
    options = SceneOptions(refine=("lines", "poses"), rounds=RoundOptions(max_rounds=4))
    assert KnownPoses(given, *sigma).agreeing(poses, 0.001).poses.images == tuple(np.delete(poses.images, wrong))
    held = reconstruct(found, given, cameras["cam0"], options, pose_sigma=sigma)
    off = (held.poses.cam_from_world @ true.inverse()).log().abs()
    others = [k for k in range(VIEWS) if k != wrong]
    assert bool((off[others, :3] < 4.0 * sigma[0]).all()) and bool((off[others, 3:] < 4.0 * sigma[1]).all())
    # The lines alone know where that photo is.
    assert float(off[wrong, :3].max()) < 0.1 * float(turn.abs().max())
    assert [
        one for one in held.told if "no prior holds its pose" in one and poses.images[wrong] in one and poses.images[0] not in one
    ]
    assert held.poses.covariance is not None and held.supposed is not None
    largest = np.diagonal(held.poses.covariance[others], axis1=1, axis2=2).max(0)
    assert (largest[:3] <= sigma[0] ** 2).all() and (largest[3:] <= sigma[1] ** 2).all()
    assert not any("Lines draw" in one for one in held.told)
    with pytest.raises(InputError, match="`refine` with poses"):
        reconstruct(found, given, cameras["cam0"], pose_sigma=sigma)


@pytest.mark.slow
def test_a_prior_that_lines_contradict_is_told(found: PhotoArcs, poses: ImagePoses, cameras: Calibration) -> None:
    twists = torch.zeros(VIEWS, 6, dtype=torch.float64)
    twists[2, 1] = math.radians(0.3)
    given = replace(poses, cam_from_world=Pose.exp(twists) @ poses.cam_from_world)
    options = SceneOptions(refine=("lines", "poses"), rounds=RoundOptions(min_rounds=1, max_rounds=1))
    pulled = reconstruct(found, given, cameras["cam0"], options, pose_sigma=(math.radians(0.02), 0.001))
    (told,) = [one for one in pulled.told if "Lines draw" in one]
    assert f"{poses.images[2]} farther from the given poses than the prior lets expect" in told


@pytest.mark.slow
def test_rough_poses_are_made_better_before_a_prior_holds_them(found: PhotoArcs, poses: ImagePoses, cameras: Calibration) -> None:
    true, sigma = poses.cam_from_world, (math.radians(1.0), 0.05)
    twists = torch.randn(VIEWS, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    twists *= torch.tensor([sigma[0]] * 3 + [sigma[1]] * 3, dtype=torch.float64)
    given = replace(poses, cam_from_world=Pose.exp(twists) @ true)
    options = SceneOptions(refine=("lines", "poses"), rounds=RoundOptions(max_rounds=4))
    held = reconstruct(found, given, cameras["cam0"], options, pose_sigma=sigma)
    assert not any("no prior holds" in one for one in held.told)
    assert held.poses.covariance is not None
    off = (held.poses.cam_from_world @ true.inverse()).log().numpy()
    squared = (off * np.linalg.solve(held.poses.covariance, off[..., None])[..., 0]).sum(-1)
    # Errors of six given poses that all photos share are not independent.
    assert squared.mean() < 12.0
    relative = [moved @ moved[0].inverse() for moved in (held.poses.cam_from_world, given.cam_from_world, true)]
    shape = [float((one @ relative[2].inverse()).log()[:, :3].norm()) for one in relative[:2]]
    assert shape[0] < 0.3 * shape[1]


def test_a_photo_that_lines_put_back_is_held_again(poses: ImagePoses) -> None:
    known = KnownPoses(poses, 1e-3, 1e-3)
    twist = torch.zeros(VIEWS, 6, dtype=torch.float64)
    twist[2, 0] = 0.1
    moved = replace(poses, cam_from_world=Pose.exp(twist) @ poses.cam_from_world)
    without = still_held(known, known, poses, moved, SceneOptions())
    assert without is not None and without.poses.images == tuple(np.delete(poses.images, 2))
    assert still_held(known, without, moved, moved, SceneOptions()) is without
    again = still_held(known, without, poses, poses, SceneOptions())
    assert again is not None and again.poses.images == poses.images
    # What lines tell poorly is no contradiction.
    unsure = replace(moved, covariance=np.tile(0.01 * np.eye(6), (VIEWS, 1, 1)))
    assert len(known.agreeing(unsure, 0.001).poses) == VIEWS and len(known.agreeing(moved, 0.001).poses) == VIEWS - 1


def test_a_scene_is_exported_from_memory_as_from_its_folder(scene: Scene, tmp_path: Path) -> None:
    scene.save(tmp_path / "scene")
    for given in (scene, tmp_path / "scene"):
        for name in ("lines.dxf", "transforms.json"):
            ol.export(given, tmp_path / ("memory" if given is scene else "folder") / name).save()
    for name in ("lines.dxf", "transforms.json"):
        assert (tmp_path / "memory" / name).read_bytes() == (tmp_path / "folder" / name).read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("verb", VERBS)
def test_the_example_of_a_verb_holds(
    verb: str, room: Path, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(room, "room")
    for name in ("calibration.yaml", "poses.csv"):
        shutil.copy(room.parent / name, "room")
    scene.save("scene")
    write_segments("unmatched.csv", replace(scene.segments, track=np.full(len(scene.segments), -1), tracks=()))
    function = getattr(ol, verb)
    assert "Raises " in str(inspect.getdoc(function))
    example = doctest.DocTestParser().get_doctest(str(inspect.getdoc(function)), {"ol": ol, "np": np}, verb, None, None)
    assert example.examples
    told: list[str] = []
    doctest.DocTestRunner().run(example, out=told.append)
    assert not told, "".join(told)


@pytest.mark.slow
def test_the_command_gives_the_same_lines(room: Path, scene: Scene, tmp_path: Path) -> None:
    reconstruct_photos([room], room.parent / "calibration.yaml", str(room.parent / "poses.csv"), tmp_path)
    scene.save(tmp_path / "api")
    assert (tmp_path / "lines.csv").read_bytes() == (tmp_path / "api" / "lines.csv").read_bytes()


def test_photos_in_memory_give_what_files_give(room: Path, cameras: Calibration, found: PhotoArcs, tmp_path: Path) -> None:
    photos = {ref.name: torch.as_tensor(read_photo(ref.path)) for ref in find_photos([room])[:2]}
    arcs = extract(photos, cameras, work=tmp_path)
    for one, other in zip(arcs.photos, found.photos, strict=False):
        np.testing.assert_array_equal(one.endpoints_px, other.endpoints_px)
        np.testing.assert_array_equal(one.colours, other.colours)
    assert len(arcs.segments) == len(arcs) > 50 and not arcs.skipped
    views = dict(rectify(photos, cameras, size=(64, 48)).pixels())
    assert len(views) == 2 and all(pixels.shape == (48, 64, 3) for pixels in views.values())


def test_photos_of_12_bits_in_16_show_the_arcs_of_those_of_8(room: Path, cameras: Calibration, found: PhotoArcs) -> None:
    dim = {ref.name: read_photo(ref.path).astype(np.uint16) * 16 for ref in find_photos([room])[:2]}
    for one, other in zip(extract(dim, cameras).photos, found.photos, strict=False):
        assert abs(len(one) - len(other)) < 0.05 * len(other) and len(other) > 20


@pytest.mark.slow
def test_matched_segments_take_the_place_of_arcs(scene: Scene, poses: ImagePoses, cameras: Calibration) -> None:
    again = reconstruct(scene.segments, poses, cameras)
    assert again.lines.tracks == scene.lines.tracks and not again.stages and again.families is None
    adjusted = adjust(scene.segments, poses, cameras, SceneOptions(refine=("lines", "poses")))
    assert adjusted.poses.covariance is not None and scene.poses.covariance is None
    assert adjusted.adjusted.rms_px() <= again.adjusted.rms_px() * 1.001
    with pytest.raises(InputError, match="`refine` with poses"):
        adjust(scene.segments, poses, cameras, SceneOptions(), pose_sigma=(0.01, 0.01))


def test_arrays_are_triangulated_as_tables_are(scene: Scene, poses: ImagePoses, cameras: Calibration) -> None:
    own = scene.segments
    rows = np.flatnonzero(own.track >= 0)
    place = [poses.images.index(image) for image in own.images]
    table = replace(own, image=own.image[rows], track=own.track[rows], endpoints_px=own.endpoints_px[rows],
                    covariance_px2=own.covariance_px2[rows])  # fmt: skip
    of_table = triangulate(table, poses, cameras, "dual")
    arrays = segments_of_arrays(
        torch.as_tensor(table.endpoints_px), table.image, table.track, covariance_px2=table.covariance_px2
    )
    of_arrays = triangulate(arrays, poses.cam_from_world[place], cameras["cam0"], "dual")
    torch.testing.assert_close(of_arrays.lines.direction, of_table.lines.direction, equal_nan=True)
    assert int(of_table.known.sum()) > 30
    with pytest.raises(InputError, match="a triangulation method among"):
        triangulate(table, poses, cameras, "best")
    for few in (poses.cam_from_world[:1], poses.cam_from_world[0]):
        with pytest.raises(InputError, match=rf"A pose of each of {len(poses)} photos was expected, found 1; give as many\."):
            triangulate(arrays, few, cameras)


@pytest.mark.slow
def test_segments_of_another_detector_take_the_place_of_arcs(
    room: Path, found: PhotoArcs, poses: ImagePoses, cameras: Calibration
) -> None:
    given = given_arcs(replace(found.segments, covariance_px2=None), room, cameras)
    assert len(given) == len(found) and "states no noise: 0.2 px" in given.notes[0]
    assert len(reconstruct(given, poses, cameras).lines) > 20


def test_poses_know_their_source_and_unit(found: PhotoArcs, room: Path, cameras: Calibration) -> None:
    posed = estimate_poses(found, cameras, room.parent / "poses.csv")
    assert (posed.source, posed.unit, len(posed.poses)) == ("table", LengthUnit.METRES, VIEWS)
    with pytest.raises(InputError, match="`pattern` was expected with `poses` boards"):
        estimate_poses(room, cameras, "sfm", pattern="checkerboard:8x6:30mm")
    with pytest.raises(InputError, match="`min_views` of 3 or more"):
        reconstruct(found, posed, cameras, SceneOptions(min_views=2))
    with pytest.raises(InputError, match="`refine` was expected to be lines"):
        reconstruct(found, posed, cameras, SceneOptions(refine=("walls",)))


def test_a_callback_that_raises_cancels(room: Path, cameras: Calibration, found: PhotoArcs, poses: ImagePoses) -> None:
    def stop(stage: str, done: int, total: int) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        extract(room, cameras, progress=stop)
    with pytest.raises(Cancelled):
        reconstruct(found, poses, cameras, progress=stop)


def test_arcs_are_kept_until_the_photo_the_options_or_the_code_change(
    room: Path, cameras: Calibration, found: PhotoArcs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos = [find_photos([room])[0]]
    extract(photos, cameras, work=tmp_path)
    kept = set((tmp_path / "arcs").iterdir())
    with monkeypatch.context() as patch:
        patch.setattr(arcs_module, "extract_arcs", None)
        again = extract(photos, cameras, work=tmp_path)
    np.testing.assert_array_equal(again.photos[0].endpoints_px, found.photos[0].endpoints_px)
    extract(photos, cameras, options=replace(arcs_module.SHORT_ARCS, min_length_px=40.0), work=tmp_path)
    with_options = set((tmp_path / "arcs").iterdir())
    assert len(kept) == 1 and len(with_options) == 2
    monkeypatch.setattr("omnilines.pipelines.kept_results.revision", lambda *packages: "another")
    extract(photos, cameras, work=tmp_path)
    assert len(set((tmp_path / "arcs").iterdir())) == 3


@pytest.mark.slow
def test_a_result_is_the_last_one_only_with_the_contents_it_had(room: Path, poses: ImagePoses, tmp_path: Path) -> None:
    table = shutil.copy(room.parent / "poses.csv", tmp_path)
    first = reconstruct_photos([room], room.parent / "calibration.yaml", table, tmp_path / "scene")
    stamp = Stamp(tmp_path / "scene" / "done.json", json.loads((tmp_path / "scene" / "done.json").read_text())["inputs"])
    known = stamp.result()
    assert known is not None and known.data == json.loads(json.dumps(first.data)) and known.files == first.files
    assert known.summaries == first.summaries and first.summaries[0].verdict and first.summaries[0].advice
    assert known.warnings == (NOTE, *first.warnings) and known.details == first.details and known.photos == first.photos
    assert Stamp(stamp.path, "other").result() is None
    lines = tmp_path / "scene" / "lines.csv"
    content = lines.read_bytes()
    # As many bytes, but others.
    lines.write_bytes(content[:-2] + (b"1" if content[-2:-1] != b"1" else b"2") + content[-1:])
    assert stamp.result() is None
    lines.write_bytes(content)
    assert stamp.result() is not None
    copied = shutil.copytree(tmp_path / "scene", tmp_path / "copied")
    again = Stamp(copied / "done.json", stamp.inputs).result()
    assert again is not None and {file.parent for file in again.files} == {copied} and again.report == copied / "report.html"
    (copied / "lines.csv").unlink()
    assert Stamp(copied / "done.json", stamp.inputs).result() is None and stamp.result() is not None
    lines.unlink()
    assert stamp.result() is None
    assert len(read_segments(tmp_path / "scene" / "segments.csv")) > 100
