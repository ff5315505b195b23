"""Options of the structure of a scene: where lines end, which are parallel, which end together, and which way is up."""

import math
from dataclasses import dataclass
from typing import NamedTuple

from camera_models.typed import Options


class ClippingOptions(NamedTuple):
    """Where a line begins and ends, by the arcs that show it."""

    min_photos_everywhere: int = 2
    """Photos that have to show every place of a stretch."""
    agree_sigmas: float = 2.0
    """Ends that are nearer to each other, in standard deviations, agree."""
    drawn_in_sigmas: float = 2.0
    """A line ends so many standard deviations of its end before it: so much is supported."""
    gap_sigmas: float = 3.0
    """Gaps shorter than this many standard deviations of an end are none."""


class FamilyOptions(NamedTuple):
    """Which lines are parallel, and which families of them at right angles."""

    tolerance_rad: float = math.radians(0.3)
    """Standard deviation, in each direction, of the model that lines of one family are parallel, and two at right angles."""
    min_members: int = 4
    """Lines of the smallest family."""
    false_families: float = 1e-3
    """Families that are expected where all directions are random, at most."""
    separation_rad: float = math.radians(2)
    """Least angle between two families, so that lines just outside of one do not become another beside it."""
    member_share: float = 0.999
    """Share of the true members that the gate of a family takes in."""
    right_angle_sigmas: float = 3.0
    """A right angle is one from which an angle differs by at most as many standard deviations."""
    max_sigma_rad: float = math.radians(3)
    """A line with a less certain direction would fit to several families: it is left alone."""

    @property
    def gate(self) -> float:
        """Chi-square up to which a line is a member: the quantile of `member_share` with 2 degrees of freedom."""
        return float(-2 * math.log1p(-min(self.member_share, math.nextafter(1.0, 0.0))))


class CornerOptions(NamedTuple):
    """Where lines end together, and how far such lines pass each other."""

    reach_px: float = 2.0
    """Two arcs of a photo end together where both end so near to the point that their circles share: twice what is known of an
    end along its arc."""
    min_sine: float = 0.1
    """Of the angle between two circles, and between two lines: those nearly alike share no point that is known."""
    min_photos: int = 2
    """In which the arcs of two lines end together."""
    most_photos: int = 4
    """Two lines end together by chance the less often the more photos show it: the gaps of corners that as many photos show have
    shares of their own, up to this number, those of more photos together."""
    gaps: tuple[float, ...] = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0)
    """Standard deviations of the gap between two lines that end together, over the median distance of lines from cameras, of
    which the shares are found: the least of lines that meet, the others of those that do not."""
    meeting_gap: float = 1e-3
    """Lines meet whose gap has a standard deviation of at most so much, over that distance."""


class PlaneOptions(NamedTuple):
    """Which lines run along the planes that families of parallel lines span, and how far they lie from each other's planes."""

    most_families: int = 6
    """The largest families, each two of which span planes."""
    min_angle_rad: float = math.radians(20.0)
    """Least angle between two families that span planes."""
    along_sigmas: float = 3.0
    """A line runs along planes where its direction differs from theirs by at most so many standard deviations, the stray of
    `families.tolerance_rad` among them."""
    min_lines: int = 10
    """Along the planes of one normal, from which on they are asked."""
    neighbours: int = 8
    """Nearest lines, in the plane of one of which a line may lie."""
    same_sigmas: float = 3.0
    """Lines nearly parallel (`corners.min_sine`) that lie nearer to each other within the plane than so many standard deviations
    may be one line: neither is a neighbour of the other."""
    gaps: tuple[float, ...] = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0)
    """Standard deviations of the gap between a line and the plane of a neighbour, over the median distance of lines from
    cameras, of which the shares are found: the least of lines in one plane, the others of those that are not."""
    lying_gap: float = 1e-3
    """Lines lie in one plane whose gap has a standard deviation of at most so much, over that distance."""


class UprightOptions(NamedTuple):
    """Which family of parallel lines is vertical."""

    upright_rad: float = math.radians(30.0)
    """Half of the photos are held so upright, or better, against the vertical family."""
    as_near: float = 2.0
    """Families are as good as the nearest one to the photos' up whose angle is at most so many times its own and a bit more."""
    as_near_rad: float = math.radians(5.0)
    """What that angle may be more than so many times the nearest one's."""
    clearly_more: float = 2.0
    """Of several as good, the vertical one has so many times the lines of any other."""
    horizontal_rad: float = math.radians(3.0)
    """A family is horizontal whose angle to the vertical differs by no more from a right one."""


@dataclass(frozen=True, repr=False)
class StructureOptions(Options):
    """All options of the structure of a scene."""

    clipping: ClippingOptions = ClippingOptions()
    """Where a line begins and ends."""
    families: FamilyOptions = FamilyOptions()
    """Which lines are parallel."""
    corners: CornerOptions = CornerOptions()
    """Where lines end together."""
    planes: PlaneOptions = PlaneOptions()
    """Which lines lie in one plane."""
    upright: UprightOptions = UprightOptions()
    """Which way is up."""


@dataclass(frozen=True, repr=False)
class DirectionsOptions(Options):
    """All options of the directions in which the lines of one photo meet."""

    used_arcs: int = 400
    """Arcs whose circles are known best: the directions are estimated from so many."""
    paired_arcs: int = 60
    """Each pair of so many of them is tried as a direction."""
    tried_rad: float = math.radians(0.5)
    """Standard deviation by which parallel lines stray, while directions are tried, and up to which circles are one line."""
    strays_rad: tuple[float, ...] = tuple(math.radians(t) for t in (0.0, 0.01, 0.03, 0.06, 0.1, 0.2, 0.3, 0.4, 0.6, 1.0))
    """Standard deviations by which lines may stray; which one it is is found from the arcs."""
    share: float = 0.05
    """Of the arcs, those of a direction, while directions are tried."""
    false_directions: float = 1e-3
    """Directions that are expected in a photo whose arcs are turned at random, at most."""
    min_lines: float = 4.0
    """Lines, fragments of one taken together, that a direction has at least."""
    separation_rad: float = math.radians(3.0)
    """Least angle between two directions."""
    max_directions: int = 8
    """Of one photo."""
    tried_axes: int = 12
    """Directions that are tried as an axis of a Manhattan frame."""
    refined: int = 4
    """Of the directions, or frames, tried, so many of the best are refined."""
    max_sigma_rad: float = math.radians(5.0)
    """A direction that is known less well is none."""
    upright: UprightOptions = UprightOptions()
    """Which direction is up."""


class RightAngleOptions(NamedTuple):
    """The scale of a camera from right angles."""

    max_factor: float = 6.0
    """By which a scale may differ from the one begun with, either way."""
    factors: int = 240
    """Tried, at equal steps of their logarithm."""
    stray_rad: float = math.radians(0.5)
    """Standard deviation of a direction of things built, in each of two."""
    share: float = 0.5
    """Of pairs of directions of one photo, those at right angles."""
    most_peaks: int = 3
    """Scales that are given back."""
    false_scales: float = 1e-3
    """Scales that are expected where directions are at random, at most."""
    held_share: float = 0.01
    """Of half the image's longer side, by which the camera that lines ask for may differ in `check` where right angles do not
    tell its scale: the score of the one given is of first order, and the way along what is open is bent."""
    told_directions: float = 1.0
    """Directions that are expected in a photo by chance, at most, where it is asked whether right angles tell a scale: those of
    chance make pairs at any angle, which counts."""
    told_lines: float = 3.0
    """Lines that a direction has at least, there: two place it."""
    told_factors: int = 1200
    """Scales that are compared, at equal steps of their logarithms."""
    told_strays_rad: tuple[float, ...] = tuple(map(math.radians, (0.05, 0.1, 0.2, 0.5)))
    """Standard deviations of a direction of things built, in each of two: which one it is is not known."""
    right_sigmas: float = 2.0
    """Angles that differ from a right one by less than so many standard deviations of the largest stray are right ones, off by a
    little, as an adjustment takes them."""
    angles: int = 200
    """Between walls that do not meet at right angles, tried at equal steps of their cosines."""
    same_sigmas: float = 5.0
    """Scales nearer than so many standard deviations are the same one."""
    same_scale: float = 0.2
    """Scales whose logarithms differ by more are not the same one, however uncertain they are."""
    decisive: float = 10.0
    """Right angles tell the scale where they are so many times as likely there as all other explanations together."""
