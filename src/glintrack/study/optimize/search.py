"""Search for the cheapest of many candidates that meets requirements, and confirm it over unseen cities.

Each requirement has a Gaussian process of its score. A batch has the cheapest candidates that meet all
requirements with rising probabilities: designs along the Pareto front of cost and probability, where the
decision falls. A confirmation tries a cheap design as long as two more remain for safer designs.
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

LADDER = (0.2, 0.4, 0.6, 0.8)  # probabilities of the designs of a batch, which share their city
ATTEMPTS = 4  # confirmations for which up to half of the simulations are reserved
BOLD = 0.6  # probability from which a design is tried while two more confirmations remain
MIN_CITIES = 0.5  # share of the search's cities before it may end: a few scores fit any noise
MIN_SAVING = 0.003  # possible saving below which the search ends, as a share of the cost


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
    durations_s
        Durations of a simulation, rising. [s]

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
    durations_s: tuple[float, ...] = (12.0, 24.0)

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
    def sure_probability(self) -> float:
        """Probability from which a design is confirmed, and is worth one of the last two confirmations.

        It is above that asked for, because several designs are tried and the luckiest passes.
        """
        return (1 + self.probability) / 2


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

    def has_scores(self, design: int, cities: Sequence[int]) -> bool:
        """Return True if at least half of a design's simulations in some cities have each score."""
        own = (self.design == design) & np.isin(self.city, cities)
        return bool((np.isfinite(self.scores[own]).mean(axis=0) >= 0.5).all())


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
    state.run(range(problem.first_designs), state.next_city(), len(problem.durations_s) - 1)
    reserve = max(state.confirmation, min(ATTEMPTS * state.confirmation, state.room() // 2))
    while state.room() >= state.cost_of(len(LADDER), 1) + reserve:
        now = state.outcome()
        if state.batches >= MIN_CITIES * problem.cities and not can_save(problem, now):
            break
        city = state.next_city()
        batch = next_designs(problem, now, city)
        if not batch:
            break
        state.run(batch, city, 0)
    return _confirm(problem, state)


def _confirm(problem: Problem, state: "_State") -> Outcome:
    """Simulate promising designs over unseen cities, each over others, as long as one may be cheaper.

    If no design seems to meet the requirements, the nearest is simulated all the same.
    """
    now, first = state.outcome(), problem.cities
    confirmed: dict[int, tuple[int, ...]] = {}
    passed: list[int] = []
    while (now.answer == "undecided" or not confirmed) and state.room() >= state.confirmation:
        is_late = not passed and state.room() < 3 * state.confirmation
        best = min(problem.cost[passed], default=math.inf)
        design = _next_confirmation(problem, now, list(confirmed), best, is_late)
        if design is None:
            break
        cities = tuple(range(first, first + problem.confirming_cities))
        confirmed[design], first = cities, first + problem.confirming_cities
        state.run([design], cities, 0)
        now = state.outcome()
        passed = [
            design
            for design, own in confirmed.items()
            if now.feasibility[design] >= problem.sure_probability
            and now.observations.has_scores(design, own)
        ]
    if not passed:
        return replace(now, confirming=confirmed.get(now.design, ()))
    cheapest = min(passed, key=lambda design: problem.cost[design])
    return replace(now, answer="yes", design=cheapest, confirming=confirmed[cheapest])


def _next_confirmation(
    problem: Problem, now: Outcome, tried: list[int], best: float, is_late: bool
) -> int | None:
    """Cheapest design below a cost with a fair chance, a good one at the last tries; None if none is left."""
    probable = now.feasibility.copy()
    probable[tried] = -1.0
    probable[problem.cost >= best] = -1.0
    for limit in (problem.sure_probability,) if is_late else (BOLD, problem.sure_probability):
        if (probable >= limit).any():
            return int(np.where(probable >= limit, problem.cost, math.inf).argmin())
    return None if math.isfinite(best) or probable.max() < 0 else int(probable.argmax())


def can_save(problem: Problem, now: Outcome) -> bool:
    """Return False if a design is promising, and none that may meet the requirements is much cheaper."""
    probable, cost = now.feasibility, problem.cost
    if probable[now.design] < problem.sure_probability:
        return True
    saving = cost[now.design] - cost[probable >= LADDER[0]].min()
    return saving >= MIN_SAVING * max(abs(cost[now.design]), float(np.ptp(cost)))


def next_designs(problem: Problem, now: Outcome, cities: Sequence[int]) -> list[int]:
    """Choose the cheapest design of each probability in `LADDER`; empty if all are simulated.

    Parameters
    ----------
    problem, now
        Candidates, and what is known.
    cities
        Cities of the batch; a design is not simulated there twice.
    """
    probable, cost = now.feasibility.copy(), problem.cost
    probable[now.observations.design[np.isin(now.observations.city, cities)]] = -1.0
    chosen: list[int] = []
    for limit in LADDER:
        enough = probable >= min(limit, probable.max())
        if probable.max() >= 0:
            chosen.append(int(np.where(enough, cost, math.inf).argmin()))
            probable[chosen[-1]] = -1.0
    return chosen


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


def _mean_of_logarithms(process: GaussianProcess) -> GaussianProcess:
    """Predict the logarithm of the mean, not the mean of logarithms: half their variance above it."""
    return replace(process, mean=process.mean + 0.5 * (process.city_sd**2 + process.noise_sd**2))


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
        durations = np.array(problem.durations_s)[-1 - seen.fidelity]
        processes, blind = [], set[int]()
        for k, requirement in enumerate(problem.requirements):
            scores = transform(requirement, seen.scores[:, k])
            there = np.isfinite(scores)
            if there.sum() < 3:
                raise ValueError(
                    f"`require` must name scores of the simulations; got {requirement} with "
                    f"{there.sum()} of {len(there)} simulations that have it."
                )
            # lacking a score everywhere, or where others have it, is missing the limit: nothing was tracked
            nowhere = ~np.isin(seen.design, seen.design[there])
            lacks = ~there & (nowhere | np.isin(seen.city, seen.city[there]))
            blind |= set(seen.design[nowhere].tolist())
            sign = 1 if requirement.at_least else -1
            beyond = transform(requirement, requirement.limit) - 3 * sign * scores[there].std()
            scores[lacks] = sign * min(sign * beyond, (sign * scores[there]).min())
            there = there | lacks
            at = problem.places[seen.design[there]]
            halvings = np.log2(problem.durations_s[-1] / durations[there])
            process = fit_gaussian_process(at, seen.city[there], halvings, scores[there])
            processes.append(process if requirement.score in SHARES else _mean_of_logarithms(process))
        probable = feasibility(problem.requirements, processes, problem.places).prod(axis=1)
        probable[list(blind)] = 0.0
        promising = probable >= problem.sure_probability
        if promising.any():
            design = int(np.where(promising, problem.cost, math.inf).argmin())
        else:
            design = int(probable.argmax())
        none_left = probable.max() < 1 - problem.probability
        return Outcome("no" if none_left else "undecided", design, tuple(processes), probable, seen)
