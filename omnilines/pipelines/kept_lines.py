"""The lines that pass, and what every stage kept and dropped counted."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from camera_models import CameraModel, GeometryError
from omnilines.adjustment.prior import KnownPoses
from omnilines.adjustment.scene import AdjustedScene
from omnilines.matching.match import Matched
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.passing_lines import passing_lines
from omnilines.pipelines.photo_arcs import FoundArcs
from omnilines.progress import ProgressCallback
from omnilines.records import PhotoCount, Segments, StageCount


@dataclass(frozen=True)
class KeptLines:
    """The lines of a set of photos, in the frame of the poses."""

    scene: AdjustedScene
    """`lines` are the supported ones."""
    segments: Segments
    """All arcs in photos with poses, with the track of each; covariances hold the tolerance."""
    stages: tuple[StageCount, ...]
    photos: tuple[PhotoCount, ...]
    """What became of the arcs of each photo of `segments`."""
    matched: Matched
    """The tracks that the lines come from, with the poses that they were matched with."""
    track: Int[np.ndarray, " k"]
    """Of each line, one for all stretches of a line; those beyond the tracks of `matched` are of lines that a corner or a plane
    confirms."""
    held: KnownPoses | None = None
    """The given poses that a prior held."""

    @property
    def tolerance_px(self) -> float:
        """That arcs were matched with."""
        return self.matched.tolerance_px


def kept_lines(
    found: Sequence[FoundArcs],
    segments: Segments,
    matched: Matched,
    scene: AdjustedScene,
    cameras: Mapping[str, CameraModel],
    *,
    options: SceneOptions,
    progress: ProgressCallback,
) -> KeptLines:
    """The lines that pass, clipped, and the counts of all stages.

    Raises GeometryError where none does.
    """
    own = passing_lines(found, matched, scene, cameras, options=options, progress=progress)
    table, dropped, known = own.table, own.dropped, scene.lines.known
    if not len(table):
        none = f"{int((~known).sum())} have no line in space, {dropped.far} lie more than {own.limit_px:.1f} px from their arcs"
        raise GeometryError(
            f"No line was left: of {len(known)} triangulated, {none}, {dropped.weak} are too uncertain, {dropped.unsupported} "
            f"are nowhere shown by {options.min_views} photos, {dropped.by_chance} by chance alone, and photos "
            f"show too little of {dropped.hardly_shown} (`min_shown_share`); give photos from more places."
        )
    filtered = (
        *((f"status {status}", n) for status, n in Counter(scene.lines.status).items() if status not in ("ok", "weak")),
        (f"more than {own.limit_px:.1f} px from their arcs", dropped.far),
        ("weak: too uncertain for their distance", dropped.weak),
        ("nowhere supported by enough photos", dropped.unsupported),
        ("by chance as many photos would show them", dropped.by_chance),
        ("photos that look there show too little of them", dropped.hardly_shown),
    )
    stages = (*arc_stages(found, segments, matched, options.min_views), StageCount("lines", len(table), counted(filtered)))
    segments = replace(segments, track=own.row, tracks=table.tracks)
    photos = photo_counts(segments, matched, options.min_views)
    return KeptLines(replace(scene, lines=table), segments, stages, photos, matched, own.track)


def counted(reasons: Sequence[tuple[str, int]]) -> tuple[tuple[str, int], ...]:
    """The reasons that hold for any."""
    return tuple((reason, count) for reason, count in reasons if count)


def arc_stages(found: Sequence[FoundArcs], segments: Segments, matched: Matched, min_views: int) -> tuple[StageCount, ...]:
    """From arcs to triangulated tracks."""
    total = sum(map(len, found))
    tracks = matched.tracks
    member = tracks.track >= 0
    # A line may take an arc in that led to none by itself.
    partner, several, enough = (agree | member for agree in _agreement(matched, min_views))
    return (
        StageCount("detected arcs", total, counted([("photos skipped", sum(arcs.reason is not None for arcs in found))])),
        StageCount("in photos with poses", len(segments), counted([("in photos without a pose", total - len(segments))])),
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
                    (f"fewer than {min_views} photos agree", int((several & ~enough).sum())),
                    ("did not fit the others of a track", int((enough & ~member).sum())),
                ]
            ),
        ),
        StageCount(
            "tracks triangulated",
            len(tracks),
            counted([("parts of other tracks", tracks.merged), ("other lines explain what they show", tracks.explained)]),
        ),
    )


def photo_counts(segments: Segments, matched: Matched, min_views: int) -> tuple[PhotoCount, ...]:
    """The same of each photo of `segments`, whose `track` is the line of every arc; later stages are parts of those before."""
    in_line = segments.track >= 0
    # Those of lines that a corner or a plane confirms are in no track of `matched`.
    in_track = (matched.tracks.track >= 0) | in_line
    partner, several, enough = _agreement(matched, min_views)
    stages = (np.ones_like(partner), partner | in_track, several | in_track, (several & enough) | in_track, in_track, in_line)
    counts = [np.bincount(segments.image, weights=stage, minlength=len(segments.images)) for stage in stages]
    return tuple(PhotoCount(image, *(int(count[k]) for count in counts)) for k, image in enumerate(segments.images))


def _agreement(matched: Matched, min_views: int) -> tuple[Bool[np.ndarray, " n"], ...]:
    """Of every arc whether it has a partner, whether two other photos agree, and whether enough do."""
    partner = matched.hypotheses.candidates > 0
    others = matched.agreeing_photos()
    return partner, partner & (others >= 2), partner & (others + 1 >= min_views)


def shown_lines(image: Int[np.ndarray, " n"], line: Int[np.ndarray, " n"], photos: int, lines: int) -> sparse.csr_array:
    """(photos, lines): 1 where a photo has arcs of a line; `image` and `line` (-1 for none) are those of every arc."""
    member = line >= 0
    pairs = np.unique(np.stack([image[member], line[member]]), axis=1)
    return sparse.csr_array((np.ones(pairs.shape[1], dtype=np.int64), pairs), shape=(photos, lines))


def shared_lines(shows: sparse.csr_array) -> sparse.csr_array:
    """How many lines each two photos have arcs of; on the diagonal, how many a photo has."""
    return (shows @ shows.T).tocsr()


def shown_at(shows: sparse.csr_array, instants: Sequence[str]) -> tuple[sparse.csr_array, tuple[str, ...]]:
    """(instants, lines): the lines that photos of one instant of a rig show together, and the instants; `shows` are those of
    each photo, `instants` that of each."""
    names, of_photo = np.unique(np.array(instants), return_inverse=True)
    photos = np.arange(len(of_photo))
    joined = sparse.csr_array((np.ones(len(photos), dtype=np.int64), (of_photo, photos)), shape=(len(names), len(photos)))
    return (joined @ shows > 0).astype(np.int64), tuple(str(name) for name in names)


def least_joined(scene: KeptLines) -> tuple[str, str, int]:
    """The weakest link between photos, or instants of a rig where there are several, and how many lines they share; where no
    lines join all, the nearest two that none join, and 0."""
    segments, poses = scene.segments, scene.scene.poses
    several = len(set(poses.instants)) > 1
    instant = dict(zip(poses.images, poses.instants if several else poses.images, strict=True))
    shows = shown_lines(segments.image, segments.track, len(segments.images), len(scene.scene.lines))
    shows, names = shown_at(shows, [instant[image] for image in segments.images])
    shared, centre = shared_lines(shows), dict(zip(instant.values(), poses.cam_from_world.centre.numpy(), strict=True))
    apart = nearest_apart(shared, np.stack([centre[name] for name in names]))
    a, b, number = weakest_link(shared) if apart is None else (*apart, 0)
    return names[a], names[b], number


def nearest_apart(shared: sparse.csr_array, centres: Float[np.ndarray, "photos 3"]) -> tuple[int, int] | None:
    """Of photos that no lines join, not by others either, the two nearest to each other; None where lines join all photos."""
    parts, part = connected_components(shared, directed=False)
    if parts == 1:
        return None
    nearest = []
    for own in range(parts):
        mine, others = np.flatnonzero(part == own), np.flatnonzero(part != own)
        away, which = (np.atleast_1d(found) for found in KDTree(centres[others]).query(centres[mine]))
        k = int(away.argmin())
        nearest.append((float(away[k]), int(mine[k]), int(others[which[k]])))
    _, a, b = min(nearest)
    return a, b


def weakest_link(shared: sparse.csr_array) -> tuple[int, int, int]:
    """Of the tree that joins all photos by the most shared lines, the link of the fewest: two photos, and how many lines."""
    count = shared.shape[0]
    joined, weakest = np.zeros(count, dtype=bool), (0, 0, int(shared.max()) + 1)
    most, to = np.full(count, -1), np.zeros(count, dtype=np.int64)
    b = int(shared.diagonal().argmax())
    while True:
        joined[b] = True
        if joined.all():
            return weakest
        # Of each photo the joined one that it shares most lines with.
        own = shared[[b]].toarray()[0]
        better = own > most
        most[better], to[better] = own[better], b
        b = int(np.where(joined, -1, most).argmax())
        weakest = min(weakest, (int(to[b]), b, int(most[b])), key=lambda link: link[2])
