"""The compiled triangulation against the general path in torch, tracks in batches, and other devices where there are some."""

import dataclasses
from typing import Any

import pytest
import torch
from engine_scenes import Row, row

from camera_models import InputError
from omnilines.adjustment import lines as adjustment
from omnilines.adjustment.lines import adjust_lines, end_sigma_m
from omnilines.adjustment.minimum import minimum_on
from omnilines.adjustment.problem import LineProblem
from omnilines.least_squares import Loss, Outcome
from omnilines.least_squares.devices import moved_to, usable_device
from omnilines.triangulation import degeneracy, dual, likelihood, observations, residuals, triangulate
from omnilines.triangulation.batches import triangulate_on
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.result import Triangulation


def planes(scene: Row, stated: bool = True) -> PlaneObservations:
    arcs = scene.arcs
    covariance = arcs.covariance_px2 if stated else None
    return PlaneObservations.from_arcs(
        arcs.bearings, scene.poses[arcs.image], arcs.track, arcs.tracks, arcs.by_pixel, covariance_px2=covariance
    )


def hard(scene: Row) -> Row:
    """With tracks of one and two views, of none, of one camera's view twice, and of arcs that look the other way."""
    arcs = scene.arcs
    first = torch.cat([torch.nonzero(arcs.track == t).flatten()[: max(t, 0)] for t in range(3)])
    kept = arcs.track > 2
    kept[first] = True
    bearings = arcs.bearings.clone()
    bearings[arcs.track == 5] *= -1
    image = torch.where(arcs.track == 6, arcs.image[arcs.track == 6][0], arcs.image)
    return dataclasses.replace(scene, arcs=dataclasses.replace(arcs, bearings=bearings, image=image).rows(kept))


def assert_same(found: Triangulation, expected: Triangulation, tolerance: float = 1e-9) -> None:
    assert found.status_names == expected.status_names
    known = expected.known
    assert int(known.sum()) > 40
    assert float(found.lines[known].angle_to(expected.lines[known]).max()) < tolerance
    assert float(found.lines[known].distance_between(expected.lines[known]).max()) < 10 * tolerance
    for name in ("views", "plane_angle_rad", "residual_rad"):
        torch.testing.assert_close(
            getattr(found, name), getattr(expected, name), rtol=100 * tolerance, atol=1e-12, equal_nan=True
        )
    assert abs(found.variance_factor / expected.variance_factor - 1) < 1e-6
    # Which of two cameras equally far from a line its chart is about, rounding decides: compared is what does not depend on it.
    ends = expected.ends_m
    sigma = [end_sigma_m(each.chart, each.covariance, ends)[known] for each in (found, expected)]
    torch.testing.assert_close(sigma[0], sigma[1], rtol=1e3 * tolerance + 1e-5, atol=0, equal_nan=True)


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("method", ["dual", "ml"])
def test_compiled_lines_are_those_of_torch(monkeypatch: pytest.MonkeyPatch, stated: bool, method: str) -> None:
    scene = hard(row(lines=80, seed=7))
    given = planes(scene, stated)
    found = triangulate(method, given)
    assert found.covariance.shape == (80, 4, 4)
    for module in (degeneracy, dual, likelihood, observations, residuals):
        monkeypatch.setattr(module, "on_processor", lambda values: False)
    general = planes(scene, stated)
    torch.testing.assert_close(given.normal, general.normal, rtol=0, atol=1e-14)
    torch.testing.assert_close(given.noise, general.noise, rtol=1e-12, atol=1e-15)
    # Iterations end within a tolerance, closed forms at rounding.
    assert_same(found, triangulate(method, general), 1e-9 if method == "dual" else 1e-6)


def test_planes_without_arcs_give_what_torch_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = planes(row(lines=80, seed=8))
    given = PlaneObservations(whole.normal, whole.centre, whole.track, whole.tracks)
    found = triangulate("dual", given)
    for module in (degeneracy, dual, likelihood, observations, residuals):
        monkeypatch.setattr(module, "on_processor", lambda values: False)
    expected = triangulate("dual", given)
    assert found.status_names == expected.status_names
    assert float(found.lines.angle_to(expected.lines).nan_to_num().max()) < 1e-9


def test_batches_give_what_all_tracks_give_at_once() -> None:
    given = planes(hard(row(lines=80, seed=9)))
    whole, parts = triangulate("dual", given), triangulate_on(torch.device("cpu"), "dual", given, at_once=37)
    assert whole.status_names == parts.status_names
    torch.testing.assert_close(parts.lines.moment, whole.lines.moment, rtol=1e-12, atol=1e-13, equal_nan=True)
    torch.testing.assert_close(parts.covariance, whole.covariance, rtol=1e-9, atol=0, equal_nan=True)


def wrong(scene: Row) -> Row:
    """With two of five observations somewhere else."""
    arcs = scene.arcs
    far = torch.rand(len(arcs), generator=torch.Generator().manual_seed(0)) < 0.4
    bearings = torch.where(far[:, None, None], arcs.bearings + 0.02, arcs.bearings)
    return dataclasses.replace(scene, arcs=dataclasses.replace(arcs, bearings=bearings / bearings.norm(dim=-1, keepdim=True)))


@pytest.mark.parametrize("poses", [False, True])
def test_lines_go_to_their_own_minima_also_where_another_device_iterates(monkeypatch: pytest.MonkeyPatch, poses: bool) -> None:
    """The way that a GPU takes, on the processor: as many iterations as in the compiled engine, not more than are allowed."""
    scene, device = wrong(row(lines=400, reach=8, seed=3)), torch.device("cpu")

    def there(task: Any, state: Any, prior: Any, most: int, callback: Any, *, place: torch.device) -> Any:
        problem = LineProblem(task.arcs, task.cost, task.freedom, state, prior)
        return minimum_on(device, problem, state, task.loss, max_iterations=most, callback=callback)

    options: dict[str, Any] = {"loss": Loss("cauchy", 2.0), "refine_poses": poses}
    compiled = adjust_lines(scene.arcs, scene.lines, scene.poses, **options)
    with monkeypatch.context() as patch:
        patch.setattr(adjustment, "line_minimum", there)
        found = adjust_lines(scene.arcs, scene.lines, scene.poses, **options)
    assert found.outcome is compiled.outcome is Outcome.CONVERGED and 0 < found.iterations <= compiled.iterations
    assert abs(found.cost / compiled.cost - 1) < 1e-9
    turned = (found.state.chart.S - compiled.state.chart.S).flatten(1).norm(dim=1)
    sigma = compiled.line_covariance.diagonal(dim1=1, dim2=2).clamp_min(0).sqrt()[:, :3].norm(dim=1)
    # A line whose arcs are half wrong can have two minima.
    assert float((turned <= 1e-3 * sigma + 1e-12).double().mean()) > 0.99


def test_a_wrong_device_is_named() -> None:
    with pytest.raises(InputError, match="one of cpu, cuda, found 'tpu'"):
        usable_device("tpu")
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match="GPU that PyTorch can use was expected"):
            adjust_lines(row().arcs, row().lines, row().poses, device="cuda")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU that PyTorch can use on this machine")
@pytest.mark.parametrize("options", [{}, {"cost": "whitened"}, {"refine_poses": False}, {"loss": Loss("cauchy", 2.0)}])
def test_a_gpu_gives_what_the_processor_gives(options: dict[str, object]) -> None:
    scene = row(cameras=20, lines=200, seed=10)
    scene = wrong(scene) if "loss" in options else scene
    here = adjust_lines(scene.arcs, scene.lines, scene.poses, **options)  # type: ignore[arg-type]
    # Of half wrong arcs a line can have two minima, and which of them is reached hangs on rounding: both end where they begin.
    start = (here.state.chart.lines(), here.state.rig_from_world) if "loss" in options else (scene.lines, scene.poses)
    here = adjust_lines(scene.arcs, *start, **options)  # type: ignore[arg-type]
    there = adjust_lines(scene.arcs, *start, device="cuda", **options)  # type: ignore[arg-type]
    assert abs(there.cost / here.cost - 1) < 1e-10
    moved = (there.state.rig_from_world @ here.state.rig_from_world.inverse()).log()
    sigma = here.pose_covariance.diagonal(dim1=1, dim2=2).clamp_min(0).sqrt()
    assert bool((moved.abs() <= 1e-3 * sigma + 1e-12).all())
    given = planes(scene)
    lines = triangulate_on(usable_device("cuda"), "dual", given, at_once=300)
    assert_same(lines, triangulate("dual", given))
    assert moved_to(lines, torch.device("cuda")).status.device.type == "cuda"
