"""Simulations of a search as cases of a study, in a study's folder, which makes a search resumable."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.study.folder import StudyFolder
from glintrack.study.optimize.search import Outcome, find_cheapest
from glintrack.study.optimize.spec import CONDITION, DURATION, Optimization, study_of
from glintrack.study.plan import Plan, Point, build_plan
from glintrack.study.run import StudyEvent, run_study
from glintrack.study.workers import Pool, Simulate, simulate_case


@dataclass
class StudyRunner:
    """Simulate designs of an optimization; an instance is the function that `find_cheapest` calls.

    Parameters
    ----------
    optimization, folder, pool, cache
        What is simulated, the folder (opened with `plan`), the executor, and the hits cache.
    simulate
        Function of a case, as for `run_study`.
    callback
        Called after each event of a run.
    announce
        Called before each batch with its number of designs, cities and its duration. [s]
    """

    optimization: Optimization
    folder: StudyFolder
    pool: Pool
    cache: Path | None = None
    simulate: Simulate = simulate_case
    callback: Callable[[StudyEvent], None] | None = None
    announce: Callable[[int, int, float], None] = lambda designs, cities, duration_s: None
    rows: dict[tuple[int, float, str], dict[int, str]] = field(default_factory=dict)
    cases: dict = field(default_factory=dict)

    def __call__(
        self, designs: Sequence[int], cities: Sequence[int], fidelity: int
    ) -> Float[Array, "design city requirement"]:
        """Scores of designs in cities; NaN for a case that failed."""
        setup = self.optimization
        duration_s = setup.design.durations_s[-1 - fidelity]
        self.announce(len(designs), len(cities), duration_s)
        conditions = setup.design.conditions_in_use
        tables = [
            {"label": f"{design} {label}", **setup.keys[design], **keys}
            for design in designs
            for label, keys, _ in conditions
        ]
        replicates = [setup.design.city(city) for city in cities]
        study = study_of(setup.design, duration_s, design="list", cases=tables, replicates=replicates)
        plan = replace(build_plan(study, setup.base, setup.inside), key=setup.key)
        report = run_study(plan, self.folder, self.pool, self.cache, self.simulate, self.callback)
        if report.interrupted:
            raise KeyboardInterrupt
        if len(report.failed) == len(plan.cases):
            raise ValueError(
                f"`axes` must have designs that can be simulated; got failures only, see "
                f"{self.folder.path / 'failed'}. {self.folder.failure(report.failed[0])}"
            )
        self.cases |= plan.cases
        keys = iter(point.case_key for point in plan.points)
        for design in designs:
            for label, _, _ in conditions:
                row = self.rows.setdefault((design, duration_s, label), {})
                row |= {city: next(keys) for city in cities}
        return np.array([[self._scores(d, city, duration_s) for city in cities] for d in designs], float)

    def _scores(self, design: int, city: int, duration_s: float) -> list[float]:
        out = []
        for label, _, requirements in self.optimization.design.conditions_in_use:
            outcome = self.folder.outcome(self.rows[design, duration_s, label][city])
            for k in range(len(requirements)):
                one = self.optimization.problem.requirements[len(out)]
                scores = outcome["scores"].get(one.channel, {}) if outcome else {}
                out.append(scores.get(requirements[k].score, math.nan))
        return out

    def plan(self) -> Plan:
        """All simulations so far as one study: a row for each design, duration and condition."""
        setup = self.optimization
        cities = sorted({city for row in self.rows.values() for city in row})
        place = {city: k for k, city in enumerate(cities)}
        points = []
        for number, ((design, duration_s, label), row) in enumerate(self.rows.items()):
            levels = dict(setup.levels[design]) | {DURATION: duration_s}
            levels |= {CONDITION: label} if setup.design.conditions else {}
            for city, key in row.items():
                points.append(Point(number * len(cities) + place[city], place[city], levels, key))
        cases = [{"label": str(number)} for number in range(max(len(self.rows), 1))]
        replicates, duration_s = [setup.design.city(city) for city in cities], setup.design.durations_s[-1]
        study = study_of(setup.design, duration_s, design="list", cases=cases, replicates=replicates)
        return Plan(study, (), tuple(points), dict(self.cases), setup.key)


def run_search(runner: StudyRunner) -> Outcome:
    """Search with real simulations; the same call resumes it, as finished cases are read from the folder."""
    return find_cheapest(runner.optimization.problem, runner)
