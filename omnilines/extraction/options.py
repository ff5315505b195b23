"""What decides which arcs are found in a photo. Grey levels are those of 255; contrasts are taken over all channels."""

from dataclasses import dataclass
from typing import NamedTuple

from camera_models.typed import Options


class EdgeOptions(NamedTuple):
    """Edge points."""

    smoothing_px: float = 0.6
    """Standard deviation of the Gaussian before differences are taken."""
    min_sigmas: float = 4.0
    """Strength of an edge point over the standard deviation of a derivative in the noise."""
    min_slope_grey: float = 1.2
    """Grey levels per pixel, where the noise asks for less: a step of 4 in a sharp photo."""


class ChainOptions(NamedTuple):
    """Edge points linked into chains, and chains cut into pieces of great circles."""

    min_cosine: float = 0.8
    """Between the directions of neighbours in a chain: 37 degrees."""
    min_points: int = 9
    """Edge points on one circle with which a piece begins."""
    max_missed: int = 3
    """Edge points in a row of a chain that may lie farther off the circle than `support.within_px`."""
    sigma_px: float = 0.3
    """Standard deviation of an edge point across the edge, for the covariance that a piece starts with."""


class SupportOptions(NamedTuple):
    """When edge points say that there is an edge on a circle."""

    within_px: float = 0.8
    """Edge points so near to a circle belong to it; an arc whose one part passes farther from the end of the other may bend."""
    min_cosine: float = 0.97
    """Between a circle, or the rim of the image circle, and an edge point that belongs to it: 14 degrees."""
    max_blind_px: float = 5.0
    """Length of a gap that is crossed without edge points."""


class PieceOptions(NamedTuple):
    """Pieces of arcs, before they are joined."""

    min_px: float = 12.0
    """Shorter pieces are dropped, unless shorter arcs are asked for."""
    min_support: float = 0.5
    """Share of a piece beside which there are edge points."""
    min_grey: float = 6.5
    """Contrast of a piece."""
    rounds: int = 2
    """Refits after which pieces are joined."""
    max_growth_px: float = 12.0
    """By so much an arc may grow at either end in each of these refits."""


class RefitOptions(NamedTuple):
    """The circle through the places of the edge in profiles across an arc, and its ends."""

    taper_px: float = 1.0
    """Standard deviation of the weights of a profile, here and where arcs are fitted together."""
    wide_taper_px: float = 1.8
    """The same in the window that tells how much the arc depends on what lies beside it."""
    along_px: float = 3.0
    """Standard deviation of the average along an arc of the difference between its sides."""
    max_shift_px: float = 1.5
    """Farther from an arc there is another edge."""
    max_growth_px: float = 4.0
    """By so much an arc may grow at either end in the last refit."""
    max_end_px: float = 0.4
    """Mean distance of the last few edge places from an arc that ends there, here and where arcs are fitted together."""
    max_tip_px: float = 0.25
    """The same of the outermost two."""
    min_bend_ratio: float = 20.0
    """An arc bends where two circles gain so much over one: F of two and n - 4 degrees of freedom, over the correlation of the
    residuals."""
    floor_px: float = 0.01
    """Standard deviation across the arc that no number of pixels lowers: interpolation, and what the blur's shape hides."""
    bias_sigmas: float = 2.0
    """Standard deviation of an arc over the difference between two fits of it: in a narrow and a wide window, here and where
    arcs are fitted together, and by itself and together."""


class MergingOptions(NamedTuple):
    """Pieces of one edge joined, and duplicates dropped."""

    max_chi2: float = 20.0
    """Of two degrees of freedom; exceeded once in 22000 pairs of one edge."""
    max_off_px: float = 1.0
    """Of the ends of an arc from the circle of one that it is joined with; of the nearer one half of that."""
    max_gap_px: float = 60.0
    """Length of a gap that is crossed where edge points lie in it."""
    max_normal_rad: float = 0.08
    """Between the normals of arcs that are compared."""
    min_gap_support: float = 0.8
    """Share of such a gap beside which there must be edge points."""
    same_px: float = 1.0
    """An arc that lies so near to a longer one over most of its length is the same edge seen twice."""
    edge_sigma_px: float = 0.05
    """Standard deviation across arcs added to what their covariances say: edges are not ideal."""


class NeighbourOptions(NamedTuple):
    """Arcs fitted together with the edges beside them."""

    block_px: int = 5
    """Length along an arc over which profiles are averaged."""
    min_blocks: int = 4
    """Of an arc whose profiles are fitted: a circle through fewer is not asked for."""
    min_cosine: float = 0.95
    """Between an arc and an edge beside it: 18 degrees."""
    crowded_share: float = 0.2
    """Of an arc's length that has others beside it, from which on it is fitted with them."""
    own_sigma_px: float = 1.0
    """Standard deviation of the place of an arc's step about where the arc is."""
    other_sigma_px: float = 0.3
    """The same of the steps beside it: a faint one stays where its own arc says."""
    max_shift_px: float = 2.0
    """Farther from an arc there is another edge."""
    scatter_px: float = 0.02
    """Standard deviation of a place in a profile without noise."""
    floor_px: float = 0.015
    """Standard deviation across the arc that no number of pixels lowers."""
    wide_taper_px: float = 2.0
    """Standard deviation of the weights of a profile in the window that tells how much an arc depends on what lies beside it,
    and in which hidden edges are looked for."""
    blur_factor: float = 1.1
    """Blur that another fit assumes, over the photo's."""
    blur_sigmas: float = 1.0
    """Standard deviation of an arc over the difference between the fits with either blur."""
    max_worse: float = 4.0
    """Variance of an arc fitted with others over its own, from which on the former is not believed."""
    same_px: float = 0.6
    """An arc that lies so near to a longer one over most of its length is the same edge seen twice."""


class BlurOptions(NamedTuple):
    """The blur of a photo, measured on its sharp, lone arcs."""

    min_grey: float = 20.0
    """Contrast of an arc that tells the blur."""
    typical_px: float = 0.7
    """Where no arc tells it."""


class HiddenEdgeOptions(NamedTuple):
    """Edges that one more step in the profiles of known arcs shows."""

    rounds: int = 2
    """Times that edges beside known ones are looked for."""
    min_apart_px: float = 0.7
    """From each known step."""
    min_gain: float = 0.4
    """Share of what is unexplained that one more step must explain for an attempt."""
    min_height_share: float = 0.15
    """Its height over that of the arc's own step: sharpening in the camera leaves fainter steps beside strong ones."""
    min_sigmas: float = 2.5
    """Its height over the noise."""
    min_evidence: float = 1000.0
    """Its mean height over the noise, times the information (1/px^2) that its places give on its distance from the arc."""
    max_unsteady_px: float = 0.7
    """Scatter of its places about a constant distance."""
    max_scatter_px: float = 0.35
    """The same about a great circle."""
    close_blurs: float = 1.3
    """Steps nearer to each other, in units of the blur, look like one step of another shape: pixels undersample an edge that
    runs along them, and blur changes over a photo."""
    max_left: float = 0.6
    """Share of what the known steps leave of the profiles, with the blur that suits them best, that one more step may leave."""
    max_left_close: float = 0.35
    """The same of steps that are close."""
    max_off_px: float = 5.0
    """Of a place of the step from its arc."""
    min_blocks: int = 7
    """With a place of the step."""


class ClutterOptions(NamedTuple):
    """Arcs told from texture."""

    strong_grey: float = 16.0
    """An arc of such a contrast counts whatever is beside it."""
    min_evidence: float = 105.0
    """Of a weaker arc: contrast times the square root of its length (px) over its blur (px). Along an edge the contrast is
    steady, so that it outweighs what varies from pixel to pixel the more the longer it is; and an edge is sharper than most
    texture."""
    min_ratio: float = 3.0
    """Contrast of a weaker arc over that of the same curve moved to the quieter side."""
    long_px: float = 80.0
    """Chance alignments in texture are shorter."""
    block_px: int = 12
    """Length over which colours are averaged along an arc."""


class ImageCircleOptions(NamedTuple):
    """The image circle of a lens or mirror, beyond which all is dark."""

    max_dark_grey: float = 40.0
    """Grey level that what lies outside does not exceed, noise and all."""
    min_step_grey: float = 6.0
    """Above what lies outside: light."""
    min_rim: float = 0.9
    """Share of the directions in which edge points follow the rim of a mirror, around which all is not dark."""
    min_dark_px: int = 8
    """From the border inwards, without light on a ray that begins in the dark."""
    min_dark_rays: float = 0.15
    """Share of all rays that must begin in the dark."""
    same_share: float = 0.01
    """Of the radius, to which rays agree."""
    min_agreeing: float = 0.5
    """Share of the rays that begin in the dark that must meet the first light on one circle."""
    max_light: float = 0.2
    """Share of the pixels outside the circle that may be lighter than `max_dark_grey`: flares, a halo, a printed date."""
    margin_share: float = 0.01
    """Of the radius, left out inside the rim."""
    margin_px: float = 4.0
    """Left out inside the rim at least."""
    slope_share: float = 0.1
    """Of the radius, within which the light may fall off towards the rim."""
    full_light: float = 0.8
    """Of the light at the inner end of that: here the rim ends."""


@dataclass(frozen=True, repr=False)
class ExtractionOptions(Options):
    """Of `extract_arcs`."""

    min_length_px: float = 25.0
    """Shorter arcs are not given back. `reconstruct`, `directions`, `rectify` and, in Python, `extract` take 10: other photos
    confirm arcs or not."""
    min_support: float = 0.65
    """Share of an arc beside which there are edge points."""
    along_sigma_px: float = 1.0
    """Standard deviation of an end point along its arc."""
    coarse_jpeg_quality: int = 80
    """Quality of a JPEG, 1 to 100 as libjpeg has it, below which photos are named: of rendered rooms their arcs are known half as
    well, and a fifth to a quarter of their length is lost."""
    edges: EdgeOptions = EdgeOptions()
    chains: ChainOptions = ChainOptions()
    support: SupportOptions = SupportOptions()
    pieces: PieceOptions = PieceOptions()
    refit: RefitOptions = RefitOptions()
    merging: MergingOptions = MergingOptions()
    neighbours: NeighbourOptions = NeighbourOptions()
    blur: BlurOptions = BlurOptions()
    hidden: HiddenEdgeOptions = HiddenEdgeOptions()
    clutter: ClutterOptions = ClutterOptions()
    image_circle: ImageCircleOptions = ImageCircleOptions()


class SmoothOptions(NamedTuple):
    """What a smooth curve of edge points is, without a camera."""

    min_length_px: float = 25.0
    """Shorter curves are not given back."""
    min_radius_share: float = 0.25
    """Of half the image diagonal: radius of the sharpest bend. A line of the world seen by a lens of 220 degrees has 0.8."""
    max_scatter_px: float = 0.35
    """Standard deviation of the edge points about the curve; texture has more."""
    block_points: int = 9
    """Edge points in a row whose mean distance from the curve is compared with its noise."""
    block_sigmas: float = 5.0
    """That distance over the standard deviation of such a mean, from which on the curve is cut there."""
    block_floor_px: float = 0.25
    """The same in pixels, where the noise asks for less: edge points are drawn to the grid of pixels."""
    corner_points: int = 8
    """Edge points to either side of a corner by which its angle is measured."""
    corner_sigmas: float = 4.0
    """Turn at a corner over what noise and the sharpest bend make."""
    corner_sigma_px: float = 0.2
    """Standard deviation of an edge point for that."""
    max_gap_share: float = 0.5
    """Of the shorter of two curves: gap across which they are one, where one smooth curve explains both."""
    joining_rounds: int = 4
    """Times that pairs of curves are joined."""


@dataclass(frozen=True, repr=False)
class SmoothChainOptions(Options):
    """Of `smooth_chains`."""

    edges: EdgeOptions = EdgeOptions()
    min_cosine: float = 0.8
    """Between the directions of neighbours in a chain: 37 degrees."""
    smooth: SmoothOptions = SmoothOptions()
    strong_grey: float = 16.0
    """An edge of such a contrast, over all channels, counts whatever its length."""
    min_evidence: float = 60.0
    """Of a weaker one: contrast times the square root of its length in pixels. Along an edge the contrast is steady, so that it
    outweighs what varies from pixel to pixel the more the longer it is."""
    image_circle: ImageCircleOptions = ImageCircleOptions()
