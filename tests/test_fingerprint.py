"""What results depend on: the source that made them, or the version, the files and the options."""

from importlib.metadata import version
from pathlib import Path

import pytest

from camera_models import InputError
from omnilines.files import fingerprint
from omnilines.files.fingerprint import content_hash, revision
from omnilines.files.fingerprint import fingerprint as made_from


def test_a_revision_is_of_the_source_and_else_the_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "one" / "part"
    package.mkdir(parents=True)
    (package / "a.py").write_text("A = 1\n")
    (tmp_path / "one" / "b.py").write_text("B = 1\n")
    monkeypatch.setattr(fingerprint, "SOURCES", tmp_path)
    seen = set()
    for name, text in (("part/a.py", "A = 1\n"), ("part/a.py", "A = 2\n"), ("part/new.py", ""), ("b.py", "B = 2\n")):
        (tmp_path / "one" / name).write_text(text)
        revision.cache_clear()
        seen.add(revision("one.part", "one.b"))
        assert revision("one.part", "one.b") in seen
    assert len(seen) == 4 and version("omnilines") not in seen
    revision.cache_clear()
    assert revision("one.absent") == version("omnilines")
    revision.cache_clear()
    first = made_from([tmp_path / "one" / "b.py"], "options", "1")
    assert len({first, made_from([], "options", "1"), made_from([tmp_path / "one" / "b.py"], "options", "2")}) == 3
    with pytest.raises(InputError, match="none does not exist"):
        content_hash(tmp_path / "none")
