"""A room whose photos are worked on by this process and by workers."""

from functools import cached_property
from pathlib import Path

import numpy as np

import omnilines as ol
from camera_models import Calibration, load
from omnilines.commands.render_scene import render_scene
from omnilines.commands.render_targets import render_targets
from omnilines.pipelines.photo_arcs import PhotoArcs
from omnilines.pipelines.render import MODEL, RenderOptions

SIZE, VIEWS, PATTERN = (320, 240), 5, "checkerboard:8x6:30mm"


class Scene:
    """Photos of a room, worked on by this process, and of a board."""

    def __init__(self, folder: Path, views: int) -> None:
        self.folder, self.room = folder, folder / "room"
        render_scene(self.room, scene="plain-room", views=views, size=SIZE)
        self.cameras: Calibration = load(self.room / "calibration.yaml")
        self.arcs = ol.extract(self.room, self.cameras)

    @cached_property
    def board(self) -> Path:
        """Photos of a board."""
        render_targets(self.folder / "board", PATTERN, MODEL, RenderOptions(190.0, VIEWS, (640, 480)))
        return self.folder / "board"

    def require_same_arcs(self, other: PhotoArcs) -> None:
        """Equal to the last bit, whichever process found them."""
        assert [arcs.photo.name for arcs in other.photos] == [arcs.photo.name for arcs in self.arcs.photos]
        assert len(self.arcs) > 10 * len(self.arcs.photos)
        for one, own in zip(other.photos, self.arcs.photos, strict=True):
            for name in ("endpoints_px", "covariance_px2", "length_px", "colours"):
                np.testing.assert_array_equal(getattr(one, name), getattr(own, name))
