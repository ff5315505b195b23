"""How the cameras of a rig and the boards of a target stand to one another, from the poses that each camera found alone.

A view ties a camera, a frame and a board together: cam_from_board = cam_from_rig rig_from_target target_from_board. Starting from
one camera and one board, the frames they see are placed, then the camera or board on which most views of placed frames agree
is added (each of their views proposes a pose, the one that most corners agree with wins; M. Fischler, R. Bolles 1981), and so on
along the chain. Numberings of plain boards, and the side on which a mirror looks, are chosen with it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from camera_models.pose import Pose
from omnilines.calibration.rig.apart import camera_and_board
from omnilines.calibration.rig.consensus import PosedViews, mean_pose
from omnilines.calibration.thresholds import RigThresholds


@dataclass(frozen=True, eq=False)
class RigGraph:
    """What hangs together, and how. Poses of what does not are the identity and mean nothing."""

    cameras: Bool[Tensor, " c"]
    boards: Bool[Tensor, " b"]
    frames: Bool[Tensor, " f"]
    cam_from_rig: Pose
    target_from_board: Pose
    rig_from_target: Pose
    numbering: Int[Tensor, " v"]
    """Of every view that agrees with the others, which numbering it has; -1 for the rest."""
    turned: Bool[Tensor, " c"]
    """Cameras that look to the other side than was assumed."""
    determined: Bool[Tensor, " c"]
    """Cameras whose side follows from the others."""
    open_cameras: frozenset[int]
    """Cameras that see the same boards as others, but in too few frames to tell how their boards are numbered."""

    @property
    def size(self) -> tuple[int, int]:
        """Number of cameras, and of views that agree."""
        return int(self.cameras.sum()), int((self.numbering >= 0).sum())


@dataclass(frozen=True)
class _Proposal:
    """Where a camera or a board may stand."""

    pose: Pose
    support: float
    views: int
    """Views that agree."""
    of: int
    """Views that could."""
    rival: float
    """Support of the best pose that is another one."""
    turned: bool = False
    mirrored: bool = False
    determined: bool = True
    """Whether the other side of the camera is agreed with clearly less."""


class RigGrowth:
    """Grows a rig from one camera. `sides` are the cameras whose side (the sign of a0) is open, `tied` the known poses of boards
    on the target, `trusted` whether numberings are taken as they are where nothing contradicts them."""

    def __init__(
        self,
        views: PosedViews,
        sizes: tuple[int, int, int],
        sides: frozenset[int],
        tied: Pose | None,
        trusted: bool,
        *,
        thresholds: RigThresholds,
    ) -> None:
        self.views, self.sides, self.trusted, self.thresholds = views, sides, trusted, thresholds
        cameras, self.frame_count, boards = sizes
        self.camera_known = torch.zeros(cameras, dtype=torch.bool)
        self.board_known = torch.full((boards,), tied is not None)
        self.frame_known = torch.zeros(self.frame_count, dtype=torch.bool)
        self.cam_from_rig, self.rig_from_target = Pose.identity(cameras), Pose.identity(self.frame_count)
        self.target_from_board = Pose.identity(boards) if tied is None else tied
        self.turned = torch.zeros(cameras, dtype=torch.bool)
        self.determined = torch.zeros(cameras, dtype=torch.bool)
        self.open_cameras: set[int] = set()
        self.numbering = torch.full((len(views),), -1)

    def grown_from(self, camera: int) -> RigGraph:
        """Everything that hangs together with a camera."""
        self.camera_known[camera] = True
        self._allow(camera, False)
        if not bool(self.board_known.any()):
            own = self.views.board[self.views.camera == camera]
            self.board_known[torch.mode(own).values] = True
        self._place_frames()
        while True:
            proposals = [("camera", c, self._camera_proposal(c)) for c in torch.nonzero(~self.camera_known).flatten().tolist()]
            proposals += [("board", b, self._board_proposal(b)) for b in torch.nonzero(~self.board_known).flatten().tolist()]
            sound = [(kind, which, found) for kind, which, found in proposals if found is not None]
            if not sound:
                if not self._add_apart():
                    break
                self._place_frames()
                continue
            kind, which, best = max(sound, key=lambda item: item[2].support)
            if kind == "camera":
                self._add_camera(which, best)
            else:
                self.board_known[which] = True
                _put(self.target_from_board, which, best.pose)
            self._place_frames()
        return RigGraph(
            cameras=self.camera_known,
            boards=self.board_known,
            frames=self.frame_known,
            cam_from_rig=self.cam_from_rig,
            target_from_board=self.target_from_board,
            rig_from_target=self.rig_from_target,
            numbering=self.numbering,
            turned=self.turned,
            determined=self.determined,
            open_cameras=frozenset(self.open_cameras) - set(torch.nonzero(self.camera_known).flatten().tolist()),
        )

    def _add_camera(self, camera: int, best: _Proposal) -> None:
        self.camera_known[camera] = True
        _put(self.cam_from_rig, camera, best.pose)
        self.turned[camera], self.determined[camera] = best.turned, best.determined
        if best.turned:
            self.views = self.views.seen_in_mirrors([camera])
        self._allow(camera, best.mirrored)

    def _add_apart(self) -> bool:
        """Add the camera, with a board that it sees, that the motion places with most corners: whether there is one."""
        found = []
        unknown = self.frame_known[self.views.frame] & ~self.camera_known[self.views.camera] & ~self.board_known[self.views.board]
        for camera, board in torch.unique(torch.stack([self.views.camera, self.views.board], -1)[unknown], dim=0).tolist():
            rows = torch.nonzero(unknown & (self.views.camera == camera) & (self.views.board == board)).flatten()
            mine = self.views.chosen(rows).as_numbered()
            sides = [(False, mine), *([(True, mine.seen_in_mirrors([camera]))] if camera in self.sides else [])]
            for turned, seen in sides:
                if (place := self._apart(seen)) is not None:
                    found.append((place[1], camera, board, place[0], turned))
        if not found:
            return False
        best, camera, board, board_pose, turned = max(found, key=lambda item: item[0].support)
        others = [item[0] for item in found if item[1:3] == (camera, board)]
        self._add_camera(camera, self._with_side(replace(best, turned=turned), others))
        self.board_known[board] = True
        _put(self.target_from_board, board, board_pose)
        return True

    def _apart(self, seen: PosedViews) -> tuple[Pose, _Proposal] | None:
        """Where a board and the camera of these views are, by the motion of the rig, from the views that agree."""
        use = torch.ones(len(seen), dtype=torch.bool)
        for _ in range(2):
            rows = torch.nonzero(use).flatten()
            poses = self.rig_from_target[seen.frame]
            place = camera_and_board(poses[rows], seen.cam_from_board[rows], self.thresholds)
            if place is None:
                return None
            camera, board = place
            one = Pose(camera.rotation[None], camera.translation[None])
            value, _, agrees = self._votes(seen, one, Pose.identity(len(seen)), poses @ board)
            use = agrees[0]
        if int(use.sum()) < max(self.thresholds.apart_views, self.thresholds.as_numbered_share * len(seen)):
            return None
        support = float(value[0] @ seen.corners.to(value.dtype))
        return board, _Proposal(camera, support, int(use.sum()), len(seen), 0.0)

    def _allow(self, camera: int, mirrored: bool) -> None:
        """From now on only numberings of one handedness for a camera."""
        own = self.views.camera == camera
        handed = self.views.board_from_numbered.rotation[..., 2, 2] < 0
        allowed = torch.where(own[:, None], self.views.allowed & (handed == mirrored), self.views.allowed)
        self.views = _with_allowed(self.views, allowed)

    def _camera_proposal(self, camera: int) -> _Proposal | None:
        """Where a camera may stand, with every side and handedness that it may have; None where its views do not tell."""
        use = (self.views.camera == camera) & self.frame_known[self.views.frame] & self.board_known[self.views.board]
        rows = torch.nonzero(use).flatten()
        if not len(rows):
            return None
        mine = self.views.chosen(rows)
        in_rig = self.rig_from_target[mine.frame] @ self.target_from_board[mine.board]
        sides = [(False, mine), *([(True, mine.seen_in_mirrors([camera]))] if camera in self.sides else [])]
        if self.trusted:
            plain = [self._proposal(side.as_numbered(), Pose.identity(len(rows)), in_rig, turned) for turned, side in sides]
            best = max(plain, key=lambda proposal: proposal.support)
            if best.views >= max(self.thresholds.as_numbered_views, self.thresholds.as_numbered_share * best.of):
                return self._with_side(best, plain)
        found = []
        for turned, seen in sides:
            for mirrored in (False, True):
                allowed = seen.allowed & ((seen.board_from_numbered.rotation[..., 2, 2] < 0) == mirrored)
                if bool(allowed.any()):
                    handed = _with_allowed(seen, allowed)
                    found.append(self._proposal(handed, Pose.identity(len(rows)), in_rig, turned, mirrored))
        best = max(found, key=lambda proposal: proposal.support)
        others = [proposal.support for proposal in found if proposal is not best]
        return self._sound(self._with_side(best, found), max([best.rival, *others]), camera)

    def _board_proposal(self, board: int) -> _Proposal | None:
        use = (self.views.board == board) & self.frame_known[self.views.frame] & self.camera_known[self.views.camera]
        rows = torch.nonzero(use).flatten()
        if not len(rows):
            return None
        mine = self.views.chosen(rows)
        on_camera = self.cam_from_rig[mine.camera] @ self.rig_from_target[mine.frame]
        best = self._proposal(mine, on_camera, Pose.identity(len(rows)))
        # A single view says where the board is, in its own numbering.
        return best if best.views >= max(1, self.thresholds.agreeing_share * best.of) else None

    def _sound(self, best: _Proposal, rival: float, camera: int) -> _Proposal | None:
        if best.views < max(1, self.thresholds.agreeing_share * best.of):
            return None
        if rival >= self.thresholds.tied_share * best.support and not self.trusted:
            self.open_cameras.add(camera)
            return None
        return best

    def _place_frames(self) -> None:
        """Of the views of a frame the one that the others agree with most says where the target is.

        Where a frame has several boards, which numbering that view has matters too: others are tried where not all agree.
        """
        use = self.camera_known[self.views.camera] & self.board_known[self.views.board]
        self.frame_known = torch.zeros(self.frame_count, dtype=torch.bool)
        self.numbering = torch.full((len(self.views),), -1)
        self._place(torch.nonzero(use).flatten(), False)
        apart = torch.zeros(self.frame_count, dtype=torch.bool)
        apart[self.views.frame[use & (self.numbering < 0)]] = True
        rows = torch.nonzero(use & apart[self.views.frame]).flatten()
        if len(rows) and len(torch.unique(self.views.board[rows])) > 1:
            self._place(rows, True)

    def _place(self, rows: Int[Tensor, " r"], every_numbering: bool) -> None:
        """Place the frames of these views, all of each frame; each view proposes as it is numbered, or with every numbering."""
        seen = self.views.chosen(rows)
        rig_from_cam = self.cam_from_rig.inverse()
        board_from_target = self.target_from_board.inverse()
        # The first numbering that a view may have: as it is, but for cameras whose boards are numbered as in a mirror.
        options = seen.allowed if every_numbering else seen.allowed & (torch.cumsum(seen.allowed, 1) == 1)
        proposer, numbering = torch.nonzero(options, as_tuple=True)
        first, second = _pairs(seen.frame[proposer], seen.frame)
        choice = seen.board_from_numbered[proposer, numbering].inverse()
        own = (
            rig_from_cam[seen.camera[proposer]] @ seen.cam_from_board[proposer] @ choice @ board_from_target[seen.board[proposer]]
        )
        voter = seen.chosen(second)
        predicted = self.cam_from_rig[voter.camera] @ own[first] @ self.target_from_board[voter.board]
        one = Pose(predicted.rotation[None], predicted.translation[None])
        value, chosen, agrees = (part[0] for part in voter.agreement(one, self.thresholds))
        weight = value * voter.corners
        total = torch.zeros(len(proposer), dtype=torch.float64).index_add_(0, first, weight)
        total = total + 1e-6 * seen.corners[proposer] - 1e-3 * numbering.clamp_max(1)
        # The best proposal of every frame.
        order = torch.argsort(total, descending=True, stable=True)
        order = order[torch.argsort(seen.frame[proposer[order]], stable=True)]
        frames, counts = torch.unique_consecutive(seen.frame[proposer[order]], return_counts=True)
        winner = order[torch.cumsum(counts, 0) - counts]
        self.frame_known[frames] = True
        self.rig_from_target.rotation[frames] = own.rotation[winner]
        self.rig_from_target.translation[frames] = own.translation[winner]
        won = torch.zeros(len(proposer), dtype=torch.bool)
        won[winner] = True
        of_winner = won[first] & agrees
        self.numbering[rows] = -1
        self.numbering[rows[second[of_winner]]] = chosen[of_winner]

    def _proposal(self, views: PosedViews, left: Pose, right: Pose, turned: bool = False, mirrored: bool = False) -> _Proposal:
        """The pose U that most corners agree with in cam_from_board = left U right; each of the largest views proposes U."""
        top = torch.argsort(views.corners, descending=True, stable=True)[: self.thresholds.proposers]
        place, numbering = torch.nonzero(views.allowed[top], as_tuple=True)
        view = top[place]
        own = views.cam_from_board[view] @ views.board_from_numbered[view, numbering].inverse()
        proposed = left[view].inverse() @ own @ right[view].inverse()
        value, chosen, agrees = self._votes(views, proposed, left, right)
        support = value @ views.corners.to(value.dtype)
        best = int(support.argmax())
        pose, support_of_best = proposed[best], float(support[best])
        voters = torch.nonzero(agrees[best]).flatten()
        each = views.cam_from_board[voters] @ views.board_from_numbered[voters, chosen[best, voters]].inverse()
        each = left[voters].inverse() @ each @ right[voters].inverse()
        mean = mean_pose(each, views.corners[voters] * value[best, voters])
        mean_value, _, mean_agrees = self._votes(views, Pose(mean.rotation[None], mean.translation[None]), left, right)
        mean_support = float(mean_value[0] @ views.corners.to(value.dtype))
        # A rival stands where the voters of the best, numbered as they are for it, do not see it.
        same = (chosen[:, voters] == chosen[best, voters]) & agrees[:, voters]
        other = ~same.any(-1)
        rival = float(support[other].max()) if bool(other.any()) else 0.0
        if mean_support > support_of_best:
            pose, support_of_best, agrees_with = mean, mean_support, mean_agrees[0]
        else:
            agrees_with = agrees[best]
        return _Proposal(
            pose=pose,
            support=support_of_best,
            views=int(agrees_with.sum()),
            of=len(views),
            rival=rival,
            turned=turned,
            mirrored=mirrored,
        )

    def _with_side(self, best: _Proposal, found: Sequence[_Proposal]) -> _Proposal:
        """Whether the other side of the camera is agreed with clearly less; the one that was assumed where it is not."""
        other = max((item for item in found if item.turned != best.turned), key=lambda item: item.support, default=None)
        determined = other is None or other.support < self.thresholds.tied_share * best.support
        return replace(best if determined or other is None or not best.turned else other, determined=determined)

    def _votes(self, views: PosedViews, proposed: Pose, left: Pose, right: Pose) -> tuple[Tensor, Tensor, Tensor]:
        predicted = left[None] @ proposed[:, None] @ right[None]
        return views.agreement(predicted, self.thresholds)


def _pairs(first: Int[Tensor, " a"], second: Int[Tensor, " b"]) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """All pairs of places with the same number."""
    order = torch.argsort(second, stable=True)
    counts = torch.bincount(second, minlength=int(first.max()) + 1)
    start = torch.cumsum(counts, 0) - counts
    repeats = counts[first]
    left = torch.repeat_interleave(torch.arange(len(first)), repeats)
    within = torch.arange(len(left)) - torch.repeat_interleave(torch.cumsum(repeats, 0) - repeats, repeats)
    return left, order[start[first[left]] + within]


def _put(poses: Pose, place: int, pose: Pose) -> None:
    poses.rotation[place], poses.translation[place] = pose.rotation, pose.translation


def _with_allowed(views: PosedViews, allowed: Bool[Tensor, "v k"]) -> PosedViews:
    return replace(views, allowed=allowed)


def largest_rig(
    views: PosedViews,
    sizes: tuple[int, int, int],
    sides: frozenset[int],
    tied: Pose | None,
    trusted: bool,
    *,
    order: Sequence[int],
    thresholds: RigThresholds,
) -> RigGraph:
    """The rig with the most cameras, then views, grown from each camera of `order` that no rig before it holds."""
    best: RigGraph | None = None
    seen: set[int] = set()
    for camera in order:
        if camera in seen or not bool((views.camera == camera).any()):
            continue
        graph = RigGrowth(views, sizes, sides, tied, trusted, thresholds=thresholds).grown_from(camera)
        seen |= set(torch.nonzero(graph.cameras).flatten().tolist())
        if best is None or graph.size > best.size:
            best = graph
    assert best is not None
    return best
