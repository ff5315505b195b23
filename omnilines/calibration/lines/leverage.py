"""How much of its own error each chain takes up: what a fit leaves of it is less than it was.

With the normals eliminated chain c has the derivatives J_c by the kept blocks, and all chains the information S. To first
order its residuals are (1 - H) of its errors, H = J_c S^-1 J_c', so that its score by the camera, of the information
I_c = F' J_c' J_c F (directions following by F), has the covariance

    I_c - F' J_c' H J_c F

where a chain states its errors rightly. The ratio of both, weighted by the covariance W of the camera, corrects the square of its
score (R. M. Bell and D. F. McCaffrey, 2002, with a scalar in the place of a matrix).
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from omnilines.least_squares import Linearisation
from omnilines.least_squares.structure import Structure

MOST = 0.9
"""Share of its own error that a chain may be taken to hide."""
WIDEST = 3
"""Columns of a direction, or of a frame."""


def correction(
    structure: Structure,
    at: Linearisation,
    eliminated: Float[Tensor, "c 2 2"],
    *,
    information: Float[Tensor, "k k"],
    following: Float[Tensor, "k q"],
    of_camera: Float[Tensor, "q q"],
    directions: int,
) -> tuple[Float[Tensor, " c"], Float[Tensor, "c q q"]]:
    """1 / (1 - share) of each chain, and its I_c. `information` is S, `of_camera` W. Of each chain the columns of the camera and
    of its direction count, which are the kept groups after it, `directions` of them; right angles, which all chains tell, take
    up next to nothing of one.
    """
    q = following.shape[1]
    columns, local = _local(structure, at, q, directions)
    e, chain = at.by_eliminated[:, 0], structure.index

    def by_chain(values: Float[Tensor, "n *shape"]) -> Float[Tensor, "c *shape"]:
        return values.new_zeros(structure.count, *values.shape[1:]).index_add_(0, chain, values)

    gain = torch.linalg.lstsq(eliminated, by_chain(e[:, :, None] * local[:, None])).solution
    left = local - (e[:, None] @ gain[chain])[:, 0]
    values, vectors = torch.linalg.eigh(of_camera)
    root = vectors * values.clamp_min(0.0).sqrt()
    padded = torch.cat([following, root.new_zeros(1, q)])
    by_camera = (left[:, None] @ padded[columns][chain])[:, 0]
    score = by_camera @ root
    whole = by_chain(score.square().sum(-1))
    mixed = by_chain(left[:, :, None] * score[:, None])
    inverse = torch.zeros(len(following) + 1, len(following) + 1, dtype=score.dtype)
    inverse[:-1, :-1] = torch.linalg.pinv(information, hermitian=True)
    taken = torch.einsum("cij,cik,ckj->c", mixed, inverse[columns[:, :, None], columns[:, None]], mixed)
    share = torch.where(whole > 0, taken / whole.clamp_min(1e-300), 0.0)
    return 1.0 / (1.0 - share.clamp(0.0, MOST)), by_chain(by_camera[:, :, None] * by_camera[:, None])


def _local(structure: Structure, at: Linearisation, q: int, directions: int) -> tuple[Int[Tensor, "c w"], Float[Tensor, "n w"]]:
    """The kept columns of each chain, those of the camera first, the number of all for none; and the derivatives by them."""
    columns = torch.full((structure.count, q + WIDEST), structure.kept_size)
    local = at.residual.new_zeros(len(structure.index), q + WIDEST)
    columns[:, :q] = torch.arange(q)
    local[:, :q] = at.by_kept[0][:, 0]
    for group, offset, by in list(zip(structure.groups, structure.offsets, at.by_kept, strict=False))[1 : 1 + directions]:
        rows = torch.nonzero(group.index >= 0).flatten()
        place = slice(q, q + group.dim)
        columns[structure.index[rows], place] = offset + group.index[rows, None] * group.dim + torch.arange(group.dim)
        local[rows, place] = by[rows, 0]
    return columns, local
