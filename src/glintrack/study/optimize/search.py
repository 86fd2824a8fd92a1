"""Search for the cheapest of many candidates that meets requirements, and confirm it over unseen cities.

Each requirement has a Gaussian process of its score. The next design is the candidate with the largest
expected saving: the probability that it meets all requirements times its saving against the cheapest one
that is known to meet them (constrained expected improvement with a known objective).

References
----------
Gardner et al., "Bayesian Optimization with Inequality Constraints", Proc. ICML (2014), Eq. (3).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from glintrack.core.arrays import Array
from glintrack.metrics.requirement import SHARES, Requirement
from glintrack.study.optimize.surrogate import GaussianProcess, fit_gaussian_process

BATCH = 4  # designs that are simulated together, in the same city
ATTEMPTS = 2  # confirmations for which simulations are reserved
TRIAL = 0.75  # share of the allowed risk from which on a design is worth a confirmation
MIN_SAVING = 0.003  # expected saving below which the search ends, as a share of the cost
_NEAR = 0.15  # distance of designs that tell much the same, in ranges of an axis


@dataclass(frozen=True)
class Problem:
    """Candidates and requirements.

    Parameters
    ----------
    places
        Encoded designs, about 0 to 1 along each axis, in an order that fills the space.
    cost
        Their costs.
    requirements
        One for each column of the scores.
    probability
        Probability of meeting all requirements that a design must have, 0.5 to 1.
    simulations
        Largest number of simulations.
    runs
        Number of simulations of a design in one city: one for each condition.
    cities, confirming_cities
        Number of cities of the search, and of those for each confirmation.
    fidelities
        Number of durations.

    Raises
    ------
    ValueError
        If the budget is too small for the first designs and a confirmation.
    """

    places: Float[Array, "candidate axis"]
    cost: Float[Array, "candidate"]
    requirements: tuple[Requirement, ...]
    probability: float = 0.9
    simulations: int = 60
    runs: int = 1
    cities: int = 8
    confirming_cities: int = 6
    fidelities: int = 2

    def __post_init__(self):
        axes = self.places.shape[1]
        least = self.runs * (self.first_designs + self.confirming_cities)
        if least > self.simulations:
            raise ValueError(
                f"`simulations` must be at least {least} for {axes} axes and {self.runs} conditions; "
                f"got {self.simulations}."
            )

    @property
    def first_designs(self) -> int:
        """Number of designs that are simulated before a prediction."""
        return min(2 * self.places.shape[1] + 2, len(self.cost))

    @property
    def trial_probability(self) -> float:
        """Probability from which a design is worth a confirmation."""
        return 1 - TRIAL * (1 - self.probability)


# scores of designs in cities at a fidelity, 0 for the full duration: design, city, requirement
Simulate = Callable[[Sequence[int], Sequence[int], int], Float[Array, "design city requirement"]]


@dataclass(frozen=True)
class Observations:
    """Scores of simulations: rows of design, city, fidelity and scores."""

    design: Int[Array, "n"] = field(default_factory=lambda: np.empty(0, int))
    city: Int[Array, "n"] = field(default_factory=lambda: np.empty(0, int))
    fidelity: Int[Array, "n"] = field(default_factory=lambda: np.empty(0, int))
    scores: Float[Array, "n requirement"] = field(default_factory=lambda: np.empty((0, 0)))

    def with_scores(
        self,
        designs: Sequence[int],
        cities: Sequence[int],
        fidelity: int,
        scores: Float[Array, "design city requirement"],
    ) -> "Observations":
        """Observations with those of some designs in some cities."""
        flat = scores.reshape(len(designs) * len(cities), -1)
        return Observations(
            design=np.append(self.design, np.repeat(designs, len(cities)).astype(int)),
            city=np.append(self.city, np.tile(cities, len(designs)).astype(int)),
            fidelity=np.append(self.fidelity, np.full(len(flat), fidelity)),
            scores=flat if not len(self.scores) else np.concatenate([self.scores, flat]),
        )


@dataclass(frozen=True)
class Outcome:
    """Result of a search.

    Parameters
    ----------
    answer
        ``yes``: a design is confirmed; ``no``: no candidate meets the requirements; or ``undecided``.
    design
        The confirmed design, else the most promising one.
    processes
        Gaussian process of each requirement.
    feasibility
        Probability of each candidate to meet all requirements.
    observations
        All simulations.
    confirming
        Cities of the last confirmation; empty without one.
    """

    answer: str
    design: int
    processes: tuple[GaussianProcess, ...]
    feasibility: Float[Array, "candidate"]
    observations: Observations
    confirming: tuple[int, ...] = ()


def find_cheapest(problem: Problem, simulate: Simulate) -> Outcome:
    """Search, and confirm the cheapest design.

    Parameters
    ----------
    problem
        Candidates and requirements.
    simulate
        Function of designs, cities and fidelity. Cities of confirmations have numbers from
        ``problem.cities`` on.

    Raises
    ------
    ValueError
        If a requirement's score is in no simulation.
    """
    state = _State(problem, simulate)
    state.run(range(problem.first_designs), state.next_city(), problem.fidelities - 1)
    while state.room() >= state.cost_of(BATCH, 1) + ATTEMPTS * state.confirmation:
        city = state.next_city()
        batch = next_designs(problem, state.outcome(), city)
        if not batch:
            break
        state.run(batch, city, 0)
    return _confirm(problem, state)


def _confirm(problem: Problem, state: "_State") -> Outcome:
    """Simulate the cheapest promising design over unseen cities, then the next or a cheaper one."""
    now, first = state.outcome(), problem.cities
    confirmed: dict[int, tuple[int, ...]] = {}
    while now.answer == "undecided" and state.room() >= state.confirmation:
        if now.design in confirmed or now.feasibility[now.design] < problem.probability:
            break
        cities = tuple(range(first, first + problem.confirming_cities))
        confirmed[now.design], first = cities, first + problem.confirming_cities
        state.run([now.design], cities, 0)
        now = state.outcome()
    passed = [design for design in confirmed if now.feasibility[design] >= problem.probability]
    if not passed:
        return replace(now, confirming=confirmed.get(now.design, ()))
    cheapest = min(passed, key=lambda design: problem.cost[design])
    return replace(now, answer="yes", design=cheapest, confirming=confirmed[cheapest])


def next_designs(problem: Problem, now: Outcome, cities: Sequence[int]) -> list[int]:
    """Choose the most promising design, and those with the largest expected saving; empty if none is left.

    Parameters
    ----------
    problem, now
        Candidates, and what is known.
    cities
        Cities of the batch; a design is not simulated there twice.
    """
    done = set(now.observations.design[np.isin(now.observations.city, cities)].tolist())
    known = now.feasibility[now.design] >= problem.trial_probability
    span = max(float(np.ptp(problem.cost)), 1e-12)
    best = problem.cost[now.design] if known else problem.cost.max() + 0.1 * span
    gain = np.maximum(best - problem.cost, 0.0) * now.feasibility
    gain[list(done)] = 0.0
    if known and gain.max() < MIN_SAVING * max(abs(best), span):
        return []
    chosen = [] if now.design in done else [now.design]
    while len(chosen) < BATCH and gain.max() > 0:
        chosen.append(int(gain.argmax()))
        distance_2 = ((problem.places - problem.places[chosen[-1]]) ** 2).sum(axis=1)
        gain = gain * -np.expm1(-distance_2 / _NEAR**2)  # so that a batch is spread
    return list(dict.fromkeys(chosen))


def feasibility(
    requirements: Sequence[Requirement], processes: Sequence[GaussianProcess], places: Float[Array, "n axis"]
) -> Float[Array, "n requirement"]:
    """Probability of each place to meet each requirement."""
    out = []
    for requirement, process in zip(requirements, processes, strict=True):
        mean, sd = process.predict(places)
        over = mean - transform(requirement, requirement.limit)
        out.append(stats.norm.cdf((over if requirement.at_least else -over) / np.maximum(sd, 1e-12)))
    return np.stack(out, axis=-1)


def transform(requirement: Requirement, score: Array | float) -> Array:
    """Scale on which a score's noise is even: shares as they are, counts and rates as log(1 + y)."""
    return np.asarray(score, float) if requirement.score in SHARES else np.log1p(score)


def inverse_transform(requirement: Requirement, value: Array | float) -> Array:
    """Score of a value of `transform`."""
    return np.asarray(value, float) if requirement.score in SHARES else np.expm1(value)


@dataclass
class _State:
    """Simulations of a search, and how many are left."""

    problem: Problem
    simulate: Simulate
    observations: Observations = field(default_factory=Observations)
    spent: int = 0
    batches: int = 0

    @property
    def confirmation(self) -> int:
        """Number of simulations of a confirmation."""
        return self.cost_of(1, self.problem.confirming_cities)

    def cost_of(self, designs: int, cities: int) -> int:
        return designs * cities * self.problem.runs

    def room(self) -> int:
        return self.problem.simulations - self.spent

    def next_city(self) -> tuple[int]:
        self.batches += 1
        return ((self.batches - 1) % self.problem.cities,)

    def run(self, designs: Sequence[int], cities: Sequence[int], fidelity: int) -> None:
        designs = list(designs)
        found = self.simulate(designs, cities, fidelity)
        self.spent += self.cost_of(len(designs), len(cities))
        self.observations = self.observations.with_scores(designs, cities, fidelity, found)

    def outcome(self) -> Outcome:
        """Fit all scores, and name the cheapest promising design."""
        problem, seen = self.problem, self.observations
        processes = []
        for k, requirement in enumerate(problem.requirements):
            scores = transform(requirement, seen.scores[:, k])
            there = np.isfinite(scores)
            if there.sum() < 3:
                raise ValueError(
                    f"`require` must name scores of the simulations; got {requirement} with "
                    f"{there.sum()} of {len(there)} simulations that have it."
                )
            at = problem.places[seen.design[there]]
            processes.append(fit_gaussian_process(at, seen.city[there], seen.fidelity[there], scores[there]))
        probable = feasibility(problem.requirements, processes, problem.places).prod(axis=1)
        promising = probable >= problem.trial_probability
        if promising.any():
            design = int(np.where(promising, problem.cost, math.inf).argmin())
        else:
            design = int(probable.argmax())
        none_left = probable.max() < 1 - problem.probability
        return Outcome("no" if none_left else "undecided", design, tuple(processes), probable, seen)
