"""Directions and Manhattan frames of rendered rooms and streets against the true ones.

    python tests/bench/bench_directions.py [--seeds 1] [--small]

Rooms have furniture that is turned by tenths of degrees beside the walls. Directions are compared with the nearest axis; 'missed'
are axes that have none within 0.25 degrees. Of 'exact' edges arcs state no error but that of their fit: `refit.floor_px` and
`neighbours.floor_px`, for what no average removes in real photos, are none there. Photos of York Urban: `bench_york.py`.
"""

import argparse
import math
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from timing import print_table

import omnilines as ol
from camera_models import Equirectangular
from omnilines.options import with_settings
from omnilines.pipelines.arcs import SHORT_ARCS
from omnilines.pipelines.directions import circles_of
from omnilines.structure.circles import Circles
from omnilines.structure.manhattan import manhattan_frame
from omnilines.structure.meeting import meeting_directions

EXACT = with_settings(SHORT_ARCS, ("refit.floor_px=1e-6", "neighbours.floor_px=1e-6"))
ROOMS: tuple[tuple[str, float | None, tuple[int, int]], ...] = (
    ("opencv-fisheye", 190.0, (1100, 1100)),
    ("scaramuzza", 220.0, (1100, 1100)),
    ("equirectangular", None, (1600, 800)),
)


class Scores:
    """Errors of directions, and which directions and frames are within the 95 percent of what is stated."""

    def __init__(self) -> None:
        self.errors_deg, self.inside, self.frames, self.missed = list[float](), list[bool](), list[bool](), 0

    def add(self, circles: Circles, axes: np.ndarray) -> None:
        """A photo with the true directions as columns."""
        found, frame = meeting_directions(circles), manhattan_frame(circles)
        seen = set()
        for direction, covariance in zip(found.direction, found.covariance, strict=True):
            cosine = direction @ axes
            k = int(np.abs(cosine).argmax())
            error = np.sign(cosine[k]) * axes[:, k] - direction
            if float(np.linalg.norm(error)) < math.radians(0.25):
                seen.add(k)
                self.errors_deg.append(math.degrees(float(np.linalg.norm(error))))
                self.inside.append(float(error @ np.linalg.pinv(covariance, 1e-6) @ error) < 5.991)
        self.missed += 3 - len(seen)
        if frame is not None:
            near = axes @ np.round(axes.T @ frame.cam_from_world) @ frame.cam_from_world.T
            turn = 0.5 * np.array([near[2, 1] - near[1, 2], near[0, 2] - near[2, 0], near[1, 0] - near[0, 1]])
            self.frames.append(float(turn @ np.linalg.solve(frame.covariance, turn)) < 7.815)

    @property
    def cells(self) -> list[str]:
        """Of a row of the table."""
        shares = [f"{np.mean(one):.1%}" for one in (self.inside, self.frames)]
        return [f"{np.median(self.errors_deg):.4f}", f"{max(self.errors_deg):.3f}", str(self.missed), *shares]


def room_rows(scene: str, model: str, fov_deg: float | None, size: tuple[int, int], seeds: int, views: int) -> list[list[str]]:
    edges = {"as photos have them": (SHORT_ARCS, Scores()), "exact": (EXACT, Scores())}
    for seed in range(1, 1 + seeds):
        options = ol.RenderOptions(views=views, fov_deg=fov_deg, size_px=size, seed=seed)
        made = ol.render(scene, model if fov_deg is not None else Equirectangular([], size), options)
        turns = dict(zip(made.poses.images, made.poses.cam_from_world.rotation.numpy(), strict=True))
        photos = {name: made.photos[name] for name in made.poses.images}
        for extraction, scores in edges.values():
            for one in ol.extract(photos, made.camera, options=extraction).used:
                scores.add(circles_of(one, made.camera), turns[one.photo.name])
    return [[scene, made.camera.NAME, name, *scores.cells] for name, (_, scores) in edges.items()]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--small", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    scenes = ("plain-room",) if given.small else ("plain-room", "room", "street")
    seeds, views = (1, 1) if given.small else (given.seeds, 8)
    rows = [
        row for scene in scenes for one in ROOMS[: 1 if given.small else None] for row in room_rows(scene, *one, seeds, views)
    ]
    header = ["scene", "camera", "edges", "median, degrees", "largest", "missed", "inside 95: directions", "frames"]
    print_table("Directions of rendered scenes", header, rows)


if __name__ == "__main__":
    main()
