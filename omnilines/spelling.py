"""How pages name the parameters that texts have in backticks: as in Python, or as the command that runs does."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_spelled: ContextVar[Callable[[str], str]] = ContextVar("spelled", default=str)


def spelled(name: str) -> str:
    """A parameter as whoever asked for the page names it."""
    return _spelled.get()(name)


def spelled_in(text: str) -> str:
    """A plain text with every parameter that whoever asked for the page names otherwise in that spelling."""
    return re.sub("`([^`<>]+)`", lambda name: name[0] if spelled(name[1]) == name[1] else spelled(name[1]), text)


@contextmanager
def spelled_as(spell: Callable[[str], str]) -> Iterator[None]:
    """Pages that are made meanwhile name parameters so."""
    before = _spelled.set(spell)
    try:
        yield
    finally:
        _spelled.reset(before)
