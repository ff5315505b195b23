"""Lines of pylimap beside ours: error and time on a pinhole scene, direction on a noise-free pair of fisheyes."""

import subprocess
import time
from dataclasses import dataclass, replace

import pytest
import torch
from pylimap_scenes import (
    STAGES,
    direction_error_deg,
    distances_m,
    lines_of,
    of_images,
    ours,
    pair_of_fisheyes,
    rms,
    run_pylimap,
    through,
    why_absent,
)
from timing import SMALL, print_table

from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.adjustment.lines import adjust_lines, drop_unknown
from omnilines.costs import COSTS
from omnilines.records import ImagePoses, Segments
from omnilines.synthetic.lines import LineWorld, circle_world
from omnilines.triangulation import TRIANGULATIONS, triangulate
from omnilines.triangulation.observations import PlaneObservations

SEEDS, REPEATS = (2, 1) if SMALL else (20, 3)
SIGMA_PX = 0.5
PEER_NAMES = {
    "two_view": "triangulate_line, 2 views",
    "multi_view": "global_line_triangulation",
    "adjusted": "line adjustment, default options",
    "least_squares": "line adjustment, least squares",
}


@pytest.fixture(scope="module", autouse=True)
def peer() -> None:
    """Skips where pylimap is not installed."""
    reason = why_absent()
    if reason is not None:
        pytest.skip(reason)


def seconds_of(world: LineWorld, segments: Segments, method: str, cost: str) -> tuple[float, float]:
    """Of triangulation and of adjustment with its covariances, from bearings on."""
    given = ImagePoses(segments.images, world.cam_from_world)
    arcs = arcs_from_segments(segments, given, {"cam0": world.camera}).arcs
    start = time.perf_counter()
    poses = world.cam_from_world[arcs.image]
    planes = PlaneObservations.from_arcs(
        arcs.bearings, poses, arcs.track, arcs.tracks, arcs.by_pixel, covariance_px2=arcs.covariance_px2
    )
    found = triangulate(method, planes)
    middle = time.perf_counter()
    inner, tracks = drop_unknown(arcs, found.known)
    adjust_lines(inner, found.lines[tracks], world.cam_from_world, cost=cost, refine_poses=False)
    return middle - start, time.perf_counter() - middle


@dataclass(frozen=True)
class Row:
    """Errors (m) of both ends of the lines of some scenes, NaN where there is no line, and the seconds of each scene."""

    who: str
    what: str
    errors: list[torch.Tensor]
    seconds: list[float]


def print_errors(title: str, rows: list[Row]) -> dict[str, float]:
    """RMS and median over the lines that all rows have, and the least time of a scene; the RMS (m) of every row."""
    every = [torch.cat(row.errors) for row in rows]
    known = [~torch.isnan(errors).any(-1) for errors in every]
    common = torch.stack(known).all(0)
    found = {row.what: rms(errors[common]) for row, errors in zip(rows, every, strict=True)}
    table = []
    for row, errors, own in zip(rows, every, known, strict=True):
        figures = (found[row.what], float(errors[common].median()))
        millimetres = [f"{1e3 * figure:.3f}" for figure in figures]
        table.append([row.who, row.what, str(int(own.sum())), *millimetres, f"{1e3 * min(row.seconds):.1f}"])
    title += f"; error of the {int(common.sum())} of {len(common)} lines that all rows have, least ms of a scene on one thread"
    print_table(title, ["who", "what", "lines", "RMS mm", "median mm", "ms"], table)
    return found


def bench_pinhole_scene_vs_pylimap() -> None:
    worlds = [circle_world("wide", seed) for seed in range(SEEDS)]
    pairs = [(world, world.segments(SIGMA_PX, seed)) for seed, world in enumerate(worlds)]
    first_two = [(world, of_images(segments, 2)) for world, segments in pairs]
    peers = run_pylimap([(world.camera, world.cam_from_world, segments) for world, segments in pairs])

    def peer_row(stage: str) -> Row:
        errors = [distances_m(through(p.ends_m[stage]), w.ends_m) for p, w in zip(peers, worlds, strict=True)]
        return Row("pylimap", PEER_NAMES[stage], errors, [p.seconds[stage] for p in peers])

    def triangulation_row(method: str, scenes: list[tuple[LineWorld, Segments]]) -> Row:
        errors = [distances_m(lines_of(ours(w, s, method).before), w.ends_m) for w, s in scenes]
        return Row("ours", f"triangulation {method}", errors, [seconds_of(w, s, method, "sector")[0] for w, s in scenes])

    def adjustment_row(cost: str) -> Row:
        errors = [distances_m(lines_of(ours(w, s, cost=cost).lines), w.ends_m) for w, s in pairs]
        return Row("ours", f"adjustment {cost}", errors, [seconds_of(w, s, "dual", cost)[1] for w, s in pairs])

    scene = f"{worlds[0].lines} lines, pinhole cameras with known poses, {SIGMA_PX} px, {SEEDS} seeds"
    found = print_errors(
        f"2 views of {scene}", [peer_row("two_view"), *[triangulation_row(method, first_two) for method, _ in TRIANGULATIONS]]
    )
    assert max(found.values()) < 1.001 * min(found.values())
    rows = [peer_row(stage) for stage in STAGES if stage != "two_view"]
    rows += [triangulation_row(method, pairs) for method, _ in TRIANGULATIONS] + [adjustment_row(cost) for cost, _ in COSTS]
    found = print_errors(f"{worlds[0].images} views of {scene}", rows)
    assert found["adjustment whitened"] < 1.01 * found[PEER_NAMES["adjusted"]]
    assert abs(found["adjustment bartoli-sturm"] / found[PEER_NAMES["least_squares"]] - 1) < 0.01


def bench_time_of_many_lines_vs_pylimap() -> None:
    """At 40 lines, calls cost more than arithmetic; here 20 scenes of 8 views lie side by side in one."""
    world = circle_world("wide", 0)
    poses, segments = world.poses(SEEDS), world.segments(SIGMA_PX, 0, SEEDS)
    peers = run_pylimap([(world.camera, poses.cam_from_world, segments)] * REPEATS)
    many = replace(world, cam_from_world=poses.cam_from_world)
    least = [min(times) for times in zip(*[seconds_of(many, segments, "dual", "sector") for _ in range(REPEATS)], strict=True)]
    theirs = {stage: min(peer.seconds[stage] for peer in peers) for stage in ("multi_view", "adjusted")}
    rows = [["pylimap", PEER_NAMES[stage], f"{1e3 * s:.0f}"] for stage, s in theirs.items()]
    rows += [["ours", what, f"{1e3 * s:.0f}"] for what, s in zip(("triangulation dual", "adjustment sector"), least, strict=True)]
    print_table(f"{len(segments.tracks)} lines in {len(poses)} images: time on one thread", ["who", "what", "ms"], rows)


def bench_fisheye_pair_vs_pylimap() -> None:
    world = pair_of_fisheyes()
    segments = world.segments(0.0, 0)
    (peer,) = run_pylimap([(world.camera, world.cam_from_world, segments)], start="two_view")
    rows = []

    def row(who: str, what: str, degrees: torch.Tensor) -> None:
        known = degrees[~torch.isnan(degrees)]
        figures = [f"{value:.2g}" for value in (float(known.median()), rms(known), float(known.max()))]
        rows.append([who, what, f"{len(known)}/{len(degrees)}", *figures])

    row("pylimap", PEER_NAMES["two_view"], direction_error_deg(through(peer.ends_m["two_view"]), world))
    with pytest.raises(subprocess.CalledProcessError, match="SIGABRT") as failure:
        run_pylimap([(world.camera, world.cam_from_world, segments)])
    assert "The camera needs to be undistorted" in failure.value.stderr
    rows.append(["pylimap", PEER_NAMES["multi_view"], "ends the process: 'The camera needs to be undistorted'", "", "", ""])
    rows.append(["pylimap", PEER_NAMES["adjusted"], f"raises: '{peer.refused}'", "", "", ""])
    for method, _ in TRIANGULATIONS:
        row("ours", f"triangulation {method}", direction_error_deg(lines_of(ours(world, segments, method).before), world))
    for cost, _ in COSTS:
        row("ours", f"dual, then {cost}", direction_error_deg(lines_of(ours(world, segments, cost=cost).lines), world))
    title = (
        f"{world.lines} lines 60 to 80 degrees off the axis of two fisheyes 1 m apart, no noise: error of the direction, degrees"
    )
    print_table(title, ["who", "what", "lines", "median", "RMS", "max"], rows)
    assert rows[-1][0] == "ours" and float(rows[-1][-1]) < 1e-6
