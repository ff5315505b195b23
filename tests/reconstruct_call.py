"""`omnilines reconstruct` of photos, in this process."""

from pathlib import Path

import pytest

from omnilines.cli import main


def call(photos: Path, room: Path, out: Path, *options: str, poses: str = "poses.csv") -> int | str | None:
    """The exit status, with the tables of the folder `room`."""
    source = room / poses if poses.endswith(".csv") or poses == "colmap" else poses
    arguments = ["reconstruct", photos, "--calibration", room / "calibration.yaml", "--poses", source, "--out", out, *options]
    with pytest.raises(SystemExit) as stopped:
        main([str(item) for item in arguments])
    return stopped.value.code
