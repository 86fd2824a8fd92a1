"""The order of work: hits are traced once where workers allow."""

import time

from glintrack.study.order import WorkQueue


def queue(*groups):
    geometry_of = {f"{name}{k}": name for name, count in groups for k in range(count)}
    return WorkQueue(geometry_of, geometry_of)


def test_every_case_comes_once():
    work = queue(("a", 3), ("b", 1), ("c", 5))
    assert sorted(work.pop() for _ in range(9)) == sorted(
        [f"{n}{k}" for n, c in (("a", 3), ("b", 1), ("c", 5)) for k in range(c)]
    )
    assert len(work) == 0


def test_one_of_each_geometry_first_and_the_widely_shared_before_others():
    work = queue(("a", 1), ("b", 3), ("c", 2))
    assert [work.pop() for _ in range(3)] == ["b0", "c0", "a0"]


def test_cases_whose_hits_are_there_come_before_new_geometries():
    work = queue(("a", 2), ("b", 3))
    assert work.pop() == "b0"
    work.traced("b")
    assert [work.pop() for _ in range(3)] == ["b1", "b2", "a0"]


def test_no_worker_idles_while_hits_are_being_traced():
    work = queue(("a", 3))
    assert [work.pop(), work.pop(), work.pop()] == ["a0", "a1", "a2"]


def test_a_case_to_be_repeated_comes_again():
    work = queue(("a", 2))
    first = work.pop()
    work.push(first)
    assert len(work) == 2 and work.left("a") == 2
    assert {work.pop(), work.pop()} == {"a0", "a1"}
    work.push("a1")
    work.traced("a")
    assert work.pop() == "a1" and len(work) == 0
    work.push("a0")
    assert work.pop() == "a0"


def test_a_large_study_is_ordered_in_no_time():
    """The largest: a sum over all geometries for each case took minutes of 20 000 cases."""
    work = queue(*((f"g{k}-", 5) for k in range(20_000)))
    start = time.process_time()
    while len(work):
        work.traced(work.pop().split("-")[0] + "-")
    assert time.process_time() - start < 5  # some 0.3 s; it would be hours
