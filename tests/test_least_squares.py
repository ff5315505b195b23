"""The solver against SciPy's, dense normal equations and closed forms."""

import itertools

import numpy as np
import pytest
import scipy.optimize
import torch

from camera_models import InputError
from omnilines.least_squares import KeptGroup, Linearisation, Loss, Outcome, Structure, solve


class Curves:
    """y = exp(-b_j x) * p_s + c_t + q with a curve parameter pair (b, h) a track, station offsets p, and one shared q."""

    def __init__(self, seed=0, tracks=30, stations=5, held=(), noise=0.05):
        rng = np.random.default_rng(seed)
        rows = [(j, s) for j in range(tracks) for s in rng.choice(stations, rng.integers(3, stations + 1), replace=False)]
        self.track, self.station = (torch.tensor(c) for c in zip(*rows, strict=True))
        self.x = torch.as_tensor(rng.uniform(0.2, 2, (len(rows), 2)))
        self.truth = (
            torch.as_tensor(rng.uniform(0.8, 1.2, stations)),
            torch.tensor([0.3], dtype=torch.float64),
            torch.as_tensor(rng.uniform(0.5, 1.5, (tracks, 2))),
        )
        index = self.station.clone()
        free = [s for s in range(stations) if s not in held]
        place = torch.full((stations,), -1)
        place[free] = torch.arange(len(free))
        self.free = torch.tensor(free)
        self.structure = Structure(
            self.track, tracks, 2, (KeptGroup(place[index], len(free), 1), KeptGroup(torch.zeros_like(index), 1, 1))
        )
        self.y = self.model(self.truth) + noise * torch.as_tensor(rng.standard_normal(self.x.shape))

    def model(self, state):
        p, q, b = state
        return p[self.station, None] * torch.exp(-b[self.track, :1] * self.x) + b[self.track, 1:] * self.x + q

    def residual(self, state):
        return self.model(state) - self.y

    def linearise(self, state):
        p, _, b = state
        decay = torch.exp(-b[self.track, :1] * self.x)
        by_b = torch.stack([-self.x * p[self.station, None] * decay, self.x], -1)
        return Linearisation(self.residual(state), by_b, (decay[..., None], torch.ones_like(decay)[..., None]))

    def retract(self, state, kept, eliminated):
        p, q, b = state
        p = p.clone()
        p[self.free] += kept[: len(self.free)]
        return p, q + kept[len(self.free) :], b + eliminated

    def gauge(self, state):
        return torch.zeros(self.structure.kept_size, 0, dtype=torch.float64)

    def start(self):
        p, q, b = self.truth
        p0 = torch.ones_like(p)
        held = [s for s in range(len(p)) if s not in self.free.tolist()]
        p0[held] = p[held]
        return p0, torch.zeros_like(q), torch.ones_like(b)

    def flat(self, state):
        return torch.cat([state[0][self.free], state[1], state[2].flatten()])

    def unflat(self, vector):
        p, _, b = self.start()
        vector = torch.as_tensor(vector)
        p[self.free] = vector[: len(self.free)]
        return p, vector[len(self.free) : len(self.free) + 1], vector[len(self.free) + 1 :].view_as(b)


@pytest.mark.parametrize("held", [(0,), (1, 3), (0, 2, 4)])
@pytest.mark.parametrize("loss", ["none", "huber", "cauchy"])
@pytest.mark.slow
def test_same_optimum_as_scipy(held, loss):
    problem = Curves(held=held)
    ours = solve(problem, problem.start(), Loss(loss, 0.06), max_iterations=500)

    # SciPy's losses act on single residuals, ours on the norm of an observation: hand it the norms.
    def residuals(v):
        r = problem.residual(problem.unflat(v))
        return r.flatten() if loss == "none" else r.norm(dim=-1)

    peer = scipy.optimize.least_squares(
        lambda v: residuals(v).numpy(),
        problem.flat(problem.start()).numpy(),
        jac=lambda v: torch.func.jacrev(residuals)(torch.as_tensor(v)).numpy(),
        loss={"none": "linear"}.get(loss, loss),
        f_scale=0.06,
        xtol=1e-12,
        ftol=1e-13,
        gtol=1e-9,
        max_nfev=100,
    )
    assert ours.outcome is Outcome.CONVERGED
    assert ours.cost <= 2 * peer.cost * (1 + 1e-7)
    if loss == "none":
        np.testing.assert_allclose(problem.flat(ours.state).numpy(), peer.x, atol=1e-5)


def test_covariance_is_the_dense_inverse():
    problem = Curves(held=(2,))
    ours = solve(problem, problem.start())
    jacobian = torch.autograd.functional.jacobian(
        lambda v: problem.residual(problem.unflat(v)).flatten(), problem.flat(ours.state)
    )
    dense = torch.linalg.inv(jacobian.mT @ jacobian)
    k = problem.structure.kept_size
    torch.testing.assert_close(ours.kept_covariance(), dense[:k, :k], rtol=1e-7, atol=1e-12)
    blocks = ours.eliminated_covariance()
    assert len(blocks) == 30
    for j in range(len(blocks)):
        at = k + 2 * j
        torch.testing.assert_close(blocks[j], dense[at : at + 2, at : at + 2], rtol=1e-7, atol=1e-12)


class Levels(Curves):
    """Differences of heights between stations: a common shift is free, which only the gauge decides."""

    def __init__(self, constrained):
        super().__init__(noise=0.01)
        self.constrained = constrained
        self.structure = Structure(self.track, 30, 2, (KeptGroup(self.station, 5, 1),))

    def model(self, state):
        p, _, b = state
        return (p[self.station] - b[self.track, 0])[:, None] + torch.stack([b[self.track, 1], -b[self.track, 1]], -1)

    def linearise(self, state):
        one = torch.ones_like(self.y)
        by_b = torch.stack([-one, torch.stack([one[:, 0], -one[:, 0]], -1)], -1)
        return Linearisation(self.residual(state), by_b, (one[..., None],))

    def retract(self, state, kept, eliminated):
        return state[0] + kept, state[1], state[2] + eliminated

    def gauge(self, state):
        return torch.ones(5, 1 if self.constrained else 0, dtype=torch.float64)


def test_gauge_is_held_and_its_absence_is_named():
    held, loose = Levels(True), Levels(False)
    solution = solve(held, held.start())
    assert solution.outcome is Outcome.CONVERGED
    assert abs(float(solution.state[0].sum()) - 5.0) < 1e-9
    covariance = solution.kept_covariance()
    assert float((covariance @ torch.ones(5, dtype=torch.float64)).abs().max()) < 1e-12
    assert float(torch.linalg.eigvalsh(covariance)[1]) > 0
    free = solve(loose, loose.start())
    assert free.outcome is Outcome.DEGENERATE
    assert abs(free.cost - solution.cost) < 1e-9 * solution.cost
    weakest = free.weakest_direction / free.weakest_direction.norm()
    torch.testing.assert_close(weakest.abs(), torch.full_like(weakest, 5**-0.5), rtol=1e-5, atol=1e-5)


def test_all_kept_blocks_held():
    problem = Curves()
    problem.structure = Structure(problem.track, 30, 2, ())
    problem.linearise = lambda state: Linearisation(problem.residual(state), Curves.linearise(problem, state).by_eliminated, ())
    problem.retract = lambda state, kept, eliminated: (state[0], state[1], state[2] + eliminated)
    problem.free = torch.zeros(0, dtype=torch.long)
    start = (problem.truth[0], problem.truth[1], torch.ones_like(problem.truth[2]))
    solution = solve(problem, start)
    assert solution.outcome is Outcome.CONVERGED
    assert float((solution.state[2] - problem.truth[2]).abs().median()) < 0.1


def test_exact_data_converge_to_zero():
    problem = Curves(noise=0.0)
    solution = solve(problem, problem.start())
    assert solution.outcome is Outcome.CONVERGED
    assert solution.cost < 1e-20


def test_few_iterations_are_named():
    problem = Curves()
    assert solve(problem, problem.start(), max_iterations=1).outcome is Outcome.OUT_OF_ITERATIONS


def test_callback_sees_a_falling_cost():
    problem = Curves()
    seen = []
    solution = solve(problem, problem.start(), callback=seen.append)
    costs = [p.cost for p in seen if p.accepted]
    assert len(costs) > 2
    assert all(a >= b for a, b in itertools.pairwise(costs))
    assert solution.cost == costs[-1]


def test_unknown_loss_is_named():
    with pytest.raises(InputError, match="one of none, huber, cauchy, found 'tukey'"):
        Loss("tukey")


def test_a_step_that_promises_little_for_its_damping_is_not_the_end():
    problem = Curves()
    best = solve(problem, problem.start())
    damped = solve(problem, problem.start(), damping=1e15)
    assert damped.outcome is Outcome.CONVERGED and damped.initial_cost > 2 * best.cost
    assert damped.cost == pytest.approx(best.cost, rel=1e-9)
