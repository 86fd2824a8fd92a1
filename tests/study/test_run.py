"""The order of work: hits are traced once where workers allow."""

from glintrack.study.run import work_order


def ordered(*groups):
    geometry_of = {f"{name}{k}": name for name, count in groups for k in range(count)}
    return work_order(geometry_of)


def test_every_case_comes_once():
    groups = (("a", 3), ("b", 1), ("c", 5))
    assert sorted(ordered(*groups)) == sorted(f"{n}{k}" for n, c in groups for k in range(c))


def test_one_of_each_geometry_first_and_the_widely_shared_before_others():
    assert ordered(("a", 1), ("b", 3), ("c", 2)) == ["b0", "c0", "a0", "b1", "b2", "c1"]
