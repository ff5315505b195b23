"""Lines, poses, cameras and a rig as a least-squares problem: lines are the eliminated blocks, everything else is kept."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import InputError
from camera_models.pose import adjoint
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.gauge import Similarities, open_similarities
from omnilines.adjustment.intrinsics import distance_by_parameters, weights_to_hold
from omnilines.adjustment.prior import PosePrior
from omnilines.adjustment.state import LinesAndPoses, moved_poses
from omnilines.costs import IN_PIXELS, cost_function, cost_named
from omnilines.costs._cost import CostFunction, line_residual, mixed_distances
from omnilines.least_squares import KeptGroup, KeptPrior, Linearisation, Structure


@dataclass(frozen=True)
class Freedom:
    """What may move. Lines always may but for those held."""

    held_frames: Bool[Tensor, " frames"]
    held_lines: Bool[Tensor, " tracks"] | None = None
    cameras: bool = False
    """Intrinsics of every camera, along its `calibration_basis`."""
    rig: bool = False
    """Extrinsics of every camera of the rig but the first."""


class LineProblem:
    """Kept are, in this order: poses of free frames (6 each), extrinsics of rig cameras (6 each), intrinsics of each camera.

    With all poses free, the similarity that bearings leave open is fixed by constraints on the step: the poses neither shift,
    turn nor scale as a whole (in which frame a scene and its covariances are in the end is the affair of `datum.py`). Held poses
    and lines leave less of it open (`gauge.py`). A held rig with a baseline has a scale; a prior leaves nothing open.
    """

    def __init__(
        self,
        arcs: MatchedArcs,
        cost: str,
        freedom: Freedom,
        state: LinesAndPoses,
        prior: PosePrior | None = None,
        *,
        mix: Float[Tensor, "n 2 2"] | None = None,
    ) -> None:
        """`prior` is in the unit of the cost (`PosePrior.weighing`). With `mix` residuals are mix @ (V . Mh) instead of the
        cost's."""
        self.arcs, self.cost_name, self.freedom, self.prior, self.mix = arcs, cost, freedom, prior, mix
        rig = state.rig
        frame = arcs.image if rig is None else rig.frame[arcs.image]
        self.free = torch.nonzero(~freedom.held_frames).flatten()
        self.observing = torch.bincount(frame, minlength=len(freedom.held_frames)) > 0
        self._lines_held = torch.bincount(arcs.track, minlength=arcs.tracks) > 0
        self._lines_held &= freedom.held_lines if freedom.held_lines is not None else torch.zeros_like(self._lines_held)
        groups = [KeptGroup(_place(freedom.held_frames)[frame], len(self.free), 6)] if len(self.free) else []
        self.rig_cameras = self.free[:0]
        if freedom.rig and rig is not None:
            held = torch.ones(len(rig.cam_from_rig), dtype=torch.bool, device=rig.camera.device)
            held[torch.unique(rig.camera[arcs.image])] = False
            held[0] = True
            self.rig_cameras = torch.nonzero(~held).flatten()
            if len(self.rig_cameras):
                groups.append(KeptGroup(_place(held)[rig.camera[arcs.image]], len(self.rig_cameras), 6))
        self.bases = tuple(model.calibration_basis() for model in state.models) if freedom.cameras else ()
        if freedom.cameras:
            if arcs.observed is None:
                raise InputError(
                    "Arcs that know their pixels were expected to refine cameras, found arcs without; make them with "
                    "arcs_from_segments."
                )
            for index, basis in enumerate(self.bases):
                mine = arcs.observed.camera == index
                groups.append(KeptGroup(torch.where(mine, 0, -1), 1, basis.shape[1]))
        self.held_weights = (
            weights_to_hold(cost, arcs.seen_by(state.models), state.normals(arcs), mix) if freedom.cameras else None
        )
        """Weights of distances in pixels that are held while cameras move, None where the cost has none (`intrinsics.py`)."""
        self.structure = Structure(arcs.track, arcs.tracks, 4, tuple(groups))

    @cached_property
    def cost(self) -> CostFunction:
        """Of the arcs as they are."""
        return self._cost_of(self.arcs)

    def _cost_of(self, arcs: MatchedArcs) -> CostFunction:
        return cost_function(self.cost_name, arcs) if self.mix is None else mixed_distances(self.mix)

    def linearise(self, state: LinesAndPoses) -> Linearisation:
        """Residuals of the cost and their analytic Jacobians; those by the cameras by the chain rule through the bearings."""
        arcs, cost = self.arcs, self.cost
        if self.bases:
            arcs = arcs.seen_by(state.models)
            cost = self._cost_of(arcs) if self.held_weights is None else cost_function(IN_PIXELS, arcs)
        poses, chart = state.cam_from_world[arcs.image], state.chart[arcs.track]
        r, by_pose, by_line = line_residual(cost, arcs.bearings, chart, poses)
        by_cameras = self._by_cameras(arcs, state, chart.projection_normal(poses)[0]) if self.bases else []
        if self.held_weights is not None:
            r, by_pose, by_line = (
                (self.held_weights @ r[..., None])[..., 0],
                self.held_weights @ by_pose,
                self.held_weights @ by_line,
            )
            by_cameras = [self.held_weights @ by_camera for by_camera in by_cameras]
        if self.freedom.held_lines is not None:
            by_line = torch.where(self.freedom.held_lines[arcs.track][:, None, None], 0.0, by_line)
        kept = []
        if len(self.free):
            if state.rig is None:
                kept.append(by_pose)
            else:
                kept.append(by_pose @ adjoint(state.rig.cam_from_rig[state.rig.camera[arcs.image]]))
        if len(self.rig_cameras):
            kept.append(by_pose)
        return Linearisation(r, by_line, tuple(kept + by_cameras), self._prior(state))

    def _by_cameras(self, arcs: MatchedArcs, state: LinesAndPoses, normal: Float[Tensor, "n 3"]) -> list[Tensor]:
        """d distance / d intrinsics of each camera, of both ends (`intrinsics.py`)."""
        assert arcs.observed is not None
        found = []
        for index, (model, basis) in enumerate(zip(state.models, self.bases, strict=True)):
            mine = torch.nonzero(arcs.observed.camera == index).flatten()
            full = normal.new_zeros(len(arcs), 2, basis.shape[1])
            if len(mine):
                whitened = cost_named(self.cost_name).is_whitened and self.held_weights is None
                noise = arcs.covariance_px2[mine] if whitened else None
                full[mine] = distance_by_parameters(model, arcs.bearings[mine], arcs.by_pixel[mine], normal[mine], noise) @ basis
            found.append(full)
        return found

    def _prior(self, state: LinesAndPoses) -> KeptPrior | None:
        if self.prior is None or not len(self.free):
            return None
        residual, by_pose = self.prior.residual(state.rig_from_world)
        rows = residual.new_zeros(len(self.free), 6, self.structure.kept_size)
        place = torch.arange(6 * len(self.free), device=residual.device).view(-1, 1, 6).expand(-1, 6, 6)
        rows.scatter_(2, place, by_pose[self.free])
        return KeptPrior(residual[self.free].flatten(), rows.flatten(0, 1))

    def retract(self, state: LinesAndPoses, kept: Tensor, eliminated: Tensor) -> LinesAndPoses:
        """exp(delta) T for poses, the orthonormal chart for lines, which is re-centred where it becomes badly scaled."""
        if self.freedom.held_lines is not None:
            eliminated = torch.where(self.freedom.held_lines[:, None], 0.0, eliminated)
        moved = replace(state, chart=state.chart.retract(eliminated).recentred())
        sizes = [6 * len(self.free), 6 * len(self.rig_cameras), *(basis.shape[1] for basis in self.bases)]
        frames, rig, *cameras = kept.split(sizes)
        if len(self.free):
            moved = replace(moved, rig_from_world=moved_poses(state.rig_from_world, self.free, frames.view(-1, 6)))
        if len(self.rig_cameras) and state.rig is not None:
            turned = moved_poses(state.rig.cam_from_rig, self.rig_cameras, rig.view(-1, 6))
            moved = replace(moved, rig=replace(state.rig, cam_from_rig=turned))
        if self.bases:
            steps = zip(state.models, self.bases, cameras, strict=True)
            models = tuple(model.with_parameters(model.parameters + basis @ step) for model, basis, step in steps)
            moved = replace(moved, models=models)
        return moved

    def _scale_is_free(self, state: LinesAndPoses) -> bool:
        """Whether bearings leave the scale open: no held rig with a baseline."""
        if state.rig is None or self.freedom.rig:
            return True
        return not state.rig.has_baseline(self.arcs.image)

    def only_poses_scale(self, state: LinesAndPoses) -> bool:
        """Whether nothing but held poses can give the scene a scale: no prior, no held line and no rig with a baseline."""
        return self.prior is None and not bool(self._lines_held.any()) and self._scale_is_free(state)

    def similarities(self, state: LinesAndPoses) -> Similarities:
        """A common turn, shift and scale of the scene, as far as the residuals and what is held say nothing about them."""
        centre = state.rig_from_world.centre
        if not len(self.free) or self.prior is not None:
            return Similarities(centre.new_zeros(3), 1.0, centre.new_zeros(7, 0))
        # A held pose or line anchors the scene only where it takes part.
        fixed = torch.nonzero(self.freedom.held_frames & self.observing).flatten()
        lines = state.chart[torch.nonzero(self._lines_held).flatten()].lines()
        about = torch.cat([centre[fixed], lines.closest_point(centre[self.free].mean(0).expand_as(lines.moment))])
        origin = about[0] if len(about) else centre[self.free].mean(0)
        arm = centre[self.free] - origin
        unit = float(arm.norm(dim=-1).max()) or 1.0
        return Similarities(origin, unit, open_similarities(origin, unit, centre[fixed], lines, not self._scale_is_free(state)))

    def gauge(self, state: LinesAndPoses) -> Float[Tensor, "k g"]:
        """Columns C of the constraints C' dk = 0: no step is along a similarity that is open, as the steps' sizes measure it."""
        return self.motions(state) / self.step_sizes(state)[:, None].square()

    def step_sizes(self, state: LinesAndPoses) -> Float[Tensor, " k"]:
        """The step of each kept parameter that counts as one: a radian and, of what is a length, the size of the scene, so that
        no solution depends on the unit of length."""
        lengths = 6 * (len(self.free) + len(self.rig_cameras))
        turn_and_shift = state.rig_from_world.translation.new_tensor([1.0] * 3 + [self.similarities(state).unit_m] * 3)
        sizes = turn_and_shift.new_ones(self.structure.kept_size)
        sizes[:lengths] = turn_and_shift.repeat(lengths // 6)
        return sizes

    def motions(self, state: LinesAndPoses) -> Float[Tensor, "k g"]:
        """What the similarities that are open do to the kept step."""
        found = self.similarities(state)
        columns = self._of_frames(found.by_step(state.rig_from_world[self.free]))
        if len(self.rig_cameras) and state.rig is not None:
            baseline = state.rig.cam_from_rig.translation[self.rig_cameras]
            low = 6 * len(self.free)
            grown = torch.cat([torch.zeros_like(baseline), baseline], -1).flatten()
            columns[low : low + len(grown)] = grown[:, None] * found.columns[6:]
        return columns

    def _of_frames(self, rows: Float[Tensor, "f6 g"]) -> Float[Tensor, "k g"]:
        """Rows of the free frames among all kept ones."""
        rest = self.structure.kept_size - len(rows)
        return torch.cat([rows, rows.new_zeros(rest, rows.shape[1])])


def _place(held: Bool[Tensor, " n"]) -> Tensor:
    """Number of each block that is not held among those, -1 for the held ones."""
    place = torch.full((len(held),), -1, device=held.device)
    free = torch.nonzero(~held).flatten()
    place[free] = torch.arange(len(free), device=held.device)
    return place
