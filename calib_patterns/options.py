"""What decides how targets are detected: frozen, the same for the Python API, the command line and sweeps."""

from dataclasses import dataclass
from typing import NamedTuple

from camera_models.typed import Options

INF = float("inf")


class SearchOptions(NamedTuple):
    """How large a photo is searched."""

    side_px: int = 1400
    """Longest side of a photo that is searched at full scale; larger photos are searched reduced, then refined in full."""
    max_pixels: float = 6e6
    """Enlargements beyond this are left out."""
    noisy_grey: float = 3.0
    """Standard deviation of noise, in grey levels of a photo stretched to 255, from which on the photo is smoothed for the
    classic detector, which takes seconds over noise if it finds nothing."""


class SaddleOptions(NamedTuple):
    """Saddle points, the candidates for corners, and what links them to pieces of checkerboard."""

    scales_px: tuple[float, ...] = (1.2, 2.0, 3.5)
    """Standard deviations of the smoothing, about a tenth to a quarter of the squares that each finds best."""
    min_response: float = 1.6
    """Least response; this one is that of a corner whose colours are four grey levels of 255 apart."""
    min_response_share: float = 0.02
    """The same as a share of the response of a strong corner: weaker saddle points are texture."""
    ring_sigmas: float = 2.5
    """Radius of the circle that edges are looked for on, in standard deviations of the smoothing."""
    same_place_px: float = 2.5
    """Saddle points that are nearer to each other are one."""
    cone_deg: float = 20.0
    """A neighbour lies along an edge within this angle."""
    max_hessian_cosine: float = -0.6
    """Cosine between the Hessians of neighbours, which have opposite colours, at most."""
    sigma_px: float = 0.7
    """Standard deviation of places that are not fitted yet: of saddle points, tags and corners carried back from a view."""


class FitOptions(NamedTuple):
    """The least-squares fit of a blurred saddle to a corner."""

    window_squares: float = 0.42
    """The window reaches this far into the adjoining squares, short of the next edges and their blur."""
    window_gap_share: float = 0.62
    """The same on an AprilGrid, as a share of its gap or of the tags' border, whichever is the narrower."""
    tag_margin_share: float = 0.6
    """Part of the white around a tag that fits use at most."""
    tag_clear_blurs: float = 2.0
    """They stay so many standard deviations of the blur away from the tag, which darkens the white beside it."""
    least_margin_share: float = 0.2
    """Part of that white that they use all the same."""
    max_blur_squares: float = 0.32
    """Wider profiles across an edge are not fitted (standard deviation)."""
    model_sigma_px: float = 0.01
    """What the saddle leaves unmodelled (pixel integration, third-order distortion), added in quadrature to the noise's share."""
    max_sigma_px: float = 0.5
    """Corners that are known less well may be off by more than a pixel, and are none."""


class GridOptions(NamedTuple):
    """A whole checkerboard, as the classic detector finds it."""

    finder_sigma_px: float = 0.3
    """Standard deviation of corners as finders give them."""
    row_priors: tuple[float, ...] = (INF, INF, 0.1, 0.02, 0.003, 0.0005, 0.0001)
    """Standard deviation of the coefficients of a row of corners, in squares, by order: lenses bend rows smoothly."""
    row_remainder: float = 1e-5
    """The same for the order that is left out: what a corner n squares away may be off, over n to that order."""
    misfit_px: float = 1.0
    """A corner is this far from where the others of its row and column say, at most, besides `misfit_squares`."""
    misfit_squares: float = 0.04
    """The part of that distance that grows with the squares."""
    min_good_share: float = 0.8
    """Share of the corners that must be fitted well for a grid to count."""
    goes_on_share: float = 0.6
    """A board goes on beyond a side when more than this share of what would be the next row are corners."""


class MapOptions(NamedTuple):
    """The local map from the board to the photo that corners are predicted by."""

    priors: tuple[float, ...] = (20.0, 10.0, 0.1, 0.03, 0.01)
    """Standard deviation of the coefficients of each order, in units of the spacing as seen in the photo."""
    remainder: float = 2e-4
    """The same for the order that is left out: what a corner n spacings away may be off, over n to that order."""
    min_sigma_px: float = 0.03
    """Of a fitted corner that others are predicted from: prints and lenses are no smoother."""
    misfit_px: float = 0.5
    """A corner is this far from where the others say, at most, besides `misfit_spacings` and three standard deviations."""
    misfit_spacings: float = 0.04
    """The part of that distance that grows with the spacing."""


class CornerOptions(NamedTuple):
    """Which fits are corners of the board."""

    max_step_squares: float = 0.4
    """How far from its prediction a corner may be."""
    min_clearness: float = 3.5
    """Contrast of a corner over what its fit leaves."""
    min_contrast_share: float = 0.2
    """Contrast of a corner over the median contrast."""
    max_blur_squares: float = 0.24
    """Standard deviation of the profile across an edge."""
    usual_blur_factor: float = 1.3
    """Over the usual one it may be so much wider where that is about as wide as `max_blur_squares`."""
    max_usual_blur_squares: float = 0.3
    """And then this wide at most."""
    max_blur_factor: float = 3.0
    """So many times the usual one it is nowhere."""


class GrowthOptions(NamedTuple):
    """Growing a board corner by corner."""

    max_sigma_squares: float = 0.25
    """Corners are looked for where the map is this certain."""
    guess_sigma_squares: float = 1.0
    """Where nothing certain is left, predictions as uncertain as this are tried too."""
    guess_step_squares: float = 0.25
    """Corners found there are this near to them."""
    guess_alike_factor: float = 1.4
    """And as contrasted and clear as the others, within this factor."""
    min_narrow_px: float = 8.0
    """Squares that are at least this wide are also tried with half the window."""
    clearer_factor: float = 1.2
    """A fit that leaves this many times what one without the insides of the squares does has something else in its window
    (0.95 to 1.05 where these are of one colour)."""
    much_clearer_factor: float = 1.5
    """The same for a fit with half the window, and for what other corners leave."""
    min_clearness_share: float = 0.25
    """Contrast over what its fit leaves, as a share of what that is among the corners around it: beyond the end of a board a
    blurred edge fits like a poor corner."""
    max_sigma_factor: float = 10.0
    """A corner whose standard deviation is so many times the usual one is covered in part."""


class PieceOptions(NamedTuple):
    """Pieces of checkerboard in a photo."""

    max_pieces: int = 3
    """That are tried, the largest first."""
    sparse_share: float = 0.25
    """A border row with fewer corners than this share of the fullest is not the board's when the piece is too large."""


class TagOptions(NamedTuple):
    """Reading tags, and telling those of the board from clutter."""

    max_border_errors: float = 0.2
    """Share of the border's cells that may read white."""
    min_contrast_grey: float = 20.0
    """Between the white bits and the border, of 255."""
    corrected_share: float = 0.6
    """Of the wrong bits that a dictionary could put right: clutter reads as a tag less often."""
    max_misfit: float = 0.35
    """How far a tag may be from where a neighbour's affine map expects it, as a share of their distance: lenses bend that much
    over three tags at the rim, while a false or misread tag is off by its distance or more."""
    min_evidence_bits: float = 12.0
    """What tags that agree exceed chance by. A single tag of 16 bits reaches 9 on a board of 30 tags, one of 25 bits 13."""
    certain_share: float = 0.1
    """A tag's corners are known when their standard deviation is below this share of its side."""
    min_likeness: float = 0.4
    """Correlation of the tags of a board with what is seen in their places: their own reach 0.5 with blur of 2 px and bits of
    1.3, others 0.2."""


class AppearanceOptions(NamedTuple):
    """Boards whose tags are too blurred to be read, known by the look of their cells."""

    found_share: float = 0.9
    """With a smaller share of the corners than this the board is also looked for without reading its tags."""
    blur_cells: float = 0.2
    """Width of the boxes that expected grey levels are means of, in widths of the largest cell: about the blur that leaves tags
    unread."""
    min_correlation: float = 0.3
    """Of what is seen with what the best numbering expects."""
    clear_lead: float = 4.0
    """By how much the log likelihood of the best numbering has to exceed that of the next, besides `clear_lead_per_cell`. On
    boards with the tags of another dictionary the best of several hundred numberings led by at most 4.3 over 8 to 33 squares of
    a ChArUco board and 17 over 35 cells of an AprilGrid, on their own boards by 0.8 to 6 per cell."""
    clear_lead_per_cell: float = 0.4
    """The part of that lead that grows with the cells."""
    max_pieces: int = 6
    """Pieces of the board that are tried at each set of scales."""
    enough_share: float = 0.5
    """No more pieces are tried once one with this share of the board's corners looks like no part of it."""
    max_grown: int = 3
    """Nor once so many that had more corners around them do not: the photo shows another board, or texture."""


class RecognitionOptions(NamedTuple):
    """How a board with tags is printed where its specification does not say so, decided on a few of the photos."""

    photos: int = 8
    """Photos that are looked through, spread over all; four times as many where these show no tag of the board."""
    clear_factor: float = 1.2
    """How many times as many tags must agree with another print as with the one given. Of the wrong layout of a ChArUco board
    every other row agrees: half of the tags, and two thirds where three rows are seen."""


class GuidedOptions(NamedTuple):
    """Corners that a camera leads to."""

    near_sigmas: float = 4.0
    """A corner lies within so many standard deviations of its prediction, besides `near_px`."""
    near_px: float = 0.15
    """The part of that distance that is always allowed."""
    far_squares: float = 0.25
    """And never farther from it than this share of a square (or a pixel, where squares are small)."""
    usual_scale_px: float = 0.1
    """What a camera usually leaves of corners."""
    usual_freedom: int = 6
    """How many residuals must say something else to count as much."""
    max_sigma_factor: float = 3.0
    """A corner whose own standard deviation is more than so many times the usual one is given no more room for it."""
    certain_squares: float = 0.2
    """Corners are looked for where the standard deviation of their prediction is below this and `certain_px` together."""
    certain_px: float = 0.5
    """The part of that which does not grow with the squares."""
    max_misfit_spacings: float = 0.05
    """A camera that leaves more than the larger of this and `max_misfit_px` of the known corners (robust standard deviation)
    contradicts them."""
    max_misfit_px: float = 0.5
    """See `max_misfit_spacings`."""
    start_sigma_px: float = 1.5
    """How certain the predictions of a pose are that no corner supports."""
    min_tag_correlation: float = 0.5
    """Of a quarter of the tags in the photo with the printed ones, where no corner supported the pose."""


class ViewOptions(NamedTuple):
    """Straightened views, in which a board that was not found is looked for once more."""

    half_angle_deg: float = 75.0
    """From the middle of a view to its sides."""
    side_px: tuple[int, int] = (480, 800)
    """Views have the photo's resolution, within these limits."""
    max_places: int = 2
    """Views that are looked at."""
    gather_deg: float = 28.0
    """Saddle points so near to one are one place with it."""
    apart_deg: float = 36.0
    """Other places are so far away at least."""


class SharpnessOptions(NamedTuple):
    """Which photos are blurred more than the others of their set."""

    min_photos: int = 6
    """Fewer photos are not compared with each other."""
    cutoff_sigmas: float = 3.5
    """Standard deviations of the sharp photos beyond which a photo is blurred."""
    min_ratio: float = 1.2
    """However alike the sharp photos are, a blur by less than this factor is not named."""
    min_excess_px: float = 0.5
    """Standard deviation of the least blur that is named, in quadrature over that of the sharp photos: motion by 1.7 px."""


@dataclass(frozen=True, repr=False)
class DetectionOptions(Options):
    """All that decides which corners are found in photos."""

    min_corners: int = 6
    """A photo in which a camera leads to fewer corners is of no use to a calibration, and its blur is not judged."""
    search: SearchOptions = SearchOptions()
    saddles: SaddleOptions = SaddleOptions()
    fit: FitOptions = FitOptions()
    grid: GridOptions = GridOptions()
    map: MapOptions = MapOptions()
    corners: CornerOptions = CornerOptions()
    growth: GrowthOptions = GrowthOptions()
    pieces: PieceOptions = PieceOptions()
    tags: TagOptions = TagOptions()
    recognition: RecognitionOptions = RecognitionOptions()
    appearance: AppearanceOptions = AppearanceOptions()
    guided: GuidedOptions = GuidedOptions()
    views: ViewOptions = ViewOptions()
    sharpness: SharpnessOptions = SharpnessOptions()
