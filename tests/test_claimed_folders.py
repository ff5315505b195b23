"""No result goes over an input, or over a file that is not a result itself; sets of results are new as a whole or not at all."""

import contextlib
import json
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest
from hostile.good import give

from camera_models.errors import InputError
from camera_models.formats import disk
from camera_models.formats.disk import MANIFEST, MOVING, own_folder, read_text, write_atomically
from omnilines import cli
from omnilines.cli._shared import run
from omnilines.commands.result import CommandResult
from omnilines.files import find_photos
from omnilines.files.folders import check_results, check_work_folder, work_folder, written
from omnilines.files.sets import claimed, settle
from omnilines.progress import ProgressCallback


def put(out: Path, names: Iterable[str], content: str = "1", by: str = "test", kept: Iterable[str] = ()) -> None:
    """A run that writes these files."""
    with claimed(out, names, by=by, kept=kept) as folder:
        for name in names:
            write_atomically(folder / name, content)


def everything(folder: Path) -> dict[str, str]:
    """What lies in a folder, its list but for what it names aside."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != MANIFEST]
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


def test_a_new_folder_is_made_and_lists_what_was_written(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    put(out, ["lines.csv", "pictures/0.png"])
    assert list(written(out)) == ["lines.csv", "pictures/0.png"]
    put(out, ["lines.csv", "report.html"], "2", by="another")
    assert list(written(out)) == ["lines.csv", "pictures/0.png", "report.html"]
    assert everything(out) == {"lines.csv": "2", "pictures/0.png": "1", "report.html": "2"}
    assert oct((out / "pictures/0.png").stat().st_mode & 0o777) == oct(0o666 & ~umask())


def umask() -> int:
    """Of this process."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_what_a_run_does_not_write_again_is_removed_but_for_what_was_changed_or_kept(tmp_path: Path) -> None:
    put(tmp_path, ["a.csv", "old/b.csv", "changed.csv", "kept.csv"])
    put(tmp_path, ["other.csv"], by="other")
    (tmp_path / "changed.csv").write_text("mine")
    (tmp_path / "notes.txt").write_text("mine")
    put(tmp_path, ["a.csv"], "2", kept=["kept.csv"])
    assert everything(tmp_path) == {"a.csv": "2", "changed.csv": "mine", "kept.csv": "1", "notes.txt": "mine", "other.csv": "1"}
    assert not (tmp_path / "old").exists() and list(written(tmp_path)) == ["a.csv", "kept.csv", "other.csv"]


def test_what_is_removed_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def command(names: list[str]) -> Callable[[ProgressCallback], CommandResult]:
        """That writes these files and has nothing to say."""

        def ran(_: ProgressCallback) -> CommandResult:
            put(tmp_path, names)
            return CommandResult((), {})

        return ran

    for names, gone in ((["a.csv", "colmap/b.txt", "c.rrd"], ""), (["a.csv"], "c.rrd colmap/b.txt"), (["a.csv"], "")):
        run(command(names), as_json=True)
        told = "".join(f"{tmp_path / name}, " for name in gone.split())[:-2]
        wanted = f"{told} of an earlier run, which this one does not write, are removed." if gone else ""
        said = capsys.readouterr()
        assert json.loads(said.out)["notes"] == ([wanted] if gone else []) and wanted in said.err


def test_a_list_that_lies_removes_nothing_outside(tmp_path: Path) -> None:
    out = tmp_path / "out"
    put(out, ["a.csv"])
    (tmp_path / "precious").write_text("1")
    (out / "link").symlink_to(tmp_path)
    sha = written(out)["a.csv"].sha256
    rows = {name: {"by": "test", "sha256": sha} for name in ("../precious", str(tmp_path / "precious"), "link/precious")}
    (out / MANIFEST).write_text(json.dumps({"written": rows}))
    put(out, ["b.csv"])
    assert (tmp_path / "precious").read_text() == "1" and (out / "link").is_symlink()


def test_a_file_of_the_user_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("mine")
    with pytest.raises(InputError, match=r"found .*report\.html, which is not in"):
        put(tmp_path, ["lines.csv", "report.html"])
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_a_file_that_came_meanwhile_is_not_written_over(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"lines\.csv, which is not in"), claimed(tmp_path, ["lines.csv"], by="test") as folder:
        write_atomically(folder / "lines.csv", "1")
        (folder / "lines.csv").write_text("mine")
    assert everything(tmp_path) == {"lines.csv": "mine"} and len(list(tmp_path.iterdir())) == 1


def test_an_input_is_not_written_over_even_if_it_is_a_result_of_before(tmp_path: Path) -> None:
    put(tmp_path, ["calibration.yaml"])
    put(tmp_path, ["calibration.yaml"])
    (tmp_path / "link.yaml").symlink_to("calibration.yaml")
    for given in ("calibration.yaml", "link.yaml"):
        with pytest.raises(InputError, match="without the inputs"):
            check_results(tmp_path, ["calibration.yaml"], [tmp_path / given])


def test_the_truth_of_rendered_photos_stays(tmp_path: Path) -> None:
    """Where photos are calibrated into their own folder; a page by itself is made again at will."""
    put(tmp_path, ["calibration.yaml", "report.html"], "truth", by="render")
    refused = r"A place for results was expected, found .*calibration\.yaml, which `render` wrote; give another"
    with pytest.raises(InputError, match=refused):
        put(tmp_path, ["calibration.yaml"])
    with pytest.raises(InputError, match=refused):
        check_results(tmp_path, ["calibration.yaml"])
    put(tmp_path, ["report.html"], "page", by="page report.html")
    assert everything(tmp_path) == {"calibration.yaml": "truth", "report.html": "page"}
    (tmp_path / "calibration.yaml").unlink()
    put(tmp_path, ["calibration.yaml"], "2")
    assert everything(tmp_path)["calibration.yaml"] == "2"


def test_nothing_goes_through_links_or_out_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out/pictures").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "out/file").write_text("mine")
    with pytest.raises(InputError, match="is a link out of it"):
        put(tmp_path / "out", ["pictures/0.png"])
    for name in ("../x.csv", "/tmp/x.csv", "a/../../x.csv"):
        with pytest.raises(InputError, match="leads out of it"):
            put(tmp_path / "out", [name])
    with pytest.raises(InputError, match="is no folder"):
        put(tmp_path / "out", ["file/0.png"])
    (tmp_path / "out/lines.csv").symlink_to("nowhere")
    with pytest.raises(InputError, match="which is not in"):
        put(tmp_path / "out", ["lines.csv"])
    assert not list((tmp_path / "elsewhere").iterdir())


def test_pictures_are_not_written_among_the_photos(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    for out in (tmp_path / "photos", tmp_path / "photos/views"):
        with pytest.raises(InputError, match="taken for photos"):
            check_results(out, ["0.png"], [tmp_path / "photos"])
    check_results(tmp_path / "photos/tables", ["segments.csv"], [tmp_path / "photos"])


@pytest.mark.parametrize("content", ["", "[]", '{"written": 3}', '{"written": {"a.csv": null}}', "[" * 100000, "\x00"])
def test_a_damaged_list_names_nothing(content: str, tmp_path: Path) -> None:
    (tmp_path / MANIFEST).write_text(content)
    (tmp_path / "a.csv").write_text("mine")
    assert written(tmp_path) == {}
    with pytest.raises(InputError):
        put(tmp_path, ["a.csv"])
    put(tmp_path, ["b.csv"])
    assert list(written(tmp_path)) == ["b.csv"]


def test_a_set_that_fails_changes_nothing(tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    with pytest.raises(InputError, match="torn"), claimed(out, ["a.png"], by="test") as folder:
        write_atomically(folder / "a.png", "1")
        raise InputError("torn")
    assert list(tmp_path.iterdir()) == []
    put(out, ["a.png", "b.png"])
    before = everything(tmp_path), (out / MANIFEST).read_text()
    with pytest.raises(InputError, match="torn"), claimed(out, ["a.png", "c.png"], by="test") as folder:
        write_atomically(folder / "a.png", "2")
        write_atomically(folder / "c.png", "2")
        raise InputError("torn")
    assert (everything(tmp_path), (out / MANIFEST).read_text()) == before and not disk.staged


def test_a_set_within_a_set_is_a_part_of_it(tmp_path: Path) -> None:
    with claimed(tmp_path, ["a.csv", "report.html"], by="whole") as folder:
        put(folder, ["a.csv"], by="part")
        assert not (folder / "a.csv").exists()
        write_atomically(folder / "report.html", "2")
    assert {row.by for row in written(tmp_path).values()} == {"whole"} and len(everything(tmp_path)) == 2


class Ended(BaseException):
    """As a signal ends a process."""


def interrupted(out: Path, at: int, monkeypatch: pytest.MonkeyPatch) -> bool:
    """A run that ends at one of the moments at which it moves results, and leaves its clearing up undone; whether it did."""
    moves = iter(range(1000))

    def moment(when: str, path: Path) -> None:
        if when in ("whole", "removing", "moving") and next(moves) >= at:
            raise Ended

    with monkeypatch.context() as patch:
        patch.setattr(disk, "moment", moment)
        patch.setattr("omnilines.files.sets.shutil.rmtree", lambda *_, **__: None)
        try:
            put(out, ["a.csv", "b.csv", "sub/c.csv"], "new")
        except Ended:
            return True
    return False


OLD = {"a.csv": "old", "b.csv": "old", "gone.csv": "old"}
NEW = {"a.csv": "new", "b.csv": "new", "sub/c.csv": "new"}


@pytest.mark.parametrize("at", range(6))
def test_a_move_that_was_interrupted_is_named_to_readers_and_finished_by_the_next_run(
    at: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(tmp_path, OLD, "old")
    assert interrupted(tmp_path, at, monkeypatch)
    waits = (tmp_path / MOVING).exists()
    assert waits == (at > 0)
    read = {}
    for name in {*OLD, *NEW}:
        try:
            read[name] = read_text(tmp_path / name)
        except InputError as error:
            assert "run its command again" in str(error) or "does not exist" in str(error)
    assert {content for name, content in read.items() if name in NEW} <= ({"new"} if waits else {"old"})
    put(tmp_path, ["x.csv"], "x", by="another")
    assert everything(tmp_path) == {**(NEW if waits else OLD), "x.csv": "x"}
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".") and path.name != MANIFEST]


def test_there_are_as_many_moments_as_are_tried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put(tmp_path, OLD, "old")
    assert not interrupted(tmp_path, 6, monkeypatch)


def test_what_waits_in_a_strange_folder_is_not_moved_out_of_it(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out" / MOVING / "link").mkdir(parents=True)
    (tmp_path / "out" / MOVING / "link/a.csv").write_text("theirs")
    (tmp_path / "out/link").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="is a link out of it"):
        settle(tmp_path / "out")
    assert not list((tmp_path / "elsewhere").iterdir())


@pytest.mark.parametrize("name", ["calibration.yaml", MANIFEST])
def test_what_waits_and_is_no_file_is_not_moved(name: str, tmp_path: Path) -> None:
    (tmp_path / MOVING).mkdir()
    (tmp_path / MOVING / "a.csv").write_text("new")
    os.mkfifo(tmp_path / MOVING / name)
    with pytest.raises(InputError, match=f"{name}, which is none"):
        settle(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [MOVING]


def test_what_is_kept_goes_into_a_folder_of_its_own(tmp_path: Path) -> None:
    work = tmp_path / "work"
    check_work_folder(work)
    assert work_folder(work) == work_folder(work) and (work / MANIFEST).is_file()
    (work / "poses.csv").write_text("kept")
    check_work_folder(work, [tmp_path / "poses.csv"])
    with pytest.raises(InputError, match="Inputs were expected outside of"):
        check_work_folder(work, [work / "poses.csv"])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not of an earlier run"):
        work_folder(tmp_path / "mine")


def test_a_run_beside_keeps_its_folder_and_what_a_killed_one_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / "colmap.dead0000/mapper").mkdir(parents=True)
    (tmp_path / "colmap.txt").write_text("mine")
    with own_folder(tmp_path, "colmap.") as first, own_folder(tmp_path, "colmap.") as second:
        assert first != second and first.is_dir() and not (tmp_path / "colmap.dead0000").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["colmap.txt"]


@pytest.mark.parametrize("how", ["has it", "had it"])
def test_a_folder_that_a_run_beside_takes_for_a_left_one_is_made_again(
    how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the moment before it is locked."""
    taken: list[Path] = []
    real = disk.locked

    @contextlib.contextmanager
    def locked(folder: Path, wait: bool = False) -> Iterator[None]:
        if folder != tmp_path and not taken:
            taken.append(folder)
            folder.rmdir()
            if how == "has it":
                raise BlockingIOError
            yield
        else:
            with real(folder, wait):
                yield

    monkeypatch.setattr(disk, "locked", locked)
    with claimed(tmp_path, ["a.csv"], by="test") as folder:
        assert len([path for path in folder.iterdir() if path.is_dir()]) == 1
        write_atomically(folder / "a.csv", "1")
    assert taken and everything(tmp_path) == {"a.csv": "1"}


def test_folders_are_not_refused_for_what_runs_beside_do_in_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work = tmp_path / "work"
    (work / ".omnilines.abcd0123.part").mkdir(parents=True)  # a look whether it can be written to
    (work / "..omnilines.json.abcd0123.part").write_text("")  # its list, half written
    check_work_folder(work)
    assert work_folder(work) == work

    def gone(folder: Path) -> None:
        """Another run has removed it, as one left behind."""
        os.rmdir(folder)
        raise FileNotFoundError(folder)

    monkeypatch.setattr(Path, "rmdir", gone)
    check_results(tmp_path, ["a.csv"])


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="a file system where nothing can be made: /proc, of Linux")
def test_a_folder_that_only_seems_writable_is_named_before_any_work() -> None:
    """To root every folder does; one on a file system of another kind, or of another machine, may be none."""
    with pytest.raises(InputError, match=r"expected at /proc/omnilines, found that .*/proc.*; name another"):
        check_results("/proc/omnilines", ())


def test_a_command_runs_again_in_its_folder_beside_files_of_the_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    give("omnilines", "photos")(tmp_path)
    monkeypatch.chdir(tmp_path)

    def views(*more: str) -> tuple[int, list[str]]:
        """The exit status of a run, and what lies in its folder."""
        with pytest.raises(SystemExit) as ended:
            cli.main(["rectify", *more, "--calibration", "IN/calibration.yaml", "--size", "64x48", "--out", "OUT"])
        return int(ended.value.code or 0), sorted(path.name for path in Path("OUT").iterdir() if path.name != MANIFEST)

    assert views("IN/photos") == (0, ["0.png", "1.png", "2.png", "calibration.yaml"])
    Path("OUT/notes.txt").write_text("mine")
    # Photos one by one through the same camera; through another, the earlier views are no longer of this calibration.yaml.
    assert views("IN/photos/1.png") == (0, ["0.png", "1.png", "2.png", "calibration.yaml", "notes.txt"])
    assert views("IN/photos/1.png", "--fov-deg", "70") == (0, ["1.png", "calibration.yaml", "notes.txt"])
    # A folder of a version that kept no list.
    Path("OUT", MANIFEST).unlink()
    assert views("IN/photos/1.png", "--fov-deg", "60") == (2, ["1.png", "calibration.yaml", "notes.txt"])


def test_photos_that_wait_to_be_moved_are_not_taken_for_a_whole_set(tmp_path: Path) -> None:
    (tmp_path / MOVING / "left").mkdir(parents=True)
    (tmp_path / "left").mkdir()
    for name in ("left/0.png", "left/1.png", f"{MOVING}/left/1.png"):
        (tmp_path / name).write_bytes(b"")
    for given in ([tmp_path], [tmp_path / "left"], [tmp_path / "left/1.png"]):
        with pytest.raises(InputError, match=r"left/1\.png was expected to be whole"):
            find_photos(given)
    assert len(find_photos([tmp_path / "left/0.png"])) == 1
