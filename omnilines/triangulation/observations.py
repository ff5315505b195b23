"""What a triangulation is given: one interpretation plane per observation, in a flat table with the track of each."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models.errors import InputError
from camera_models.pose import Pose
from omnilines.geometry.sphere import arc_normal


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

    @staticmethod
    def from_arcs(
        bearings: Float[Tensor, "n 2 3"], cam_from_world: Pose, track: Int[Tensor, " n"], tracks: int
    ) -> "PlaneObservations":
        """Planes of arcs given by end bearings (unit, camera frame) and the pose of each row: n = R' (V1 x V2) / |V1 x V2|."""
        world = bearings @ cam_from_world.rotation
        return PlaneObservations(arc_normal(world[:, 0], world[:, 1]), cam_from_world.centre, track, tracks, world)

    def views(self) -> Int[Tensor, " t"]:
        """Number of observations of each track."""
        return torch.bincount(self.track, minlength=self.tracks)

    def by_view_count(self) -> list[tuple[Int[Tensor, " g"], Int[Tensor, "g k"]]]:
        """Tracks of k >= 2 observations together, for each k: (the tracks, the rows of their observations)."""
        views = self.views()
        order = self.track.argsort(stable=True)
        start = views.cumsum(0) - views
        groups = []
        for count in views.unique().tolist():
            if count >= 2:
                tracks = torch.nonzero(views == count).squeeze(-1)
                groups.append((tracks, order[start[tracks, None] + torch.arange(count, device=tracks.device)]))
        return groups
