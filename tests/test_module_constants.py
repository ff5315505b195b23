"""Numbers that decide behaviour are options, which users, sweeps and cache keys reach; a module's constants are numerics.

`tests/module_constants/PACKAGE.yaml` names every number that a module of the product holds: under `numerics` what changes no
result within reason (the layout of arrays, sizes of batches and tables, steps and tolerances of iterations that converge, guards
against division by zero, constants of mathematics, of formats and of what is drawn), under `behaviour` the rest.
"""

import ast
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
REGISTER = Path(__file__).parent / "module_constants"
PARTS = (
    "geometry",
    "costs",
    "least_squares",
    "triangulation",
    "adjustment",
    "structure",
    "extraction",
    "footage",
    "matching",
    "posing",
)
PACKAGES = ("camera_models", "calib_patterns", *(f"omnilines/{part}" for part in (*PARTS, "calibration", "pipelines")))
MOST_BEHAVIOUR = 99


def is_number(value: ast.expr) -> bool:
    """Whether an expression is made of numbers alone: literals, tuples, arithmetic and calls of functions of numbers."""
    leaves = [node for node in ast.walk(value) if isinstance(node, ast.Constant)]
    forbidden = (ast.Dict, ast.List, ast.Set, ast.Lambda, ast.JoinedStr, ast.ListComp, ast.DictComp, ast.Subscript)
    numbers = [leaf for leaf in leaves if isinstance(leaf.value, int | float) and not isinstance(leaf.value, bool)]
    return bool(numbers) and len(numbers) == len(leaves) and not any(isinstance(node, forbidden) for node in ast.walk(value))


def numbers_of(path: Path) -> set[str]:
    """Names in capitals that a module gives to numbers."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        value = getattr(node, "value", None)
        for target in targets:
            names = target.elts if isinstance(target, ast.Tuple) else [target]
            values = value.elts if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) else [value] * len(names)
            pairs = zip(names, values, strict=True)
            found |= {
                n.id for n, v in pairs if isinstance(n, ast.Name) and n.id == n.id.upper() and v is not None and is_number(v)
            }
    return found


def register(package: str) -> dict[str, dict[str, list[str]]]:
    """What is known of the constants of a package: kind -> module -> names."""
    kinds = yaml.safe_load((REGISTER / f"{package.replace('/', '.')}.yaml").read_text())
    return {kind: {module: names.split() for module, names in (kinds[kind] or {}).items()} for kind in ("numerics", "behaviour")}


@pytest.mark.parametrize("package", PACKAGES)
def test_every_number_of_a_module_is_known_as_numerics_or_behaviour(package: str) -> None:
    known = register(package)
    listed = {(module, name) for kind in known.values() for module, names in kind.items() for name in names}
    twice = sum(len(names) for kind in known.values() for names in kind.values()) - len(listed)
    paths = sorted((ROOT / package).rglob("*.py"))
    there = {(path.relative_to(ROOT / package).as_posix(), name) for path in paths for name in numbers_of(path)}
    assert listed == there, f"unknown: {sorted(there - listed)}; gone: {sorted(listed - there)}"
    assert not twice


def test_few_constants_decide_behaviour() -> None:
    assert sum(len(names) for package in PACKAGES for names in register(package)["behaviour"].values()) <= MOST_BEHAVIOUR
