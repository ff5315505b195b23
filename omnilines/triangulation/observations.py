"""What a triangulation is given: one interpretation plane per observation, in a flat table with the track of each."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.errors import InputError
from camera_models.pose import Pose
from omnilines.geometry.sphere import arc_normal
from omnilines.triangulation.compiled import on_processor, planes, track_rows
from omnilines.triangulation.kernels.track import TrackRows


@dataclass(frozen=True)
class PlaneObservations:
    """n planes n . (X - C) = 0 of t tracks of unequal length, rows in any order."""

    normal: Float[Tensor, "n 3"]
    """Unit normals in the world frame, of either sign."""
    centre: Float[Tensor, "n 3"]
    """Camera centre C of each observation, metres."""
    track: Int[Tensor, " n"]
    """Track of each observation, 0 to tracks - 1."""
    tracks: int
    arcs: Float[Tensor, "n 2 3"] | None = None
    """End bearings (unit, world frame) of each arc; with them the segment is known as well as its plane."""
    noise: Float[Tensor, "n 2 3 2"] | None = None
    """A with A A' = J Sigma J', the covariance (rad^2) of each end bearing, world frame; None for isotropic noise of bearings."""
    noise_stated: bool = False
    """False where `noise` is right only up to one common factor, that of a noise of 1 px."""

    def __post_init__(self) -> None:
        if len(self.track) and not (0 <= int(self.track.min()) and int(self.track.max()) < self.tracks):
            raise InputError(
                f"Track numbers have to lie in 0 to {self.tracks - 1}, found {int(self.track.min())} to {int(self.track.max())}; "
                "leave out the observations that belong to no track."
            )
        wrong = ~((self.normal.norm(dim=-1) - 1).abs() < 1e-6) | ~torch.isfinite(self.centre).all(-1)
        if bool(wrong.any()):
            raise InputError(
                "Every plane needs a finite camera centre and a normal of unit length, found "
                f"{int(wrong.sum())} of {len(wrong)} rows without (the first is row {int(wrong.nonzero()[0])}); "
                "leave out arcs whose ends coincide and rows with NaN."
            )
        if self.noise is not None and self.arcs is None:
            raise InputError("The noise of end bearings was expected together with their arcs, found no arcs; give both.")

    @staticmethod
    def from_arcs(
        bearings: Float[Tensor, "n 2 3"],
        cam_from_world: Pose,
        track: Int[Tensor, " n"],
        tracks: int,
        by_pixel: Float[Tensor, "n 2 3 2"] | None = None,
        *,
        covariance_px2: Float[Tensor, "n 2 2 2"] | None = None,
    ) -> "PlaneObservations":
        """Planes of arcs given by end bearings (unit, camera frame) and the pose of each row: n = R' (V1 x V2) / |V1 x V2|.

        `by_pixel` is J = d bearing / d pixel of both ends. `covariance_px2` is Sigma of both end points; without it the noise of
        pixels is taken to be isotropic and of unknown size. Raises InputError where Sigma is not positive definite.
        """
        if by_pixel is None and covariance_px2 is not None:
            raise InputError(
                "The pixel covariance of end points was expected together with the derivative of bearings by pixels, found none; "
                "give by_pixel too."
            )
        stated = covariance_px2 is not None
        if on_processor(bearings):
            normal, world, noise, wrong = planes(bearings, cam_from_world, by_pixel, covariance_px2)
            if wrong:
                raise _not_definite(wrong, 2 * len(bearings))
            return PlaneObservations(normal, cam_from_world.centre, track, tracks, world, noise, stated)
        world = bearings @ cam_from_world.rotation
        noise = None
        if by_pixel is not None:
            noise = cam_from_world.rotation.mT[:, None] @ by_pixel
            if covariance_px2 is not None:
                noise = noise @ _square_root(covariance_px2)
        normal = arc_normal(world[:, 0], world[:, 1])
        return PlaneObservations(normal, cam_from_world.centre, track, tracks, world, noise, stated)

    def take(self, rows: Int[Tensor, " m"], track: Int[Tensor, " m"], tracks: int) -> "PlaneObservations":
        """Some of the rows, any of them more than once, with other track numbers."""
        arcs = None if self.arcs is None else self.arcs[rows]
        noise = None if self.noise is None else self.noise[rows]
        return PlaneObservations(self.normal[rows], self.centre[rows], track, tracks, arcs, noise, self.noise_stated)

    def rows(self, chosen: Bool[Tensor, " n"]) -> "PlaneObservations":
        """The chosen rows; tracks keep their numbers."""
        kept = torch.nonzero(chosen).squeeze(-1)
        return self.take(kept, self.track[kept], self.tracks)

    def of_tracks(self, tracks: Int[Tensor, " k"]) -> tuple["PlaneObservations", Int[Tensor, " m"]]:
        """The rows of some tracks, renumbered in that order; and which rows they are."""
        place = torch.full((self.tracks,), -1, device=self.track.device)
        place[tracks] = torch.arange(len(tracks), device=place.device)
        own = place[self.track]
        kept = torch.nonzero(own >= 0).squeeze(-1)
        return self.take(kept, own[kept], len(tracks)), kept

    @cached_property
    def by_track(self) -> TrackRows:
        """For the compiled passes."""
        return track_rows(self.track, self.tracks, self.normal, self.centre, self.arcs)

    @cached_property
    def places(self) -> tuple[Int[Tensor, " p"], Int[Tensor, " n"]]:
        """The track of each place that a track was observed from, and the place of each observation. Pieces of a line in one
        photo are of one place, and photos of one place tell no more of it than one."""
        labels = torch.cat([self.track[:, None].to(self.centre.dtype), self.centre], 1)
        places, place = torch.unique(labels, dim=0, return_inverse=True)
        return places[:, 0].long(), place

    def counts(self) -> Int[Tensor, " t"]:
        """Number of observations of each track."""
        return torch.bincount(self.track, minlength=self.tracks)

    def sum_by_track(self, values: Float[Tensor, "n *rest"]) -> Float[Tensor, "t *rest"]:
        """Sums of the values of the rows of each track."""
        total = torch.zeros(self.tracks, *values.shape[1:], dtype=values.dtype, device=values.device)
        return total.index_add(0, self.track, values)

    def by_count(self) -> list[tuple[Int[Tensor, " g"], Int[Tensor, "g k"]]]:
        """Tracks of k >= 2 observations together, for each k: (the tracks, the rows of their observations)."""
        counts = self.counts()
        order = self.track.argsort(stable=True)
        start = counts.cumsum(0) - counts
        groups = []
        for count in counts.unique().tolist():
            if count >= 2:
                tracks = torch.nonzero(counts == count).squeeze(-1)
                groups.append((tracks, order[start[tracks, None] + torch.arange(count, device=tracks.device)]))
        return groups


def _square_root(covariance_px2: Float[Tensor, "n 2 2 2"]) -> Float[Tensor, "n 2 2 2"]:
    factor, info = torch.linalg.cholesky_ex(covariance_px2)
    wrong = (info != 0) | ~torch.isfinite(factor).flatten(-2).all(-1)
    if bool(wrong.any()):
        raise _not_definite(int(wrong.sum()), wrong.numel())
    return factor


def _not_definite(wrong: int, all_ends: int) -> InputError:
    return InputError(
        f"The covariance of every end point has to be positive definite, found {wrong} of {all_ends} that "
        "are not; state a standard deviation above 0 px for every end point."
    )
