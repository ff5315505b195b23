"""Nothing that a stranger gives to a command destroys anything, crashes or passes: one sentence says what is wrong."""

from collections import Counter
from pathlib import Path

import pytest
from hostile import corpus_formats, corpus_idle, corpus_more, corpus_options, corpus_photos, corpus_scenes, corpus_tables
from hostile.case import Case, play

from camera_models.formats import FORMATS

PARTS = {
    "formats": corpus_formats,
    "tables": corpus_tables,
    "photos": corpus_photos,
    "options": corpus_options,
    "idle": corpus_idle,
    "more": corpus_more,
    "scenes": corpus_scenes,
}
CASES = [(f"{part}/{case.name}", case) for part, module in PARTS.items() for case in module.cases()]


USUAL = 560
"""Cases that are played by default, evenly spread over the corpus; the others with all Monte Carlo seeds."""


def parameter(index: int, name: str, case: Case) -> object:
    usual = (index + 1) * USUAL // len(CASES) > index * USUAL // len(CASES)
    return pytest.param(case, id=name, marks=() if usual else pytest.mark.full)


@pytest.mark.parametrize("case", [parameter(index, name, case) for index, (name, case) in enumerate(CASES)])
def test_case(case: Case, tmp_path: Path) -> None:
    play(case, tmp_path)


def test_the_corpus_is_whole() -> None:
    names = Counter(name for name, _ in CASES)
    assert len(CASES) >= 600 and [name for name, times in names.items() if times > 1] == []
    assert {entry.name for entry in FORMATS} == {own for _, own, _ in corpus_formats.FILES.values()}
    assert {case.arguments[0] for _, case in CASES} == {line[0] for line, _ in corpus_options.BASE.values()}
