"""Work in threads: the next item made while one is used."""

import threading
import time

import numba as nb
import pytest

from glintrack.core.parallel import BackgroundTask, compilation, map_threads, one_thread, prefetch


@pytest.fixture(params=[1, 2])
def threads(request):
    before = nb.get_num_threads()
    if request.param > before:
        pytest.skip("one core")
    nb.set_num_threads(request.param)
    yield request.param
    nb.set_num_threads(before)


def test_items_come_in_order_and_the_next_is_made_meanwhile(threads):
    begun, made_by = [threading.Event() for _ in range(4)], []

    def make(item):
        begun[item].set()
        made_by.append((threading.current_thread(), nb.get_num_threads()))
        return 10 * item

    for k, made in enumerate(prefetch(make, range(4))):
        assert made == 10 * k
        if threads == 2 and k < 3:
            assert begun[k + 1].wait(timeout=60)
        assert not any(event.is_set() for event in begun[k + 2 :])  # never more than one ahead
    others = {thread for thread, _ in made_by} - {threading.main_thread()}
    assert len(others) == threads - 1
    assert {count for _, count in made_by} == {threads}


def test_an_error_is_raised_where_its_item_is_wanted(threads):
    def make(item):
        if item == 2:
            raise ValueError("the third")
        return item

    coming = prefetch(make, range(9))
    assert [next(coming), next(coming)] == [0, 1]
    with pytest.raises(ValueError, match="the third"):
        next(coming)
    assert list(coming) == []


def test_closing_waits_for_what_is_being_made(threads):
    ended = []

    def make(item):
        time.sleep(0.02)
        ended.append(item)

    coming = prefetch(make, range(9))
    next(coming)
    coming.close()
    after = list(ended)
    time.sleep(0.05)
    assert ended == after


def test_nothing_comes_of_nothing(threads):
    assert list(prefetch(str, [])) == []


def test_map_threads_is_in_order_and_on_as_many_threads_as_there_are(threads):
    together = threading.Barrier(threads, timeout=60)

    def work(item):
        together.wait()  # ends only if as many are under way
        return 10 * item, threading.current_thread(), nb.get_num_threads()

    found = map_threads(work, range(4))
    assert [one[0] for one in found] == [0, 10, 20, 30]
    assert {one[2] for one in found} == {threads}
    with one_thread():
        assert map_threads(lambda k: threading.current_thread(), range(3)) == 3 * [threading.main_thread()]


def test_an_error_beside_others_is_raised(threads):
    with pytest.raises(ZeroDivisionError):
        map_threads(lambda k: 1 // k, range(3))


def test_work_beside_goes_on_one_piece_at_a_time(threads):
    may_end, done, beside = threading.Event(), [], BackgroundTask()

    def first():
        assert may_end.wait(timeout=60)
        done.append(threading.current_thread())

    if threads == 1:
        may_end.set()
    beside.begin(first)
    assert threads == 1 or not done  # it has only begun
    may_end.set()
    beside.begin(lambda: done.append(nb.get_num_threads()))
    assert done[0] is not threading.main_thread() or threads == 1
    beside.wait()
    assert done[1] == threads


def test_an_error_beside_is_raised_where_it_is_waited_for(threads):
    beside = BackgroundTask()

    def fail():
        beside.begin(lambda: print(1 // 0))
        beside.wait()

    with pytest.raises(ZeroDivisionError):
        fail()
    beside.wait()  # it was told once


def test_each_compiled_kernel_is_reported(monkeypatch):
    counts = []
    monkeypatch.setattr(compilation, "on_kernel", counts.append)
    before = compilation.kernels
    assert nb.njit(lambda x: x + 1)(1) == 2
    assert counts == [before + 1] == [compilation.kernels]
