"""Work that goes on while its results are used."""

import threading

import pytest

from omnilines import progress


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
