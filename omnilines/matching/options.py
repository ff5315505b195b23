"""Options of matching: what decides which arcs show one line, and where a photo stands by the lines of others.

Groups are NamedTuples, so that compiled loops take them as they are. Standard deviations of an arc are those of its stated noise
with the tolerance for poses and cameras.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from camera_models.typed import Options


class AppearanceOptions(NamedTuple):
    """Which pixels beside an arc are its colours."""

    offsets_px: tuple[float, ...] = (2.0, 3.0, 4.0, 5.5)
    """Distances from the arc at which both its sides are read."""
    margin_share: float = 0.06
    """Share of the arc left out at both ends."""
    dark_grey: float = 12.0
    """Added to grey levels of 255 before the logarithm: what noise and stray light make of black."""


class LikenessOptions(NamedTuple):
    """When the colours beside two arcs are those of one edge."""

    colour_sigma: float = 0.12
    """Standard deviation of the logarithm of a colour beside one edge in two photos."""
    gain_sigma: float = 0.25
    """Standard deviation of the logarithm of a gain that is common to all colours."""
    one_side_chi_square: float = 3.0
    """Added where only one side looks the same: the other may be seen through to something else."""
    min_likeness: float = 0.05
    """Least likeness of two arcs of one line, of an arc and its line, 1 being the same colours."""
    other_end: float = 0.5
    """What an arc counts for each of its ends that lies elsewhere on a line than that of another: something may hide it there."""


class HypothesisOptions(NamedTuple):
    """Which arcs of other photos could show the line of an arc, and which of them agree."""

    min_overlap_share: float = 0.25
    """Of the shorter of two stretches of a line, seen in two photos, that both show."""
    max_depth_sigma_share: float = 0.3
    """Largest standard deviation of an inverse depth over itself: lines farther away, or along the baseline, say nothing."""
    agree_sigmas: float = 3.0
    """Standard deviations within which two depths agree."""
    max_neighbours: int = 24
    """Photos that each is compared with at most: first the nearest, then those that share most lines."""
    sharpest_arcs: int = 100
    """Of each photo, those whose circles are known best: by them it is told which photos share lines."""


class ExplainedOptions(NamedTuple):
    """When a known line explains an arc."""

    max_chi_square: float = 18.0
    """Of both ends of an arc from a line, in its noise and the line's: one true arc in 8,000 is farther off."""
    reach_px: float = 3.0
    """An arc is compared with lines that pass so near, and as much farther as its noise asks for."""


class TrackOptions(NamedTuple):
    """Which arcs become one track."""

    min_agreement: float = 0.5
    """Agreement, at most 1, with which an arc counts fully: more than where only one of its sides looks the same."""
    same_share: float = 0.6
    """Of the arcs of one track that another line explains too: then they are one."""


class ToleranceOptions(NamedTuple):
    """How the tolerance for errors of poses and cameras is chosen by the arcs."""

    tried_px: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
    """Standard deviations that are tried, from exact poses to poor ones."""
    precise_share: float = 0.25
    """Of the arcs of each photo, those of least noise, which are asked: the others do not tell one tolerance from another."""
    showing_share: float = 0.25
    """Of the arcs that are asked, those whose residuals are looked at."""
    max_noise_factor: float = 1.5
    """Arcs may err so many times more than they state; what is more comes from poses and cameras."""
    min_coarser: float = 1.5
    """Times the stated noise of the precise half of lines that the other half has to state, so that both tell such a factor."""
    enough_share: float = 0.6
    """Of the most that any tolerance gains, what is enough."""
    chance_sigmas: float = 4.0
    """Standard errors by which the most that any tolerance gains has to exceed what it gains by chance."""
    min_chance_turn_rad: float = math.radians(4.0)
    """Cameras turned by so much or more make arcs fit each other by chance alone."""
    max_chance_turn_rad: float = math.radians(8.0)
    """The most that cameras are turned for that: what photos have in common hardly changes."""


class BowOptions(NamedTuple):
    """How far edges are from straight."""

    most_share: float = 0.002
    """Share of their length, as a standard deviation, that edges are taken to bow by while it is told how much they do, and about
    the most that is found."""
    telling_arcs: int = 1000
    """Arcs that are asked: those that are longest for what their noise is."""
    min_sigmas: float = 2.0
    """Times the noise of an arc that such a bow has to be for the arc to tell anything."""
    min_lines: int = 10
    """Lines whose arcs have to tell it; with fewer, edges are taken to be straight."""


class ChanceOptions(NamedTuple):
    """How probable it is that photos would show a line that is not there."""

    reach_px: float = 100.0
    """A line is moved so far to both sides."""
    min_length_px: float = 15.0
    """A photo that has less of a line in its field could not show it by an arc."""
    farther: float = 1.5
    """Photos farther from a line than so many times the farthest that shows it are not asked: other rooms do not see it."""
    as_much: float = 0.5
    """Of what each photo that shows a line shows of it by one arc, at least: where another arc covers less of it, or of the line
    moved, it shows something else. All of it would favour the line, whose ends are those of its own arcs."""


class DirectionOptions(NamedTuple):
    """Directions that arcs of one photo, or lines of a scene, have in common."""

    sharpest_arcs: int = 120
    """Arcs that directions are sought by: those whose circles are known best."""
    min_arcs: int = 4
    """That share a direction, or are of one family of lines in a photo."""
    meeting_rad: float = math.radians(1.0)
    """A direction so near the circle of an arc is on it."""
    apart_rad: float = math.radians(8.0)
    """Between two directions that are two."""
    parallel_rad: float = math.radians(2.0)
    """Lines are parallel to so much; so is an arc to a line, and it agrees with a place, under a rotation known to a degree."""


class RotationOptions(NamedTuple):
    """Rotations of photos from the directions that their lines share."""

    near_rad: float = math.radians(12.0)
    """How far a pose may be turned: rough ones are some degrees off, and nearer families could be confused."""
    apart_rad: float = math.radians(20.0)
    """Between two families that fix a rotation."""
    fine_near_rad: float = math.radians(1.0)
    """Between directions of two photos that are one, under rotations that are known already."""
    fine_apart_rad: float = math.radians(2.0)
    """Between two families then: furniture that stands a little askew is one of its own."""
    min_photo_share: float = 0.3
    """Of the photos that have to see a direction for it to be one of a family."""
    chance_sigmas: float = 4.0
    """Standard deviations by which the arcs of a family in a photo exceed what chance gives."""
    parallel_sigma_rad: float = math.radians(0.03)
    """Least standard deviation of an arc from its family: edges of buildings are parallel to so much."""
    vote_sigma_rad: float = math.radians(0.3)
    """Standard deviation of a rotation that a direction and one more arc give."""
    prior_sigma_rad: float = math.radians(5.0)
    """Standard deviation of the rotations that are refined."""


class StartOptions(NamedTuple):
    """Where a photo could have been taken, without any idea of its pose."""

    angle_rad: float = math.radians(3.0)
    """Between the angle of two directions in the photo and in the world, and between rotations that are one."""
    min_arc_share: float = 0.6
    """Of the arcs that the best rotation explains."""
    min_likeness: float = 0.2
    """Of an arc and a line that is asked where the camera stands."""


class ResectionOptions(NamedTuple):
    """The pose of a photo from known lines."""

    reaches_rad: tuple[float, ...] = tuple(map(math.radians, (2.0, 1.0, 0.5, 0.25, 0.12, 0.0)))
    """Arcs are given to lines that lie so near, one after the other; in the end, to those as near as their noise allows."""
    reach_sigmas: float = 3.0
    """A reach is so many standard deviations of what is left of the error of the pose."""
    loss_scale: float = 2.0
    """Standard deviations at which a residual counts half (Cauchy loss), also of rotations from directions."""


class PlacingOptions(NamedTuple):
    """When lines say that a photo stands elsewhere than its pose says, or where one without a pose stands."""

    clearly_more: float = 1.1
    """Times what the pose that a photo has explains: then another near it is better."""
    few_explained: float = 0.4
    """Of the share of its arcs that lines explain in a typical photo: below it the pose of a photo may be wrong altogether. At a
    pose 3 degrees off it was 0.3."""
    above_chance: float = 1.5
    """Times what the best of the other poses explains, for the pose of a photo that had none."""
    min_score: float = 12.0
    """Least sum of the likeness of explained arcs for such a pose."""
    other_rad: float = math.radians(3.0)
    """Poses are others that are turned by so much."""
    other_share: float = 0.05
    """Poses are others that stand apart by this share of the extent of the lines."""
    max_arcs: int = 500
    """Arcs of a photo that its pose is sought by, those known best: foliage has thousands, which tell no more."""
    max_lines: int = 800
    """Lines that a pose is sought by, the longest."""


@dataclass(frozen=True, repr=False)
class MatchingOptions(Options):
    """All options of matching."""

    appearance: AppearanceOptions = AppearanceOptions()
    """Which pixels beside an arc are its colours."""
    likeness: LikenessOptions = LikenessOptions()
    """When colours beside two arcs are those of one edge."""
    hypotheses: HypothesisOptions = HypothesisOptions()
    """Which arcs could show the line of an arc."""
    explained: ExplainedOptions = ExplainedOptions()
    """When a known line explains an arc."""
    tracks: TrackOptions = TrackOptions()
    """Which arcs become one track."""
    tolerance: ToleranceOptions = ToleranceOptions()
    """How the tolerance for errors of poses and cameras is chosen."""
    bow: BowOptions = BowOptions()
    """How far edges are from straight."""
    chance: ChanceOptions = ChanceOptions()
    """How probable a line that is not there is."""
    directions: DirectionOptions = DirectionOptions()
    """Directions that arcs and lines have in common."""
    rotations: RotationOptions = RotationOptions()
    """Rotations of photos from shared directions."""
    starts: StartOptions = StartOptions()
    """Where a photo could have been taken."""
    resection: ResectionOptions = ResectionOptions()
    """The pose of a photo from known lines."""
    placing: PlacingOptions = PlacingOptions()
    """When a photo stands elsewhere."""
