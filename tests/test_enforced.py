"""What the tests enforce of every signature: the same as jaxtyping's own decorator with beartype, which is the truth here."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import beartype
import enforced
import jaxtyping
import numpy as np
import pytest
import torch
from jaxtyping import Float, Int
from torch import Tensor


def own(decorated: Any) -> Any:
    return jaxtyping.jaxtyped(typechecker=beartype.beartype)(decorated)


def jaxtypings(decorated: Any) -> Any:
    return enforced._jaxtyped(decorated, typechecker=beartype.beartype)


def test_the_import_hook_finds_it() -> None:
    assert jaxtyping.jaxtyped is enforced._enforced and jaxtypings is not own


def projected(points: Float[Tensor, "*batch n 3"], weights: Float[np.ndarray, " n"] | None = None) -> Float[Tensor, "*batch n 2"]:
    return points[..., :2]


def turned_over(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2"]:
    return points.T


def takes_two(left: Float[Tensor, "n 3"], right: Float[Tensor, "m 3"]) -> Float[Tensor, "n 2"]:
    return right[:, :2]


def counted(rows: Int[np.ndarray, " n"], *, most: int = 3, other: "Later | None" = None) -> list[int]:
    return rows[:most].tolist()


def doubled(scale: float, *more: float, **names: str) -> tuple[float, ...]:
    return (scale, *more, *map(float, names.values()))


def later() -> "Later":
    return 3


lenient = jaxtypings(later)


def pairs(values: Float[np.ndarray, "n 2"]) -> Iterator[Float[np.ndarray, "2"]]:
    yield from values


@dataclasses.dataclass(frozen=True)
class Record:
    """A record of arrays that belong together."""

    pixels: Float[np.ndarray, "n 2"]
    rows: Int[np.ndarray, " n"]
    name: str = ""


Later = Record
X, PIXELS, ROWS = torch.zeros(4, 3, dtype=torch.float64), np.zeros((4, 2)), np.arange(4)
CALLS: list[tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any], bool]] = [
    (projected, (X,), {}, True),
    (projected, (X[None], np.zeros(4)), {}, True),
    (projected, (X, np.zeros(5)), {}, False),
    (projected, (X[:, :2],), {}, False),
    (projected, (X.long(),), {}, False),
    (projected, (X.numpy(),), {}, False),
    (projected, (X, [0.0] * 4), {}, False),
    (projected, (X[0],), {}, False),
    (turned_over, (X,), {}, False),
    (turned_over, (X[:2, :].contiguous(),), {}, False),
    (counted, (ROWS,), {}, True),
    (counted, (ROWS,), {"most": 2}, True),
    (counted, (ROWS,), {"most": 2.0}, False),
    (counted, (ROWS.astype(float),), {}, False),
    (counted, (), {"rows": ROWS}, True),
    (counted, (), {"row": ROWS}, False),
    (doubled, (1.0, 2.0), {"a": "3"}, True),
    (doubled, (1.0, "2"), {}, False),
    (doubled, (1.0,), {"a": 3}, False),
    (pairs, (PIXELS,), {}, True),
    (pairs, (ROWS,), {}, False),
    (Record, (PIXELS, ROWS), {}, True),
    (Record, (PIXELS, ROWS), {"name": "a"}, True),
    (Record, (PIXELS, ROWS[1:]), {}, False),
    (Record, (PIXELS, ROWS), {"name": 1}, False),
]


@pytest.mark.parametrize(("function", "arguments", "names", "passes"), CALLS)
def test_what_is_refused_is_what_jaxtyping_refuses(function, arguments, names, passes) -> None:
    for decorate in (own, jaxtypings):
        fresh = dataclasses.dataclass(type(function.__name__, (), dict(vars(Record)))) if function is Record else function
        checked = decorate(fresh)
        # Twice: kinds of arrays that passed are remembered.
        for _ in range(2):
            if passes:
                checked(*arguments, **names)
            else:
                with pytest.raises((TypeError, beartype.roar.BeartypeCallHintViolation)):
                    checked(*arguments, **names)


def test_each_call_has_its_own_names_of_axes() -> None:
    checked = own(projected)

    @own
    def of_both(left: Float[Tensor, "n 3"], right: Float[Tensor, "m 3"]) -> Float[Tensor, "m 2"]:
        assert checked(left).shape == (len(left), 2)
        return checked(right)

    assert of_both(X, X[:2]).shape == (2, 2)
    with pytest.raises(beartype.roar.BeartypeCallHintReturnViolation):
        own(takes_two)(X, X[:2])


def test_what_is_named_before_it_is_there_is_checked_too() -> None:
    """jaxtyping lets everything pass for a class that does not exist yet, such as that of a method."""
    assert lenient() == 3
    with pytest.raises(beartype.roar.BeartypeCallHintReturnViolation):
        own(later)()


def test_a_failed_check_names_no_axis() -> None:
    """Of an annotation with alternatives the first may fit in part: what it bound must not hold for the second."""

    @own
    def either(values: Float[np.ndarray, "n 2"] | Float[np.ndarray, "3 n"], rows: Int[np.ndarray, " n"]) -> None: ...

    for _ in range(2):
        either(np.zeros((4, 2)), ROWS)
        either(np.zeros((3, 4)), ROWS)
        with pytest.raises(beartype.roar.BeartypeCallHintParamViolation):
            either(np.zeros((3, 5)), ROWS)


def test_annotations_and_names_stay_as_they_are_written() -> None:
    checked = own(counted)
    assert checked.__name__ == "counted" and checked.__annotations__ == counted.__annotations__
    assert checked.__wrapped__ is counted


def test_of_many_calls_with_arguments_of_one_kind_some_are_checked() -> None:
    """The first ones, then every so manieth: what is wrong each time is found all the same; another kind is checked at once, or
    of a function that is called often soon."""
    checked = own(projected)
    for _ in range(enforced.MOST + 1):
        checked(X, np.zeros(4))
    for _ in range(enforced.EVERY - 1):
        checked(X, np.zeros(5))
    for _ in range(2):
        with pytest.raises(beartype.roar.BeartypeCallHintParamViolation):
            checked(X, np.zeros(5))
    with pytest.raises(beartype.roar.BeartypeCallHintParamViolation):
        checked(X.long(), np.zeros(4))
    for _ in range(enforced.OFTEN):
        checked(X, np.zeros(4))
    with pytest.raises(beartype.roar.BeartypeCallHintParamViolation):
        for _ in range(enforced.EVERY):
            checked(X.long(), np.zeros(4))
