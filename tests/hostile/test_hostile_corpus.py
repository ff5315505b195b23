"""Nothing that a stranger gives to a command destroys anything, crashes or passes: one sentence says what is wrong."""

from collections import Counter
from pathlib import Path

import pytest
from hostile import corpus_formats, corpus_options, corpus_photos, corpus_tables
from hostile.case import Case, play

PARTS = {"formats": corpus_formats, "tables": corpus_tables, "photos": corpus_photos, "options": corpus_options}
CASES = [(f"{part}/{case.name}", case) for part, module in PARTS.items() for case in module.cases()]


@pytest.mark.parametrize("case", [pytest.param(case, id=name) for name, case in CASES])
def test_case(case: Case, tmp_path: Path) -> None:
    play(case, tmp_path)


def test_names_are_their_own() -> None:
    assert [name for name, times in Counter(name for name, _ in CASES).items() if times > 1] == []
