"""How a line scene is made of arcs and poses."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from camera_models.typed import Options
from omnilines.adjustment.options import AdjustmentOptions
from omnilines.matching.options import MatchingOptions
from omnilines.posing.options import PosingOptions
from omnilines.structure.options import StructureOptions


class RoughPoseOptions(NamedTuple):
    """When poses that were given are replaced by better ones before lines are matched (`better_poses`)."""

    min_gain: float = 1.1
    """Times as far that lines have to stand out under other poses for these to be taken."""
    rough_px: float = 1.6
    """Error of poses from which on they are rough: matching among near edges is then beyond telling apart."""
    rough_turns: float = 2.0
    """Where lines stand out as much when each camera is turned by so many times that error, poses are rough, whatever slack the
    arcs ask for."""
    outlying: float = 3.0
    """Times the median distance from the given places at which a photo has no say in where the others are."""


class RoundOptions(NamedTuple):
    """How often arcs are matched where poses are refined."""

    min_rounds: int = 2
    """Least number of rounds."""
    max_rounds: int = 12
    """Most rounds."""
    min_gain: float = 1.01
    """Times the arcs that tracks had a round before from which on another round is worth its time."""
    same_slack: float = 0.5
    """Times the slack of a round before below which poses have become better, and another round is worth its time."""


class KeptLineOptions(NamedTuple):
    """Which lines are kept, and how."""

    max_rms_tolerances: float = 3.0
    """A line is dropped whose arcs lie farther from it (RMS) than so many times the tolerance, or `max_rms_px`."""
    max_rms_px: float = 1.5
    """A line whose arcs lie nearer to it (RMS) is never dropped for that."""
    max_chance: float = 1e-3
    """A line is dropped that photos would show with a larger probability if it were not there."""
    min_shown_share: float = 0.0
    """A line is dropped of which the photos that look where it is show a smaller share (`shown_share` in `lines.csv`): about what
    a photo that had no part in it shows, or more."""
    max_chance_share: float = 0.3
    """A line is dropped where a larger share of those like it are there by chance (`chance_share` in `lines.csv`): photos left
    out miss two to three times as many. With 1 none is dropped."""
    min_moved_rad: float = math.radians(2.0)
    """To tell that, each photo is moved by so much or more, seen from the lines that it shows: arcs then fit each other by chance
    alone."""
    max_moved_rad: float = math.radians(4.0)
    """The most that photos are moved for that: what they have in common hardly changes."""
    min_length_sigmas: float = 3.0
    """A line shorter than so many standard deviations of its ends across it has no direction."""
    guided_by_families: bool = True
    """A line takes the direction of its family of parallel lines into account, as far as its own is less certain than
    `structure.families.tolerance_rad`."""
    guided_by_planes: bool = True
    """A line takes the planes of the lines beside it into account, as far as lines of this scene lie in the planes of their
    neighbours (`structure.planes`)."""
    guided_by_corners: bool = True
    """A line takes the lines into account that end where it does in several photos, as far as lines of this scene that end
    together meet (`structure.corners`)."""
    min_meeting: float = 0.95
    """A line of one photo fewer than `min_views` (never fewer than 3) is kept where it meets one of the others in a corner
    (`structure.corners`) with a larger probability; with 1 none is."""
    min_lying: float = 0.8
    """Such a line is kept, too, where it lies in the plane of one of the others beside it (`structure.planes`) with a larger
    probability; with 1 none is."""


class FrameOptions(NamedTuple):
    """The frame that a scene is written in."""

    z_up_rad: float = math.radians(5.0)
    """A vertical so near to z is z."""


class AdviceOptions(NamedTuple):
    """When photos, or the scene as a whole, are said to have few arcs that lines explain (`advice`)."""

    hardly_explained: float = 0.4
    """Of the share of arcs that lines explain in the median photo: below it a photo is named."""
    few_explained: float = 0.3
    """Share of the arcs of the median photo below which the scene as a whole is spoken of."""
    poor_tolerance_px: float = 0.8
    """Error of poses and calibration from which on they are what loses arcs."""
    many_by_chance: float = 0.05
    """Share of the lines that are there by chance above which it is spoken of."""
    significance: float = 0.001
    """Lines and points leave a camera possible that chance makes more often than this, with `calibration_noise`."""
    calibration_noise: float = 2.0
    """Times that what lines and points ask of a camera is taken to be noisier than is stated: arcs of real edges err alike."""
    calibration_slack: float = 3.0
    """Lines or points contradict the calibration where every possible camera moves the image by more than so many times the slack
    that was taken for errors of poses and calibration."""
    detector_error_px: float = 0.125
    """In place of that slack where segments were matched by others: an error that all segments of a detector have in common
    (OpenCV's LSD places edges so far to the left and up)."""
    start_rad: float = math.radians(2.5)
    """Turns about each axis from which a better pose is looked for."""
    still: float = 0.3
    """Share of the arcs in no line that do not move in the image, while the lines do, above which the camera is said to have
    stood still (0.4 in two real sets where it did, up to 0.2 in others)."""


class MovedOptions(NamedTuple):
    """When photos are named whose refined poses lie far from those given (`photos_far_from_given`)."""

    times: float = 10.0
    """Times the median turn, or move, of all photos from which on one is named."""
    outlying: float = 3.0
    """Times that median from which on a photo has no say in where the others are."""
    sigmas: float = 5.0
    """Standard deviations of its refined pose that it has to move as well."""
    least_rad: float = math.radians(0.5)
    """Smaller turns are not named, whatever the others do."""
    least_share: float = 0.01
    """Smaller moves are not named, as a share of the root mean square distance of the photos from their middle."""
    slipped_times: float = 5.0
    """A pose found is the one given for another photo where that is so many times nearer than its own."""
    slipped_share: float = 0.8
    """Share of the photos whose poses are those given one row below, or above, from which on rows slipped."""
    least_photos: int = 5
    """With fewer photos (instants of a rig) nothing is said: each has a say in where the others are."""


class SamePlaceOptions(NamedTuple):
    """When a photo is left out, as another one shows the same from the same place."""

    shown: float = 0.5
    """Share of its arcs that the other has to show where they are, as seen in the world: of a photo saved twice it is 0.8, of
    places apart that of what is far away, or lies along the way from one to the other (up to 0.3 in a flat)."""
    near_px: float = 10.0
    """By how much the distance of both may move, in the image, what is as far away as photos are from their middle: edges of
    things far away stay where they are between places apart, too."""


class JudgeOptions(NamedTuple):
    """When poses, cameras and tracks are refused because they do not belong together."""

    fitting_px: float = 1.0
    """Misfit of half of the tracks up to which nothing is asked: no choice of segments at random has it."""
    rough_px: float = 3.0
    """Misfit of half of the tracks from which on it is spoken of, times their stated noise where that is more than 1 px."""
    rough_share: float = 0.005
    """The same as a share of the longer side of an image, from which on lines do not hold (exit status 1)."""
    far_photo: float = 3.0
    """Times as far from their lines as those of the median photo, from which on the segments of a photo are spoken of."""
    max_chance: float = 0.02
    """They are refused where as much would be explained by chance with a larger probability."""
    sure: float = 1e-4
    """Probability up to which another reading of the poses is no chance."""
    gain: float = 2.0
    """Times as much that another reading of the poses has to explain, and that other photos explain of a photo that is named."""
    stands_out: float = 2.5
    """Times as many standard deviations, beyond chance, that a reading of the poses of photos has to have as any other."""
    beyond_share: float = 0.02
    """Of the longer side of an image, by which segments may end outside of it: detectors draw lines on, crops cut a few rows."""
    far_m: float = 100.0
    """Distance of the lines from the cameras from which on it is asked whether lengths are in millimetres."""
    near_m: float = 0.005
    """Distance below which it is asked what lengths are in: no lens focuses there."""
    fitting: float = 10.0
    """Times the median misfit (squared) of a reading up to which a track is explained: 13.8 over 1.39, of chi-square with two
    degrees of freedom."""


@dataclass(frozen=True, repr=False)
class SceneOptions(Options):
    """How a line scene is made."""

    refine: tuple[str, ...] = ("lines",)
    """What the adjustment refines: lines, with any of poses, intrinsics and rig."""
    min_views: int = 4
    """Photos that have to see a line (3 or more); one fewer where all of its arcs agree."""
    tolerance_px: float | None = None
    """Standard deviation that arcs have beyond what they state, for errors of poses and calibration; found from the arcs where it
    is not given."""
    bow_share: float | None = None
    """Standard deviation that arcs have besides, over their length, as edges are not quite straight; found from the arcs where it
    is not given."""
    calibration_error_px: float | None = None
    """How far cameras whose calibration states no covariance are off, in RMS over what the photos show (px); they count as exact
    where it is not given."""
    triangulation: str = "ml"
    """Method: dual, averaging, svd or ml."""
    triangulation_options: Mapping[str, Any] = field(default_factory=dict)
    """Those of the method's function, such as those that `omnilines.triangulation.method_options` gives."""
    cost: str = "whitened"
    """Cost of the adjustment: sector, whitened, taylor-kriegman or bartoli-sturm."""
    loss: str = "cauchy"
    """Robust loss of the adjustment: none, huber or cauchy."""
    device: str = "cpu"
    """Where lines are triangulated and adjusted: cpu or cuda."""
    partition: int = 0
    """Photos of a part in which lines and poses are adjusted; with 0 in one piece, or in parts of 500 where that does not fit
    into memory. The result is the same."""
    seed: int = 0
    """Of everything random."""
    posing: PosingOptions = PosingOptions()
    """Poses of photos, where they are looked for in them."""
    matching: MatchingOptions = MatchingOptions()
    """Which arcs show one line, and where photos stand by lines."""
    adjustment: AdjustmentOptions = AdjustmentOptions()
    """How lines are started, weighed and judged."""
    structure: StructureOptions = StructureOptions()
    """Where lines end, which are parallel, and which way is up."""
    rough_poses: RoughPoseOptions = RoughPoseOptions()
    """When given poses are replaced by better ones."""
    rounds: RoundOptions = RoundOptions()
    """How often arcs are matched."""
    same_place: SamePlaceOptions = SamePlaceOptions()
    """Photos that are left out as they say nothing of distances."""
    kept_lines: KeptLineOptions = KeptLineOptions()
    """Which lines are kept, and how."""
    frame: FrameOptions = FrameOptions()
    """The frame that a scene is written in."""
    advice: AdviceOptions = AdviceOptions()
    """What is said of photos that lines hardly explain."""
    moved: MovedOptions = MovedOptions()
    """What is said of photos that refined poses put far from those given."""
    judge: JudgeOptions = JudgeOptions()
    """When poses, cameras and tracks are refused because they do not belong together."""


OF_TABLES = SceneOptions(refine=("lines", "poses"), loss="none")
"""Of matched segments that a user brings: they are taken as they are."""
OF_PHOTOS = (
    "min_views", "tolerance_px", "bow_share", "seed", "posing", "matching", "structure", "rough_poses", "rounds", "kept_lines",
    "same_place", "frame",
)  # fmt: skip
"""Options that decide nothing of such segments: what is looked for in photos, and in the arcs of photos."""
