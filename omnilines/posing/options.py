"""Options of posing: where photos were taken from, by structure from motion, sheets of paper, boards, points and rigs."""

import math
from dataclasses import dataclass
from typing import NamedTuple

from camera_models.typed import Options


class FeatureOptions(NamedTuple):
    """Features of a photo."""

    max_features: int = 4000
    """Of a photo, the largest."""
    searched_megapixels: float = 3.6
    """Size of the photo that is searched, made smaller or larger to have as many: in larger ones there are several times as many
    features as are kept."""
    max_enlarged: float = 2.0
    """Times that a photo is enlarged at most to be searched."""
    min_contrast: float = 0.0033
    """Of a keypoint, half of COLMAP's: painted rooms are faint."""
    beyond_support_rad: float = math.radians(2.0)
    """How far beyond the angles that its calibration is supported by a camera is believed."""
    sigma_px: float = 0.35
    """Standard deviation of a small keypoint."""
    large_scale_px: float = 3.0
    """Scale of a keypoint from which its position is known the less, the larger it is."""
    surround_grey: int = 16
    """Grey level (of 255) up to which pixels joined to an image corner are the lens's surround."""
    surround_px: float = 5.0
    """Distance kept from the lens's surround."""


class MatchOptions(NamedTuple):
    """Matches of features of two photos."""

    clear_ratio: float = 0.8
    """Of the distances of the best and the second best descriptor of a clear match."""
    faint_ratio: float = 0.9
    """The same of a match that is less clear."""
    guided_ratio: float = 0.85
    """The same of a match along an epipolar circle."""
    guided_distance: float = 0.9
    """Distance of descriptors (unit vectors) from which two features are no candidates for a match along a circle."""
    max_exhaustive: int = 60
    """Photos up to which each is compared with every other; of more, each with those that look most alike."""
    neighbours: int = 30
    """Photos that each is then compared with."""

    @property
    def guided_cosine(self) -> float:
        """Least cosine of the descriptors of two features that are candidates."""
        return 1.0 - 0.5 * self.guided_distance**2


class MapperOptions(NamedTuple):
    """Structure from motion by COLMAP, on ideal panoramas."""

    max_latitude_rad: float = math.radians(80.0)
    """Keypoints nearer to the poles of the panorama are kept back: pixels are too small there."""
    min_pair_inliers: int = 15
    """Of a verified pair of photos: rooms have few features."""
    min_first_pair_inliers: int = 30
    """Of the pair that the model begins with."""
    min_inlier_share: float = 0.25
    """Of the matches of a verified pair."""
    epipolar_px: float = 4.0
    """Distance from the epipolar circle at which a match agrees with a pair's geometry: COLMAP's own limit."""
    resection_px: tuple[float, ...] = (4.0, 4.0, 8.0)
    """Largest errors of a photo that is added. COLMAP's 12 px let photos that see few known points in on wrong ones; these are
    tried in turn until all photos are settled, else the model is taken that most verified matches agree with."""
    resection_inliers: tuple[int, ...] = (15, 10, 15)
    """Least inliers of a photo that is added, for each of these errors."""
    more_draws: int = 6
    """Where none of these ways settles all photos, that of the first of them is tried so many times more with other draws of what
    is random in it (which pair comes first, samples of RANSAC)."""
    settled_share: float = 0.8
    """Of the verified matches of each photo, in pairs whose rotations agree, that its pose has to explain: where it does for all
    photos, no other way of adding them is tried."""
    rotation_loss_scale_rad: float = math.radians(2.0)
    """Where the loss of relative rotations bends: several times the error of that of a pair of few matches."""
    max_rotation_rad: float = math.radians(6.0)
    """Between the relative rotation of a pair and that of its photos: pairs beyond it are dropped."""


class GrowthOptions(NamedTuple):
    """Poses of all photos from those that COLMAP found."""

    tolerances_sigmas: tuple[float, ...] = (20.0, 10.0, 6.0)
    """Half width of the epipolar circles of every round, in standard deviations of a keypoint."""
    min_parallax_rad: float = math.radians(1.0)
    """Angle between two rays of a point."""
    min_resected: int = 12
    """Points that must agree on the pose of a resected photo."""
    min_resected_share: float = 0.15
    """Share of its points that must agree on the pose of a resected photo."""
    resection_sigmas: float = 3.0
    """Poses and points are still uncertain when photos are resected: bearings are taken as so many times less certain."""
    clearly_more: float = 1.3
    """Times as many points must agree with another pose of a photo than with the one it has."""
    min_seen: int = 10
    """Points that a photo must see in the end."""
    few_features: int = 20
    """A photo that is lost with fewer features is lost because of that."""
    doubtful_share: float = 0.25
    """Share of the photos without a pose from which on those of the others are called doubtful: they share too few features for
    residuals to tell a wrong pose."""
    rig_doubt: float = 1.1
    """Times as much as with each photo free that points scatter with the rig as given, from which on the rig is doubted."""
    change_doubt: float = 1.1
    """Times as much as with terms of each photo (rolling shutter, focal length, crop) that points scatter without, from which on
    these are named."""
    change_significance: float = 1e-3
    """And the largest chance of that (F test)."""
    most_changing: int = 60
    """Photos looked at for that, the first."""
    rig_rounds: int = 10
    """Times at most that a doubted rig is found anew from points, and photos are matched again with it, where it is refined."""


class ResectionOptions(NamedTuple):
    """The pose of a photo from known points, and poses and points refined together."""

    inlier_sigmas: float = 3.5
    """A point counts when its residual is below so many standard deviations: 0.998 of those with normal noise do."""
    loss_scale: float = 2.0
    """Standard deviations at which a residual counts half (Cauchy loss)."""
    gross_sigmas: float = 4.0
    """Residuals beyond so many standard deviations, as they turn out to be, are gross errors."""


class RectangleOptions(NamedTuple):
    """A bright sheet of known size in a photo."""

    max_arcs: int = 600
    """The longest are looked at."""
    min_contrast: float = 0.1
    """Of the logarithms of the grey levels inside and outside."""
    max_gap_share: float = 0.7
    """Of an arc's length, that it may end before the corner."""
    max_beyond_share: float = 0.1
    """Of an arc's length, that it may end beyond the corner."""
    min_turn_rad: float = math.radians(8.0)
    """Between two sides."""
    min_covered_share: float = 0.6
    """Of the sides together that the arcs have to cover."""
    nearly: float = 0.2
    """Error of the ratio of the sides and of the right angle up to which the sheet is fitted."""
    max_misfit: float = 0.003
    """Root mean square of the distances of the arc ends from the sides, over the mean angle of a side: paper curls, its size is
    rounded, and calibrations are not perfect."""
    max_chi_square: float = 13.816
    """Of two degrees of freedom: what the noise of the arcs explains fits too."""
    max_distance_sigma_share: float = 0.01
    """Standard deviation of the distance over the distance: what is smaller in the photo, or seen too much from its edge, is no
    sheet to stand on."""
    as_bright: float = 0.25
    """Difference of the logarithms of grey levels up to which another rectangle is as bright: a lamp is brighter than paper."""
    as_large: float = 0.7
    """Of the mean angle of a side, from which on another rectangle is as large."""
    same_share: float = 0.1
    """Distance of corners, over the mean angle of a side, up to which two quadrilaterals are the same."""
    epipolar_rad: float = math.radians(1.0)
    """Of an epipolar plane: poses from a sheet are good to a tenth of that, and one match in sixty lies there by chance."""
    min_baseline_share: float = 0.02
    """Of the distance to the sheet, below which directions are compared and not epipolar planes."""
    clear_sigmas: float = 4.0
    """A pair votes where the matches that fit one turn only are so many standard deviations from half for either."""


class GivenOptions(NamedTuple):
    """Poses from boards, from points or matches that are given, from rigs and from trajectories."""

    corner_sigma_px: float = 0.5
    """Of corners of a board and camera together, where a pose begins: generous, it only decides what is a gross error."""
    min_corner_share: float = 0.6
    """Of the corners of a board that must agree on the pose."""
    picked_sigma_px: float = 1.0
    """Of points picked by hand, where the table states none."""
    gross_misfit: float = 10.0
    """A pose that fits its points so many times worse than they are certain, and worse than `corner_sigma_px`, is none: corners
    are found to hundredths of a pixel, but boards bend, and cameras differ from their model, by tenths."""
    min_common: int = 8
    """Matched points that two photos share, and that a photo is resected from."""
    ransac_sigmas: float = 3.0
    """Standard deviations within which a match agrees with a pair of photos, and a point with a pose."""
    enough_parallax_rad: float = math.radians(10.0)
    """A matched point counts by its parallax up to this where the first two photos are chosen."""
    rig_contradicts_rad: float = math.radians(5.0)
    """Photos of one frame whose poses differ from what the rig says by more are not of that rig, or of other instants."""
    rig_sigmas: float = 5.0
    """Standard deviations, by the spread of the instants, by which poses have to put a camera of a rig elsewhere than the
    calibration to contradict it."""
    max_gap_s: float = 0.25
    """Between two rows of a trajectory, up to which poses between them are interpolated: who walks turns about then."""
    same_time_s: float = 1e-3
    """A photo so near to a row of a trajectory has its pose, though no row is on its other side: stamps are rounded."""


class CarriedOptions(NamedTuple):
    """What goes along with the camera: a vehicle or a mount that it sees (`carried_along`)."""

    turned_rad: float = math.radians(2.0)
    """Angle that two photos are turned by from which on a feature far away cannot be at one bearing in both."""
    least_share: float = 0.05
    """Of the matches of such photos at one bearing, from which on that is said."""
    rig_still: float = 0.2
    """Share of the distance between the cameras of a rig within which half of its instants lie where it is said to have stood
    still: what they all show at one bearing is the world then."""


@dataclass(frozen=True, repr=False)
class PosingOptions(Options):
    """All options of posing."""

    features: FeatureOptions = FeatureOptions()
    """Features of a photo."""
    matches: MatchOptions = MatchOptions()
    """Matches of features."""
    mapper: MapperOptions = MapperOptions()
    """Structure from motion by COLMAP."""
    growth: GrowthOptions = GrowthOptions()
    """Poses of all photos from those."""
    carried: CarriedOptions = CarriedOptions()
    """What goes along with the camera."""
    resection: ResectionOptions = ResectionOptions()
    """The pose of a photo from known points."""
    rectangle: RectangleOptions = RectangleOptions()
    """A sheet of known size."""
    given: GivenOptions = GivenOptions()
    """Boards, points, matches and rigs."""
