"""Helpers whose sums the compiler may reorder are part of their callers, so that the first run gives what the next one does."""

import ast
from collections import defaultdict
from pathlib import Path

import omnilines

PACKAGE = Path(omnilines.__file__).parent
SAME_NAME = {("least_squares/band.py", "_solve")}
"""Called from Python only; compiled functions of other modules have helpers of that name."""


def compiled_functions() -> dict[tuple[str, str], ast.FunctionDef]:
    return {
        (path.relative_to(PACKAGE).as_posix(), node.name): node
        for path in sorted(PACKAGE.rglob("*.py"))
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef) and any(ast.unparse(one).startswith("njit") for one in node.decorator_list)
    }


def test_helpers_with_reordered_sums_are_inlined() -> None:
    """A process that compiles such a helper calls its own copy; one that loads the caller from the cache calls the copy that was
    optimised within it: sums in another order, other last digits."""
    functions = compiled_functions()
    callers = defaultdict(set)
    for key, node in functions.items():
        for call in ast.walk(node):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name):
                callers[call.func.id].add(key)
    reordered = {
        key: "".join(ast.unparse(one) for one in node.decorator_list)
        for key, node in functions.items()
        if any(word in ast.unparse(one) for one in node.decorator_list for word in ("fastmath", "REORDERED"))
    }
    assert len(reordered) > 30
    helpers = {key: how for key, how in reordered.items() if callers[key[1]] - {key}}
    assert len(helpers) > 20
    assert not {key for key, how in helpers.items() if "forceinline" not in how and "REORDERED" not in how} - SAME_NAME
