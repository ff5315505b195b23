"""Work that goes on while its results are used."""

import re
import threading
import time
from collections.abc import Callable

import pytest

from omnilines import progress
from omnilines.cli import progress as told


@pytest.mark.parametrize(("cores", "at_once", "begun"), [(1, 4, 1), (3, 4, 3), (8, 2, 2)])
def test_results_come_in_order_and_few_are_worked_on_ahead(
    cores: int, at_once: int, begun: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "cores", lambda: cores)
    lock, started, used = threading.Lock(), 0, 0

    def work(item: int) -> int:
        nonlocal started
        with lock:
            started += 1
            # The one that is handed over, and those that are worked on meanwhile.
            assert started - used <= begun + 1
        return 10 * item

    for result in progress.ahead(work, range(20), at_once):
        assert result == 10 * used
        used += 1
    assert used == started == 20


def test_an_error_ends_the_work() -> None:
    with pytest.raises(ZeroDivisionError):
        list(progress.ahead(lambda item: 1 // item, [1, 0, 1], 2))


def waited_for(said: Callable[[], str], what: str) -> str:
    """What is said until `what` is."""
    text, end = "", time.monotonic() + 20.0
    while what not in text and time.monotonic() < end:
        time.sleep(0.01)
        text += said()
    return text


def test_where_no_terminal_is_stages_have_lines_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(told, "LOOK_S", 0.05)
    monkeypatch.setattr(told, "AGAIN_S", 0.5)
    with told.progress() as tell:
        tell("finding arcs", 1, 3)
        text = waited_for(lambda: capsys.readouterr().err, "1 of 3")
        tell("matching\x1b[2J", 0, 0)
        text += waited_for(lambda: capsys.readouterr().err, "matching")
        # A round that comes again has no new name, but says every AGAIN_S how far it is.
        tell("finding arcs", 2, 3)
        text += waited_for(lambda: capsys.readouterr().err, "2 of 3")
    lines = text.splitlines()
    assert [re.sub(r"^\[0:\d\d\] ", "", line) for line in lines] == [
        "finding arcs: 1 of 3",
        "matching\\x1b[2J",
        "finding arcs: 2 of 3",
    ]


def test_a_stage_of_unknown_length_is_told_by_its_count_when_it_comes_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(told, "LOOK_S", 0.05)
    monkeypatch.setattr(told, "AGAIN_S", 0.1)
    with told.progress() as tell:
        text = ""
        for count in (3, 26):
            tell("adjusting the scene", count, 0)
            text += waited_for(lambda: capsys.readouterr().err, f"the scene: {count}")
            tell("clipping", 0, 0)
            text += waited_for(lambda: capsys.readouterr().err, "clipping")
    assert " of " not in text


def test_a_command_of_a_few_seconds_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with told.progress() as tell:
        tell("finding arcs", 1, 3)
        time.sleep(0.2)
    assert capsys.readouterr().err == "" and told.LOOK_S >= 5.0
