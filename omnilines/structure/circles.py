"""The great circles of the arcs of one photo, and how likely each is one of a line along a direction.

A line of the direction d is seen on a great circle through d and -d: its normal n has n . d = 0. Ends of an arc that are off by
(o1, o2) rad across it turn its circle so that at d = a V1 + b V2 it is off by a o1 + b o2. With the covariance of the two, and a
standard deviation t by which lines stray from a common direction, n . d has the variance

    s^2 = (p . d)^2 + (q . d)^2 + t^2,

where p and q hold the noise. Ends of an arc are those of one fit to evenly spaced edge points, which correlates them by -1/2.

Against this stands chance: the arc keeps its place and is turned at random about its middle m. Then the angle between the arc and
the way from m to d is uniform over pi; n . d is its sine times sin(m, d). The ratio of both likelihoods is

    ratio = sqrt(pi / 2) sin(m, d) / s exp(-(n . d)^2 / 2 s^2),

and its mean by chance is at most 1, whatever the noise. No arc reaches the direction of its own line: one that holds d or -d has
the ratio 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from omnilines.geometry.sphere import arc_normal

END_CORRELATION = -0.5
LEAST_SIGMA_RAD, UNKNOWN_RAD = 1e-9, 1e3


@dataclass(frozen=True)
class Circles:
    """n arcs of one photo, camera frame."""

    normal: Float[np.ndarray, "n 3"]
    middle: Float[np.ndarray, "n 3"]
    """Of the arc, unit."""
    noise: Float[np.ndarray, "2 n 3"]
    """p and q: p p' + q q' is the covariance of the normal, rad^2."""
    ends: Float[np.ndarray, "2 n 3"]
    """Of d = a V1 + b V2 in the plane of the arc a and b are its products with these two."""

    def __len__(self) -> int:
        return len(self.normal)

    @staticmethod
    def of_arcs(
        bearings: Float[np.ndarray, "n 2 3"], by_pixel: Float[np.ndarray, "n 2 3 2"], covariance_px2: Float[np.ndarray, "n 2 2 2"]
    ) -> "Circles":
        """From both ends (unit), d bearing / d pixel and the covariance of each end. An arc whose ends are one bearing has no
        circle: it is of no direction."""
        v1, v2 = bearings[:, 0], bearings[:, 1]
        normal = arc_normal(torch.as_tensor(v1), torch.as_tensor(v2)).numpy()
        across = np.einsum("nkxp,nx->nkp", by_pixel, normal)
        sigma = np.sqrt(np.einsum("nkp,nkpq,nkq->nk", across, covariance_px2, across))
        m1, m2 = np.cross(v2, normal), np.cross(normal, v1)
        point = ~normal.any(-1, keepdims=True)
        # Between ends that are the same it would hold every direction.
        w1 = np.where(point, v1, m1) / np.where(point, 1.0, (m1 * v1).sum(-1, keepdims=True))
        w2 = np.where(point, v1, m2) / np.where(point, 1.0, (m2 * v2).sum(-1, keepdims=True))
        first, second = sigma[:, :1] * w1, sigma[:, 1:] * w2
        noise = np.stack([first + END_CORRELATION * second, np.sqrt(1.0 - END_CORRELATION**2) * second])
        noise = np.where(point, UNKNOWN_RAD, noise)
        middle = v1 + v2
        return Circles(normal, middle / np.linalg.norm(middle, axis=-1, keepdims=True), noise, np.stack([w1, w2]))

    def rows(self, chosen: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> "Circles":
        """Some of them."""
        return Circles(self.normal[chosen], self.middle[chosen], self.noise[:, chosen], self.ends[:, chosen])

    def turned(self, rotation: Float[np.ndarray, "3 3"]) -> "Circles":
        """The same in a frame that X' = rotation X leads to."""
        return Circles(self.normal @ rotation.T, self.middle @ rotation.T, self.noise @ rotation.T, self.ends @ rotation.T)

    @staticmethod
    def joined(parts: Sequence["Circles"]) -> "Circles":
        """Those of several photos, in one frame."""
        return Circles(
            np.concatenate([part.normal for part in parts]),
            np.concatenate([part.middle for part in parts]),
            np.concatenate([part.noise for part in parts], 1),
            np.concatenate([part.ends for part in parts], 1),
        )

    @property
    def sigma_rad(self) -> Float[np.ndarray, " n"]:
        """Standard deviation of each normal, both of its components taken together."""
        sigma: Float[np.ndarray, " n"] = np.sqrt(np.square(self.noise).sum((0, -1)))
        return sigma

    def sharpest(self, most: int) -> Int[np.ndarray, " m"]:
        """Rows of those that are known best, in ascending order."""
        return np.sort(np.argsort(self.sigma_rad, kind="stable")[:most])

    def off(self, direction: Float[np.ndarray, "k 3"]) -> tuple[Float[np.ndarray, "k n"], Float[np.ndarray, "k n"]]:
        """n . d and its variance, without strays."""
        variance = np.square(direction @ self.noise[0].T) + np.square(direction @ self.noise[1].T)
        return direction @ self.normal.T, variance + LEAST_SIGMA_RAD**2

    def ratio(self, direction: Float[np.ndarray, "k 3"], stray_rad: Float[np.ndarray, " c"]) -> Float[np.ndarray, "c k n"]:
        """How much more likely each arc is as that of a line along each direction, with each stray, than by chance."""
        off, variance = self.off(direction)
        sine2 = np.clip(1.0 - np.square(direction @ self.middle.T), 0.0, 1.0)
        sine2[(direction @ self.ends[0].T) * (direction @ self.ends[1].T) > 0] = 0.0
        whole = variance + np.square(stray_rad)[:, None, None]
        return np.sqrt(0.5 * np.pi * sine2 / whole) * np.exp(-0.5 * np.square(off) / whole)
