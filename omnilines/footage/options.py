"""What decides which frames of a video are taken: frozen, the same for the Python API, the command line and sweeps."""

from dataclasses import dataclass

from camera_models.typed import Options


@dataclass(frozen=True, repr=False)
class FrameOptions(Options):
    """Of every video of a command."""

    most_of_target: int = 40
    """Frames that are taken at most of a target, for a calibration."""
    most_of_scene: int = 100
    """Frames that are taken at most of a scene, for arcs and lines."""
    looked_per_s: float = 4.0
    """Of so many frames of a second one, the stillest, is looked at closely."""
    most_looked: int = 200
    """Frames that are looked at closely at most; of a long video fewer of each second."""
    least_sharpness_share: float = 0.9
    """The stillest frame is taken among those with this share of the sharpness of the sharpest one near it."""
    step_share: float = 0.03
    """Of a scene, a frame is taken once what it shows has moved by this share of the image's width since the last one."""
    flow_width_px: int = 240
    """Width to which frames are reduced to measure how fast what they show moves."""
    frames_of_run: int = 5
    """Of the videos of a rig, so many consecutive frames are taken around each instant: they tell how the board moves, and with
    it how much earlier one camera began than another. 1: the instant alone."""
    follow: bool = False
    """Whether such runs are taken of one video too: they tell its rolling shutter (`calibrate` with `rolling_shutter`)."""
    max_moving_runs: int = 10
    """Of one video of a target, runs around the instants that move most, of those that were looked at, that are looked at for a
    rolling shutter and not taken; 0: none."""
    longest_run_s: float = 1.0
    """Runs that would last longer, of videos of a low rate, are not taken: they do not tell that."""
    most_runs: int = 24
    """Instants that are taken at most with their runs."""
    most_gap_share: float = 0.75
    """Of the time between two frames: frames of two cameras that are farther apart are not put together, since one was not
    recorded. The phase of cameras that run freely is 0.5 at most."""
    least_overlap: float = 0.5
    """Share of the shorter of two videos that the other shows too, at least."""
    significance: float = 1e-3
    """Probability that videos are shifted where the motion in them agrees by chance."""
