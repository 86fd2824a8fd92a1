"""What `benchmarks/cost_laws.py` makes of times: exponents of known laws, the table's file, its sizes."""

import csv
import importlib
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def laws(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("cost_laws")


def points(laws, seconds, name="a law, elements"):
    return [
        laws.Point(name, "elements", n, s, 100.0)
        for n, s in zip((10, 100, 1000, 10_000), seconds, strict=True)
    ]


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
def test_the_exponent_of_a_power_law_is_its_own(laws, power):
    n = np.logspace(1, 5, 9)
    assert laws.exponent(n, 3e-4 * n**power) == pytest.approx(power)


def test_what_does_not_grow_is_left_to_the_lower_half(laws):
    """1 s and 1 ms an item, in two sizes of the upper half: log(101 / 2) over log 100."""
    assert laws.exponent([10, 100, 1000, 100_000], [1.01, 1.1, 2.0, 101.0]) == pytest.approx(
        np.log(101 / 2) / np.log(100)
    )


@pytest.mark.parametrize(
    ("seconds", "verdict"),
    [((1, 10, 100, 1000), "near-linear or better"), ((1, 100, 1e4, 1e6), "more than linear")],
)
def test_a_law_is_near_linear_or_not(laws, seconds, verdict):
    assert laws.summary(points(laws, seconds))["verdict"] == verdict


def test_the_csv_has_a_line_a_size(laws, tmp_path):
    made = points(laws, (1.0, 2.0, 3.0, 4.0))
    laws.write_csv(made, tmp_path / "laws.csv")
    with (tmp_path / "laws.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["law", "over", "size", "cpu_s", "peak_mb"]
    assert [(row["law"], int(row["size"]), float(row["cpu_s"])) for row in rows] == [
        (one.law, one.size, one.cpu_s) for one in made
    ]


def test_laws_go_as_far_as_their_decades_and_quick_ones_stop_early(laws):
    law = laws.LAWS["frame, elements"]
    assert law.sizes(quick=False)[::2] == [10_000, 100_000, 1_000_000, 10_000_000]
    assert law.sizes(quick=True) == [10_000, 100_000, 1_000_000]
