"""What every stage of matching kept and dropped, over all photos and of each photo."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int

from omnilines.matching.match import Matched
from omnilines.pipelines.photo_arcs import FoundArcs
from omnilines.records import PhotoCount, Segments, StageCount


def counted(reasons: Sequence[tuple[str, int]]) -> tuple[tuple[str, int], ...]:
    """The reasons that hold for any."""
    return tuple((reason, count) for reason, count in reasons if count)


def arc_stages(found: Sequence[FoundArcs], segments: Segments, matched: Matched, least_views: int) -> tuple[StageCount, ...]:
    """From arcs to triangulated tracks."""
    total = sum(map(len, found))
    tracks = matched.tracks
    member = tracks.track >= 0
    partner, several, enough = _agreement(matched, least_views)
    lost = several & ~member
    return (
        StageCount("detected arcs", total, counted([("photos skipped", sum(arcs.reason is not None for arcs in found))])),
        StageCount("in photos with poses", len(segments), counted([("photo without a pose", total - len(segments))])),
        StageCount(
            "matched",
            int(partner.sum()),
            counted([("no arc of another photo could show its line and looks like it", int((~partner).sum()))]),
        ),
        StageCount(
            "confirmed by a third photo",
            int(several.sum()),
            counted([("only one photo agrees", int((partner & ~several).sum()))]),
        ),
        StageCount(
            "in tracks",
            int(member.sum()),
            counted(
                [
                    (f"fewer than {least_views} photos agree", int((lost & ~enough).sum())),
                    ("did not fit the others of a track", int((lost & enough).sum())),
                ]
            ),
        ),
        StageCount(
            "tracks triangulated",
            len(tracks),
            counted([("parts of other tracks", tracks.merged), ("other lines explain what they show", tracks.explained)]),
        ),
    )


def photo_counts(segments: Segments, matched: Matched, least_views: int) -> tuple[PhotoCount, ...]:
    """The same of each photo of `segments`, whose `track` is the line of every arc; later stages are parts of those before."""
    in_line, in_track = segments.track >= 0, matched.tracks.track >= 0
    partner, several, enough = _agreement(matched, least_views)
    # A line may take an arc in that led to none by itself.
    stages = (np.ones_like(partner), partner | in_track, several | in_track, (several & enough) | in_track, in_track, in_line)
    counts = [np.bincount(segments.image, weights=stage, minlength=len(segments.images)) for stage in stages]
    return tuple(PhotoCount(image, *(int(count[k]) for count in counts)) for k, image in enumerate(segments.images))


def _agreement(matched: Matched, least_views: int) -> tuple[Bool[np.ndarray, " n"], ...]:
    """Of every arc whether it has a partner, whether two other photos agree, and whether enough do."""
    partner = matched.hypotheses.candidates > 0
    others = matched.agreeing_photos()
    return partner, partner & (others >= 2), partner & (others + 1 >= least_views)


def shared_lines(segments: Segments, lines: int) -> Int[np.ndarray, "m m"]:
    """How many lines each two photos have arcs of; on the diagonal, how many a photo has."""
    shows = np.zeros((lines, len(segments.images)), dtype=np.int64)
    member = segments.track >= 0
    shows[segments.track[member], segments.image[member]] = 1
    return shows.T @ shows


def weakest_link(shared: Int[np.ndarray, "m m"]) -> tuple[int, int, int]:
    """Of the tree that joins all photos by the most shared lines, the link of the fewest: two photos, and how many lines."""
    joined = np.zeros(len(shared), dtype=bool)
    joined[int(shared.diagonal().argmax())] = True
    weakest = (0, 0, int(shared.max()) + 1)
    while not joined.all():
        between = np.where(joined[:, None] & ~joined, shared, -1)
        a, b = np.unravel_index(int(between.argmax()), between.shape)
        joined[b] = True
        weakest = min(weakest, (int(a), int(b), int(shared[a, b])), key=lambda link: link[2])
    return weakest
