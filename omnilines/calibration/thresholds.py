"""The thresholds that decide a calibration: frozen groups, one for each concern, each number with its unit and its meaning."""

from dataclasses import dataclass
from typing import NamedTuple

from camera_models.typed import Options


class ViewThresholds(NamedTuple):
    """Which views can be used, and which are named."""

    least_views: int = 3
    """Views that a calibration needs."""
    least_corners: int = 6
    """Corners that a view must have: fewer do not determine its radial start."""
    many_rejected_share: float = 0.1
    """A view with more than this share of its corners rejected is named by itself."""
    leverage_share: float = 0.5
    """A view that decides more than this share of the parameters is named."""


class ScreeningThresholds(NamedTuple):
    """Gross errors, found before any camera is known."""

    far_factor: float = 6.0
    """Corners farther from the polynomial of their view than this many times its median distance are gross errors."""
    near_px: float = 2.0
    """Corners nearer to the polynomial are never gross errors."""
    disorder_share: float = 0.05
    """A view whose median distance from its polynomial is more than this share of its own extent is not a board in order."""


class StartThresholds(NamedTuple):
    """Where a calibration starts, and when another start is tried."""

    good_start_share: float = 0.005
    """A closed-form start with a typical residual below this share of the image's longer side needs no alternatives."""
    half_angles_deg: tuple[float, ...] = (25.0, 45.0, 70.0, 90.0, 110.0)
    """Equidistant lenses tried beside the closed-form start, by the angle at the farthest corner."""
    odd_view_factor: float = 5.0
    """Views whose typical residual is this many times that of the others do not take part in the closed form."""
    good_fit_share: float = 0.001
    """A robust fit with a scale below this share of the image's longer side needs no other start."""
    most_starts: int = 4
    """Starts from which a robust fit is tried."""


class LineStartThresholds(NamedTuple):
    """Where a calibration from straight lines starts."""

    least_chains: int = 20
    """Smooth edges that it needs, of all photos together."""
    most_chains: int = 4000
    """The longest are looked at."""
    min_radius_share: float = 0.5
    """Of half the image diagonal: curves that are no lines bend at random with a radius of this and more."""
    bends: tuple[float, ...] = (0.2, 0.1, 0.05, 0.0, -0.03, -0.06, -0.1, -0.15, -0.2, -0.3, -0.4, -0.5, -0.65, -0.8, -1.0, -1.3)
    """Division models tried, by the relative change of the ray's z at the farthest edge."""
    half_angles_deg: tuple[float, ...] = (
        40.0,
        50.0,
        60.0,
        65.0,
        70.0,
        75.0,
        80.0,
        85.0,
        90.0,
        95.0,
        100.0,
        105.0,
        110.0,
        120.0,
        135.0,
        150.0,
    )
    """Equidistant and equisolid lenses tried, by the angle at the farthest edge."""
    usual_half_angle_deg: float = 30.0
    """At the farthest edge of a lens with little distortion, where nothing tells it."""
    least_bend: float = 0.15
    """Relative change of the ray's z at the farthest edge from which on a lens is taken for a fisheye, where nothing tells."""
    strays_px: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
    """Standard deviations by which lines may leave their curves; which one it is is found from the chains."""
    share: float = 0.5
    """Of the chains, those that are lines of the world."""
    false_starts: float = 1e-3
    """Cameras that are expected where all edges bend at random, at most."""
    refined: int = 3
    """Of the lenses tried, the best are refined."""
    most_photos: int = 20
    """Those with the most straight edges are looked at for right angles."""
    term_sigma: float = 0.5
    """Standard deviation of the terms of the curve about those of the lens tried."""
    centre_sigma: float = 0.03
    """Of the distance of the farthest edge: standard deviation of the centre about the middle of the image, or of its circle."""


class RobustThresholds(NamedTuple):
    """The robust fit, and the corners that it rejects."""

    loss_scale: float = 2.0
    """Scale of the loss, in robust standard deviations of the residuals."""
    reject_sigma: float = 4.5
    """Corners farther than this many robust standard deviations (of the norm) are rejected."""
    many_unknowns_share: float = 0.25
    """Unknowns over residuals from which the robust scale is taken without as many of the smallest residuals."""


class HeldOutThresholds(NamedTuple):
    """How models, degrees and distortion terms are compared by views that a fit has not seen."""

    least_views: int = 5
    """Fewer views do not tell degrees or models apart."""
    no_worse_factor: float = 1.005
    """A held-out error (RMS) that is greater by less than this factor is no reason for another parameter."""
    risen_factor: float = 1.1
    """A held-out error greater than the least by this factor will not fall again with fewer coefficients."""
    beyond_factor: float = 1.1
    """The curve of a model must grow up to this many times the radius of the outermost corner."""
    folding_factor: float = 1.1
    """A model whose curve ends before that is taken where the held-out error of others is greater by this factor."""
    significance: float = 0.01
    """From lines a larger variant of a model is taken where chance makes so great a gain more seldom."""

    @property
    def few_parameters_share(self) -> float:
        """Parameters for each corner below which terms that a lens does without do no harm: q of them raise the held-out error
        (RMS) of n corners by a share of about q / 2n."""
        return 2 * (self.no_worse_factor - 1)


class DegeneracyThresholds(NamedTuple):
    """Sets of views that leave a camera open, or part of the image."""

    parallel_deg: float = 3.0
    """Boards whose normals all agree within this angle count as parallel: their tilt is then mostly noise."""
    nearly_parallel_deg: float = 15.0
    """Where the camera is left open, boards within this angle are named as the cause."""
    one_axis_deg: float = 3.0
    """Boards whose normals all lie within this angle of a plane count as tilted about one axis."""
    open_share: float = 0.1
    """A camera whose angles are uncertain by more than this share of themselves is not determined by its data."""
    unexplained_share: float = 0.5
    """Corners that lie from where the camera sees them by more than this share of their spread in the views (both root mean
    squares) are not seen by a camera at all."""
    misfit_significance: float = 1e-3
    """Of what residuals have in common in all photos by their distance from the centre, from which on the model is said not to
    follow the lens, and of a bend of the board, oblong squares, a moving pupil or a lens that is not centred in all photos,
    from which on that is said."""


class DoubtThresholds(NamedTuple):
    """When a table of corners, or what is said of a board, is doubted."""

    good_share: float = 0.0005
    """Residuals (root mean square, per axis) up to this share of the longer side of the image raise none."""
    oblong: float = 0.05
    """The least change of a board's aspect that is looked for: printers are off by a hundredth at most."""
    fits_better: float = 3.0
    """Times as well (root mean square) that another aspect of the board, or a flip of a photo, has to fit."""
    rough_share: float = 0.002
    """Residuals (root mean square, per axis) above this share of the longer side of the image are spoken of."""
    rough_sigmas: float = 3.0
    """Unless they are within so many times what is stated of the corners."""
    largest_m: float = 10.0
    """Length of a board beyond which it is asked whether it is in millimetres."""
    smallest_m: float = 0.001
    """Length of a board below which it is asked what it is in."""


class NoiseThresholds(NamedTuple):
    """What is taken of the noise of corners, and when it is doubted."""

    corner_floor_px: float = 0.01
    """Corners found in photos are never taken to be better than this when uncertainty is stated. On rendered boards without noise
    the detector is still off by some 0.004 px, neighbours alike, which residuals do not show: over 28 rendered sets the squared
    errors of the parameters were 1.5 times what residuals of 0.006 px promise."""
    radial_shift_px: float = 0.002
    """Standard deviation of a radial shift that all corners of a camera have in common (`rig/systematic.py`)."""
    significance: float = 0.01
    """The noise is not as stated where residuals as large as those found have a smaller chance than this."""
    explained: float = 2.0
    """What differs from photo to photo is named where it leaves residuals up to this many times the stated noise."""
    well_below_share: float = 0.5
    """Residuals below this share of what is stated are named: the statement is then no better than a bound."""
    large_freedom: int = 30
    """Degrees of freedom from which Student's t is the normal distribution to 4 percent: fewer are named."""
    tied_variances: float = 9.0
    """Minima whose sums of squares differ by less than this many variances (three standard deviations) fit equally well."""


class DuplicateThresholds(NamedTuple):
    """Photos that show the same twice."""

    noise_factor: float = 3.0
    """Distance of common corners in standard deviations of one corner; the difference of two has 1.4 times its noise, the rest is
    for a noise that is only estimated."""
    least_tolerance_px: float = 0.1
    """That distance, however small the noise: files of corners are rounded, and a copy in another image format moves them."""
    least_common: int = 6
    """Fewer common corners do not tell."""


class ShootingThresholds(NamedTuple):
    """Which poses of the board are proposed for the next photo, and when they are said to help."""

    candidates: int = 2000
    """Poses tried."""
    poses: int = 3
    """Poses proposed, each for when those before it have been shot."""
    apart_share: float = 0.15
    """The middles of proposed boards are this share of the image's longer side apart."""
    most_tilt_deg: float = 45.0
    """Tilt of a proposed board against the ray to its middle, at most."""
    steepest_deg: float = 65.0
    """Angle between a ray and the normal of the board at any of its corners, at most."""
    shown_share: float = 0.8
    """Share of its corners that a proposed board shows, unless boards were seen in part only."""
    nearest_share: float = 0.8
    """A proposed board is no nearer than this share of the least distance at which one was seen: it might be out of focus."""
    resolved_px: float = 12.0
    """Neighbouring corners of a proposed board are this far apart, or as far as the nearest that were found."""
    least_gain: float = 0.02
    """A photo helps where it lowers the largest uncertainty by more than this share."""
    facing_deg: float = 15.0
    """Boards all tilted by less than this against the rays to their middles are named."""
    uncovered_share: float = 0.1
    """A part of the rim without corners is named where it is more than this share of the way out."""
    noisy_px: float = 0.5
    """Corners with a larger standard deviation than this are named."""
    few_views: int = 8
    """Fewer views are named."""
    rim_share: float = 0.25
    """The rim of a lens or mirror is where the brightest of the photos falls below this share of what it is where corners are."""


class RigThresholds(NamedTuple):
    """How cameras are put together to a rig, and when one is named."""

    outside_share: float = 0.1
    """Share of corners outside the field of view of a given calibration from which it is not that of this camera."""
    agreeing_squares: float = 0.3
    """Mean distance, in squares of the board as they are seen, up to which a view agrees with a predicted pose: a wrong numbering
    is off by a whole square or more."""
    as_numbered_bonus: float = 0.05
    """Bonus of a view that agrees as it is numbered."""
    proposers: int = 12
    """Views with the most corners, each of which proposes a pose for a camera or a board that is added."""
    agreeing_share: float = 1 / 3
    """Share of the views that must agree on where a camera stands."""
    as_numbered_views: int = 3
    """Views that must agree as they are numbered for no other numbering to be looked for."""
    as_numbered_share: float = 0.7
    """Share of the views that must do so."""
    tied_share: float = 0.9
    """Another pose that is agreed on as well as this, relative to the best, leaves the numbering open."""
    apart_views: int = 4
    """Frames from which a camera is placed with a board that no other camera sees, by the motion of the rig: three would do, the
    fourth shows whether they agree."""
    apart_turn_deg: float = 5.0
    """Root mean square turn about a second axis that this takes: poses of single photos do not tell less from their noise."""
    as_good_as_alone_factor: float = 1.05
    """Times the noise of each camera alone, up to which its corners fit the rig as well."""
    worse_than_alone_factor: float = 1.08
    """A camera whose corners fit the rig worse than this many times as well as alone is named, beyond what fewer poses to follow
    their noise make of it."""
    named_share: float = 0.1
    """A cause of that is named from this share of the difference on (in squared residuals)."""
    clear_gain: float = 3.0
    """How much more the parameters of a cause have to gain than as many that only fit noise."""
    one_place_squares: float = 0.1
    """Frames between which a board has moved by no more (root mean square of its corners) show it at one place, and say once what
    is wrong there."""


class ClockThresholds(NamedTuple):
    """How the clocks of a rig's cameras are compared: by the board's motion in runs of consecutive frames."""

    frames_of_run: int = 5
    """Frames of a run, through which the board is followed by a polynomial of one degree less."""
    longest_gap_s: float = 0.2
    """Between frames of a run: hands turn back and forth more than once in a second, and frames farther apart do not say how
    the board moves between them."""
    least_moving_share: float = 0.9
    """Of what seems to be known of a clock, or of a line delay, the share that the board's motion has to tell: with less it may
    be at rest, and the noise of its poses seems to tell the rest."""
    longest_gap_of_rows_s: float = 0.07
    """Between frames by which rolling shutters are recognised: the speed in a frame at the end of a run of five, of a board that
    hands turn back and forth 1.5 times in a second, is then known to 4 percent, with twice the gap to none."""
    significance_of_rows: float = 1e-3
    """Probability that a rolling shutter is named where frames are of one instant."""


@dataclass(frozen=True, kw_only=True, repr=False)
class CalibrationThresholds(Options):
    """All thresholds of a calibration, the groups of its options."""

    views: ViewThresholds = ViewThresholds()
    screening: ScreeningThresholds = ScreeningThresholds()
    start: StartThresholds = StartThresholds()
    robust: RobustThresholds = RobustThresholds()
    held_out: HeldOutThresholds = HeldOutThresholds()
    degeneracy: DegeneracyThresholds = DegeneracyThresholds()
    doubt: DoubtThresholds = DoubtThresholds()
    noise: NoiseThresholds = NoiseThresholds()
    duplicates: DuplicateThresholds = DuplicateThresholds()
    shooting: ShootingThresholds = ShootingThresholds()
    rig: RigThresholds = RigThresholds()
    clocks: ClockThresholds = ClockThresholds()
