"""A session fed by a source: frames in this thread, calibrations in another."""

import threading
from collections.abc import Iterator

import numpy as np
from jaxtyping import UInt

from omnilines.guide.session import Session
from omnilines.progress import ProgressCallback, silent

REST_S = 0.05
"""Between two looks at whether a calibration is wanted, or done."""


def follow(
    session: Session,
    frames: Iterator[UInt[np.ndarray, "h w *channels"] | None],
    *,
    waits: bool,
    progress: ProgressCallback = silent,
) -> None:
    """Until the session is over or its source ends. `waits`: frames wait while the camera is being calibrated, as those of a
    video or a folder can."""
    ended = threading.Event()
    failure: list[BaseException] = []

    def calibrate() -> None:
        """Whenever frames were kept."""
        try:
            while not ended.is_set():
                if session.stale:
                    busy.set()
                    session.refit()
                busy.clear()
                ended.wait(REST_S)
        except BaseException as error:
            failure.append(error)
            session.over.set()

    busy = threading.Event()
    worker = threading.Thread(target=calibrate, daemon=True)
    worker.start()
    try:
        for pixels in frames:
            if session.over.is_set():
                break
            if pixels is not None:
                session.offer(pixels)
                progress(f"{session.message}; kept", len(session.kept), 0)
            while waits and (session.stale or busy.is_set()) and not session.over.is_set():
                ended.wait(REST_S)
    finally:
        ended.set()
        worker.join()
    if failure:
        raise failure[0]
