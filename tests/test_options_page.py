"""docs/options.md lists every option of every stage with the default and the sentence that it has."""

import ast
import re
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

from omnilines.options import names_of, walk
from omnilines.pages.options import STAGES, options_of, with_options

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "options.md"


def test_the_page_is_up_to_date() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert page == with_options(page), "run: python -m omnilines.pages.options docs/options.md"


def test_every_option_has_a_name_of_its_own_and_a_sentence() -> None:
    rows = [(name, sentence) for stage, _ in STAGES for name, _, sentence in walk(options_of(stage), f"{stage}.")]
    assert len({name for name, _ in rows}) == len(rows) > 100
    assert [name for name, sentence in rows if not sentence.endswith(".")] == []
    assert [name for name, _ in rows if not re.fullmatch(r"[a-z0-9_.]+", name)] == []


def test_every_stage_is_listed() -> None:
    """The options of a stage are a frozen dataclass; those of studies are no part of the product."""
    found = set()
    for package in ("camera_models", "calib_patterns", "omnilines"):
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            if "studies" not in parts:
                module = ".".join(parts)
                found |= {f"{module}:{node.name}" for node in ast.parse(path.read_text()).body if is_options(node)}
    listed = {place for stage, _ in STAGES for place in places(options_of(stage))}
    assert found == listed | {"camera_models.typed:Options"}  # the base of them all


def places(options: Any) -> set[str]:
    """Where the class of some options is, and those of the dataclasses that are its groups."""
    groups = [getattr(options, name) for name in names_of(options)]
    inner = [places(group) for group in groups if is_dataclass(group)]
    return {f"{type(options).__module__}:{type(options).__name__}"}.union(*inner)


def is_options(node: ast.stmt) -> bool:
    """Whether a statement is the class of a stage's options."""
    return isinstance(node, ast.ClassDef) and node.name.endswith("Options") and bool(node.decorator_list)
