"""Lines of pylimap, run by .venv-peers: a JSON list of scenes on standard input, a JSON list of results on standard output.

A scene has `model` and `params` of its camera as COLMAP names and orders them, `width`, `height`, `rotation` (k 3 3) and
`translation` (k 3) of cam_from_world, segments: `image` (n), `track` (n), `ends_px` (n 2 2), and `start`, `two_view` or
`multi_view`. A result has two points of the line of every track (t 2 3), null where pylimap gives none:

- `two_view`: `triangulate_line`, from the first two images that see the track;
- `multi_view`, if it is the start: `global_line_triangulation` with its default options, from the matches between all pairs of
  images. It ends the process if a camera has distortion;
- `adjusted`: the lines of the start after its line adjustment of all observations with poses and cameras fixed, default options
  (Cauchy loss, weights by length in pixels);
- `least_squares`: the same adjustment without loss and weights.

`seconds` of each, single-threaded, and `refused`: the message of an adjustment that raised, else null.
"""

import itertools
import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pycolmap
from limap.estimators import bundle_adjustment, triangulation
from limap.geometry import Line2d, Line3d
from limap.scene import HolisticReconstruction, LineMatch, Structure2d, StructureCorrespondenceGraph
from limap.sfm import GlobalLineTriangulationOptions, global_line_triangulation

Lines = list[list[list[float]] | None]


class Scene:
    """Cameras, poses and segments as pylimap holds them; its image ids start at 1."""

    def __init__(self, scene: dict[str, Any]) -> None:
        self.tracks = 1 + max(scene["track"])
        poses = zip(scene["rotation"], scene["translation"], strict=True)
        self.points = pycolmap.Reconstruction()
        size = {key: scene[key] for key in ("model", "width", "height", "params")}
        self.points.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, **size))
        for k, (rotation, translation) in enumerate(poses, start=1):
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array(rotation)), np.array(translation))
            self.points.add_image_with_trivial_frame(pycolmap.Image(name=str(k), image_id=k, camera_id=1), pose)
        self.segments: dict[int, list[Line2d]] = {k: [] for k in sorted(self.points.images)}
        self.number: dict[int, dict[int, int]] = {k: {} for k in self.segments}
        """Of the segment of each track in an image."""
        for image, track, ends in zip(scene["image"], scene["track"], scene["ends_px"], strict=True):
            self.number[image + 1][track] = len(self.segments[image + 1])
            self.segments[image + 1].append(Line2d(*np.array(ends)))
        self.track = {(k, row): track for k, rows in self.number.items() for track, row in rows.items()}

    def reconstruction(self) -> HolisticReconstruction:
        """The images and their segments, without any line in space."""
        whole = HolisticReconstruction(self.points)
        for k, segments in self.segments.items():
            structure = Structure2d()
            structure.set_lines(segments)
            whole.structure_recon.add_structure2d(k, structure)
        return whole

    def with_all_observations(self, start: dict[int, Line3d]) -> HolisticReconstruction:
        """The lines of `start`, each with every observation of its track."""
        whole = self.reconstruction()
        for track, line in start.items():
            whole.structure_recon.add_line3D(track, Line3d(line.start, line.end))
            for image, rows in self.number.items():
                if track in rows:
                    whole.structure_recon.add_line_observation(track, pycolmap.TrackElement(image, rows[track]))
        return whole

    def matches(self) -> StructureCorrespondenceGraph:
        """Every pair of segments of one track in two images."""
        graph = StructureCorrespondenceGraph()
        for k, segments in self.segments.items():
            graph.line_graph.add_image(k, len(segments))
        for a, b in itertools.combinations(self.segments, 2):
            shared = sorted(self.number[a].keys() & self.number[b].keys())
            if shared:
                graph.add_line_matches(a, b, [LineMatch(self.number[a][track], self.number[b][track]) for track in shared])
        graph.line_graph.finalize()
        return graph

    def lines(self, whole: HolisticReconstruction) -> dict[int, Line3d]:
        """The line of each track; that with most observations where a track fell apart."""
        found: dict[int, Line3d] = {}
        for line in whole.structure_recon.lines3D.values():
            members = {self.track[part.image_id, part.point2D_idx] for part in line.track.elements}
            for track in members:
                if track not in found or line.track.length() > found[track].track.length():
                    found[track] = line
        return found


def two_view(scene: Scene) -> dict[int, Line3d]:
    """Intersections of two planes."""
    found = {}
    for track in range(scene.tracks):
        first, second = [k for k, rows in scene.number.items() if track in rows][:2]
        ends = [(scene.segments[k][scene.number[k][track]], scene.points.images[k]) for k in (first, second)]
        line = triangulation.triangulate_line(*ends[0], *ends[1])
        if line is not None:
            found[track] = line
    return found


def multi_view(whole: HolisticReconstruction, graph: StructureCorrespondenceGraph) -> None:
    """Its triangulation of lines from matches, with its default thresholds."""
    options = GlobalLineTriangulationOptions()
    options.num_threads = 1
    whole.structure_recon.initialize_all_wireframes(options.wireframe2d_th)
    global_line_triangulation(options, whole, graph.line_graph, {})


def adjust(whole: HolisticReconstruction, robust: bool) -> None:
    """Its adjustment of lines with poses and cameras fixed."""
    options = bundle_adjustment.PointLineBundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.refine_rig_from_world = options.refine_sensor_from_rig = options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    if not robust:
        options.line_weight_normalization_length = 0.0
        options.loss_function_type_line = type(options.loss_function_type_line).TRIVIAL
        options.ceres.solver_options.gradient_tolerance = 0.0
    config = bundle_adjustment.PointLineBundleAdjustmentConfig()
    for image in whole.point_recon.images:
        config.add_image(image)
    for line in whole.structure_recon.line3D_ids():
        config.add_variable_line(line)
    bundle_adjustment.create_point_line_bundle_adjuster(options, config, whole).solve()


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Wall-clock seconds of one call, and what it returned."""
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


def results(scene: Scene, start: str) -> dict[str, Any]:
    """What pylimap makes of one scene."""
    found: dict[str, dict[int, Line3d]] = {}
    seconds: dict[str, float] = {}
    refused = None
    seconds["two_view"], found["two_view"] = timed(lambda: two_view(scene))
    if start == "multi_view":
        whole, graph = scene.reconstruction(), scene.matches()
        seconds["multi_view"], _ = timed(lambda: multi_view(whole, graph))
        found["multi_view"] = scene.lines(whole)
    for name, robust in (("adjusted", True), ("least_squares", False)):
        whole = scene.with_all_observations(found[start])
        try:
            seconds[name], _ = timed(lambda whole=whole, robust=robust: adjust(whole, robust))
        except ValueError as error:
            refused = str(error)
        else:
            found[name] = scene.lines(whole)
    return {name: table(lines, scene.tracks) for name, lines in found.items()} | {"seconds": seconds, "refused": refused}


def table(lines: dict[int, Line3d], tracks: int) -> Lines:
    """Both ends of the line of every track."""
    return [lines[k].as_array().tolist() if k in lines else None for k in range(tracks)]


if __name__ == "__main__":
    print(json.dumps([results(Scene(scene), scene["start"]) for scene in json.load(sys.stdin)]))
