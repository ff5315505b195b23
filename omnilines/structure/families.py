"""Families of parallel lines: their directions on the sphere (vanishing directions), and which of them are at right angles.

A line of direction d (either sign) with the tangent covariance C belongs to a family u where e' S^-1 e <= g, the gate, with e
the part of d across u and S = C + t^2 I: t is how far lines of a building stray from their common direction beyond what was
measured.

A family is one that noise does not make. Were the directions of the other n - 1 lines random, each would fall within the gate of
a given line with the probability p = g sqrt(det S) / 2, the area of the gate over that of the half sphere, S of both.
With k of them in the gate, n P(Binomial(n - 1, p) >= k) is the number of such lines expected by chance; it has to be small (the
a-contrario method: Desolneux, Moisan and Morel, Meaningful alignments, IJCV 2000; for vanishing points: Almansa, Desolneux and
Vamech, PAMI 2003). The binomial of the mean p bounds that of differing p (Hoeffding 1956).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.special import bdtrc, chdtrc
from torch import Tensor

from camera_models.errors import InputError
from camera_models.repeatable import total
from omnilines.records import Lines
from omnilines.structure.directions import across, angle_with_sigma, common_direction, line_directions, squared_distance
from omnilines.structure.options import FamilyOptions

_ROUNDS = 20
_SHARPEST = 200
_PAIRS = 500_000
"""Compared at a time, which bounds the memory."""


@dataclass(frozen=True)
class Families:
    """k families of parallel lines, the largest first, and m pairs of them at right angles."""

    family: Int[np.ndarray, " n"]
    """Of each line, -1 where it has none."""
    direction: Float[np.ndarray, "k 3"]
    """Unit vectors in the world frame; the largest component is positive."""
    covariance: Float[np.ndarray, "k 3 3"]
    """Of each direction, rad^2, zero along it; the tolerance is one of its sources. Errors that lines share are not."""
    sigma_rad: Float[np.ndarray, " k"]
    """Largest standard deviation of the direction."""
    members: Int[np.ndarray, " k"]
    spread_rad: Float[np.ndarray, " k"]
    """RMS angle of the members to the direction."""
    chi_square: Float[np.ndarray, " k"]
    """Of the members about the direction that suits their measured noise best, without the tolerance; 2 (members - 1) degrees
    of freedom."""
    probability: Float[np.ndarray, " k"]
    """With which lines that are parallel would have a larger chi-square: near 0 where the members differ by more than noise."""
    right_angles: Int[np.ndarray, "m 2"]
    """Pairs of families."""
    angle_rad: Float[np.ndarray, " m"]
    """Between the two directions of each pair, at most pi / 2."""
    angle_sigma_rad: Float[np.ndarray, " m"]
    tolerance_rad: float
    """Standard deviation, in each direction, of the model that lines of one family are parallel, and two at right angles."""
    considered: int
    """Lines whose direction is known well enough to have a family."""

    def __len__(self) -> int:
        return len(self.members)

    def turned(self, new_from_old: Float[Tensor, "3 3"]) -> "Families":
        """The same families in a world that is turned."""
        turn = new_from_old.numpy()
        direction = self.direction @ turn.T
        largest = np.take_along_axis(direction, np.abs(direction).argmax(-1)[:, None], -1)
        side = np.where(largest < 0, -1.0, 1.0)
        return replace(self, direction=side * direction, covariance=turn @ self.covariance @ turn.T)


def line_families(lines: Lines, options: FamilyOptions = FamilyOptions()) -> Families:
    """The families of parallel lines that are there beyond chance; lines that belong to none are left alone.

    The ends of each line must stand in the order in which its chart has its direction, as the adjustment writes them.

    Raises InputError where the lines have no covariance, or an option is out of its range.
    """
    _check(options)
    direction, covariance = line_directions(lines)
    largest = torch.linalg.eigvalsh(torch.nan_to_num(covariance))[:, -1].clamp_min(0).sqrt()
    usable = torch.isfinite(covariance).flatten(1).all(-1) & (largest <= options.max_sigma_rad)
    rows = torch.nonzero(usable).flatten()
    d, c = direction[rows], covariance[rows]
    found = _search(d, c, options)
    own = _assigned(d, c, found, options)
    found = [u for k, u in enumerate(found) if int((own == k).sum()) >= options.min_members]
    own = _assigned(d, c, found, options)
    fits = [common_direction(d[own == k], c[own == k], u, options.tolerance_rad) for k, u in enumerate(found)]
    order = sorted(range(len(fits)), key=lambda k: -int((own == k).sum()))
    family = np.full(len(lines), -1)
    for place, k in enumerate(order):
        family[rows[own == k].numpy()] = place
    parts = [d[own == k] for k in order]
    return _described(family, parts, [c[own == k] for k in order], [fits[k] for k in order], len(rows), options)


def _check(options: FamilyOptions) -> None:
    tolerance, separation = (options.tolerance_rad, 0, 10), (options.separation_rad, 0, 90)
    asked = ((*tolerance, "tolerance of parallel lines"), (*separation, "separation of families"))
    for value, low, high, what in asked:
        if not math.radians(low) <= value <= math.radians(high):
            found = math.degrees(value)
            raise InputError(f"A {what} from {low} to {high} degrees was expected, found {found:g}; give one in this range.")
    if options.min_members < 2:
        raise InputError(
            f"A family was expected to have at least 2 members, found {options.min_members} as the least; give a larger number."
        )
    if not options.false_families > 0:
        raise InputError(f"A number of false families above 0 was expected, found {options.false_families:g}; give a small one.")


def _search(d: Float[Tensor, "n 3"], c: Float[Tensor, "n 3 3"], options: FamilyOptions) -> list[Float[Tensor, "3"]]:
    """Directions of families, one after the other, each from the line with the fewest companions to be expected by chance.

    The sharpest lines are asked first, and all of them only where these lead to no family: large ones are gone by then.
    """
    least, sine = options.min_members, math.sin(options.separation_rad)
    found: list[Tensor] = []
    free = torch.ones(len(d), dtype=torch.bool)
    few = True
    while int(free.sum()) >= least:
        rows = torch.nonzero(free).flatten()
        seeds = c[rows].diagonal(dim1=-2, dim2=-1).sum(-1).argsort(stable=True)[: _SHARPEST if few else None]
        chance = _chance(d[rows], c[rows], seeds, options)
        for u in found:
            near = torch.linalg.cross(d[rows[seeds]], u.expand(len(seeds), 3)).norm(dim=-1) < sine
            chance = torch.where(near, math.inf, chance)
        best = int(chance.argmin())
        if not float(chance[best]) <= math.log(options.false_families):
            if len(seeds) == len(rows):
                break
            few = False
            continue
        best = int(seeds[best])
        u, member = _grown(d[rows], c[rows], best, options)
        apart = all(float(torch.linalg.cross(u, other).norm()) >= sine for other in found)
        if int(member.sum()) >= least and apart:
            found.append(u)
        member[best] = True
        free[rows[member]] = False
    return found


def _chance(
    d: Float[Tensor, "n 3"], c: Float[Tensor, "n 3 3"], seeds: Int[Tensor, " s"], options: FamilyOptions
) -> Float[Tensor, " s"]:
    """log of the number of lines with as many companions as each seed has that random directions would give; inf for too few.

    The covariances of two random lines have a random angle between them, over which E sqrt(det(A + B)) is at most
    sqrt(det A + det B + tr A tr B / 2).
    """
    n, gate, tolerance_rad = len(d), options.gate, options.tolerance_rad
    s = across(d, c, d, tolerance_rad)[1]
    trace, determinant = s.diagonal(dim1=-2, dim2=-1).sum(-1), torch.linalg.det(s).clamp_min(0)
    reach = (gate * torch.linalg.eigvalsh(s)[:, -1]).clamp_min(0)
    count, p = torch.zeros(len(seeds), dtype=d.dtype), torch.zeros(len(seeds), dtype=d.dtype)
    step = max(1, _PAIRS // n)
    for low in range(0, len(seeds), step):
        block = seeds[low : low + step]
        area = determinant[block, None] + determinant + 0.5 * trace[block, None] * trace
        p[low : low + step] = (0.5 * gate * area.sqrt()).clamp_max(1.0).mean(1)
        # Only pairs within the larger axes of both gates are worth a closer look.
        sine2 = (1 - (d[block] @ d.T) ** 2).clamp_min(0)
        place, other = torch.nonzero(sine2 <= 1.01 * (reach[block, None] + reach) + 1e-14).unbind(1)
        seed = block[place]
        place, seed, other = (index[seed != other] for index in (place, seed, other))
        e, both, _ = across(d[other], c[other] + c[seed], d[seed], math.sqrt(2) * tolerance_rad)
        inside = place[squared_distance(e, both) <= gate] + low
        count += torch.bincount(inside, minlength=len(seeds))
    with np.errstate(divide="ignore"):
        tail = torch.from_numpy(np.log(bdtrc(count.numpy() - 1.0, n - 1, p.numpy())))
    return torch.where(count + 1 >= options.min_members, math.log(n) + tail, math.inf)


def _grown(
    d: Float[Tensor, "n 3"], c: Float[Tensor, "n 3 3"], seed: int, options: FamilyOptions
) -> tuple[Float[Tensor, "3"], Bool[Tensor, " n"]]:
    """The direction that the lines near one of them have in common, and these lines: fitted and chosen in turn."""
    u, tolerance_rad, gate = d[seed], options.tolerance_rad, options.gate
    e, s, _ = across(d, c + c[seed], u, math.sqrt(2) * tolerance_rad)
    member = squared_distance(e, s) <= gate
    for _ in range(_ROUNDS):
        u, _ = common_direction(d[member], c[member], u, tolerance_rad)
        e, s, _ = across(d, c, u, tolerance_rad)
        again = squared_distance(e, s) <= gate
        if bool((again == member).all()) or not bool(again.any()):
            break
        member = again
    return u, member


def _assigned(
    d: Float[Tensor, "n 3"], c: Float[Tensor, "n 3 3"], found: list[Tensor], options: FamilyOptions
) -> Int[Tensor, " n"]:
    """The family of each line: the most probable one in whose gate it lies, -1 for none."""
    if not found:
        return torch.full((len(d),), -1)
    parts = [across(d, c, u, options.tolerance_rad)[:2] for u in found]
    distance = torch.stack([squared_distance(e, s) for e, s in parts])
    likely = distance + torch.stack([torch.logdet(s) for _, s in parts])
    best = torch.where(distance <= options.gate, likely, math.inf).argmin(0)
    return torch.where((distance <= options.gate).any(0), best, -1)


def _described(
    family: Int[np.ndarray, " n"],
    d: list[Float[Tensor, "_ 3"]],
    c: list[Float[Tensor, "_ 3 3"]],
    fits: list[tuple[Float[Tensor, "3"], Float[Tensor, "3 3"]]],
    considered: int,
    options: FamilyOptions,
) -> Families:
    """What there is to say of the families with the directions `d` and covariances `c` of their members."""
    u = torch.stack([u for u, _ in fits]) if fits else torch.empty(0, 3, dtype=torch.float64)
    u = u * torch.where(u.gather(-1, u.abs().argmax(-1, keepdim=True)) < 0, -1.0, 1.0)
    covariance = torch.stack([p for _, p in fits]) if fits else torch.empty(0, 3, 3, dtype=torch.float64)
    members = np.array([len(part) for part in d], dtype=np.int64)
    chi_square, spread = np.empty(len(d)), np.empty(len(d))
    for k, (own, noise) in enumerate(zip(d, c, strict=True)):
        among_noise, _ = common_direction(own, noise, u[k], 0.0)
        chi_square[k] = total(squared_distance(*across(own, noise, among_noise, 0.0)[:2]))
        spread[k] = math.sqrt(total(across(own, noise, u[k], 0.0)[0].square()) / len(own))
    pairs = torch.triu_indices(len(u), len(u), 1).T
    angle, sigma = angle_with_sigma(u[pairs[:, 0]], covariance[pairs[:, 0]], u[pairs[:, 1]], covariance[pairs[:, 1]])
    right = (math.pi / 2 - angle) ** 2 <= options.right_angle_sigmas**2 * (sigma**2 + options.tolerance_rad**2)
    return Families(
        family,
        u.numpy(),
        covariance.numpy(),
        torch.linalg.eigvalsh(covariance)[:, -1].clamp_min(0).sqrt().numpy(),
        members,
        spread,
        chi_square,
        np.asarray(chdtrc(2.0 * (members - 1), chi_square), dtype=np.float64),
        pairs[right].numpy(),
        angle[right].numpy(),
        sigma[right].numpy(),
        options.tolerance_rad,
        considered,
    )
