"""The arcs of all photos in one frame, as the stages of matching use them."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from camera_models.errors import GeometryError
from camera_models.pose import Pose
from omnilines.geometry.line import PlueckerLines
from omnilines.triangulation.observations import PlaneObservations


@dataclass(frozen=True)
class ViewedArcs:
    """n arcs of photos with poses, sorted by photo."""

    image: Int[np.ndarray, " n"]
    poses: Pose
    """cam_from_world of every photo."""
    bearings: Float[np.ndarray, "n 2 3"]
    """Both ends, unit, camera frame."""
    by_pixel: Float[np.ndarray, "n 2 3 2"]
    """d bearing / d pixel of both ends."""
    covariance_px2: Float[np.ndarray, "n 2 2 2"]
    """Of both ends."""
    colours: Float[np.ndarray, "n 2 3"]
    """As `appearance.side_colours`; NaN where not known."""

    def __len__(self) -> int:
        return len(self.image)

    @property
    def images(self) -> int:
        """Number of photos."""
        return len(self.poses)

    def rows(self, chosen: Int[np.ndarray, " m"]) -> "ViewedArcs":
        """Some of the arcs, in the same order."""
        return replace(
            self,
            image=self.image[chosen],
            bearings=self.bearings[chosen],
            by_pixel=self.by_pixel[chosen],
            covariance_px2=self.covariance_px2[chosen],
            colours=self.colours[chosen],
        )

    def of_photo(self, image: int) -> "ViewedArcs":
        """The arcs of one photo, and its pose."""
        return self.of_photos(np.array([image]))

    def of_photos(self, images: Int[np.ndarray, " m"]) -> "ViewedArcs":
        """The arcs of some photos (in ascending order), and their poses."""
        own = self.rows(np.flatnonzero(np.isin(self.image, images)))
        return replace(own, image=np.searchsorted(images, own.image), poses=self.poses[images])

    def sharpest(self, most: int) -> "ViewedArcs":
        """The arcs whose great circles are known best, `most` of them at most, in the same order."""
        if len(self) <= most:
            return self
        return self.rows(np.sort(np.argsort(self.circle_sigma_rad, kind="stable")[:most]))

    def widened(self, tolerance_px: float) -> "ViewedArcs":
        """The same with a further standard deviation of every end, for what no arc knows of: errors of poses and cameras."""
        return replace(self, covariance_px2=self.covariance_px2 + tolerance_px**2 * np.eye(2))

    def bowed(self, bow_share: float) -> "ViewedArcs":
        """The same with a further standard deviation of every end, a share of the length of its arc: real edges are not quite
        straight, and the longer an arc is, the less its own noise says of where the line lies that is meant."""
        bow_px2 = (bow_share * self.length_px) ** 2
        return replace(self, covariance_px2=self.covariance_px2 + bow_px2[:, None, None, None] * np.eye(2))

    def moved_to(self, first: Pose) -> "ViewedArcs":
        """The same arcs where all photos moved as one, so that the first of them has the pose `first` (1,)."""
        back = self.poses[[0]].inverse()
        return self.with_poses(self.poses @ (back @ first)[0])

    def with_poses(self, poses: Pose) -> "ViewedArcs":
        """The same arcs in photos that stand elsewhere."""
        return replace(self, poses=poses)

    def require_parallax(self) -> None:
        """Raises GeometryError where fewer than three photos have arcs, or all of them stand at one place."""
        seen = np.unique(self.image)
        if len(seen) < 3:
            raise GeometryError(
                f"Arcs in at least 3 photos with poses were expected to match lines, found {len(seen)}; give more photos."
            )
        centres = self.poses.centre.numpy()[seen]
        spread = float(np.linalg.norm(centres - centres.mean(0), axis=-1).max())
        if spread <= 1e-9 * (1.0 + float(np.abs(centres).max())):
            raise GeometryError(
                f"Photos from different places were expected, found all {len(seen)} at one place, from where no line has a "
                "depth; move the camera between photos."
            )

    @cached_property
    def starts(self) -> Int[np.ndarray, " m"]:
        """First arc of every photo, and one more."""
        return np.searchsorted(self.image, np.arange(self.images + 1))

    @cached_property
    def planes(self) -> PlaneObservations:
        """All interpretation planes, each a track of its own."""
        return PlaneObservations.from_arcs(
            torch.as_tensor(self.bearings),
            self.poses[torch.as_tensor(self.image)],
            torch.arange(len(self)),
            len(self),
            torch.as_tensor(self.by_pixel),
            covariance_px2=torch.as_tensor(self.covariance_px2),
        )

    def tracks(self, rows: Int[np.ndarray, " m"], track: Int[np.ndarray, " m"], tracks: int) -> PlaneObservations:
        """Some of the planes, any of them more than once, put into tracks."""
        return self.planes.take(torch.as_tensor(rows), torch.as_tensor(track), tracks)

    @cached_property
    def px_rad(self) -> Float[np.ndarray, " n"]:
        """Radians across the arc that a pixel is, the larger of both ends."""
        normal = (self.poses.rotation[torch.as_tensor(self.image)] @ self.planes.normal[..., None])[..., 0].numpy()
        return np.linalg.norm(np.einsum("nkxp,nx->nkp", self.by_pixel, normal), axis=-1).max(-1)

    @cached_property
    def reach_rad(self) -> Float[np.ndarray, " n"]:
        """Angle between the ends of each."""
        cosine = (self.bearings[:, 0] * self.bearings[:, 1]).sum(-1)
        return np.arccos(np.clip(cosine, -1.0, 1.0))

    @cached_property
    def length_px(self) -> Float[np.ndarray, " n"]:
        """Length of each, in pixels of the size that they have across it."""
        return self.reach_rad / self.px_rad

    @cached_property
    def sigma_px(self) -> Float[np.ndarray, " n"]:
        """Standard deviation of each arc across it, of its worse end."""
        sigma: Float[np.ndarray, " n"] = self.packed[:, 12:].max(-1) / self.px_rad
        return sigma

    @cached_property
    def circle_sigma_rad(self) -> Float[np.ndarray, " n"]:
        """Standard deviation of each great circle: that of its worse end across it over the sine of its length."""
        sigma: Float[np.ndarray, " n"] = self.packed[:, 12:].max(-1) / np.sin(np.minimum(self.reach_rad, np.pi / 2))
        return sigma

    @cached_property
    def packed(self) -> Float[np.ndarray, "n 14"]:
        """Rows for the kernels: end bearings, plane normal and centre (world), standard deviations across both ends (rad)."""
        planes = self.planes
        assert planes.arcs is not None and planes.noise is not None
        sigma = (planes.noise.mT @ planes.normal[:, None, :, None])[..., 0].norm(dim=-1)
        return torch.cat([planes.arcs.flatten(1), planes.normal, planes.centre, sigma], -1).contiguous().numpy()

    def positions(
        self, lines: PlueckerLines, rows: Int[np.ndarray, " m"], line: Int[np.ndarray, " m"]
    ) -> tuple[Float[np.ndarray, "m 2"], Bool[np.ndarray, " m"]]:
        """Where arcs begin and end along their lines (m, the lower first), and whether they lie in front of their cameras."""
        places, _, usable = self.places(lines, rows, line)
        return places, usable

    def places(
        self, lines: PlueckerLines, rows: Int[np.ndarray, " m"], line: Int[np.ndarray, " m"]
    ) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"], Bool[np.ndarray, " m"]]:
        """As `positions`, with the standard deviation (m) of each for an end that is known to a pixel along the arc."""
        own = lines[torch.as_tensor(line)[:, None].expand(-1, 2)]
        planes = self.tracks(rows, np.zeros(len(rows), dtype=np.int64), 1)
        assert planes.arcs is not None
        places, in_front, leverage = own.position_seen(planes.centre[:, None].expand(-1, 2, -1), planes.arcs)
        usable = in_front.all(-1) & torch.isfinite(places).all(-1)
        ordered = places.sort(-1)
        sigma = leverage.gather(-1, ordered.indices).numpy() * self.px_rad[rows, None]
        return ordered.values.numpy(), sigma, usable.numpy()
