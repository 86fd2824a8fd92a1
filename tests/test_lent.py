"""Memory that goes on to the next array, and not before nobody holds the last."""

import gc

import numpy as np

from glintrack import lent
from glintrack.lent import MOST_BYTES


def place(array):
    return array.__array_interface__["data"][0]


def test_memory_goes_on_once_nobody_holds_a_view_of_it(monkeypatch):
    monkeypatch.setattr(lent, "_IDLE", [])
    first = lent.lent(1000, 30)
    assert first.shape == (1000, 30) and first.dtype == np.float32 and not first.any()
    first[:] = 1.0
    view, there = first[10:20, ::2], place(first)
    del first
    gc.collect()
    second = lent.lent(1000, 30)
    assert place(second) != there and (view == 1.0).all()
    del view
    gc.collect()
    assert place(lent.lent(990, 30)) == there


def test_pieces_of_other_sizes_do_not_pile_up(monkeypatch):
    monkeypatch.setattr(lent, "_IDLE", [])
    for k in range(20):
        assert lent.lent(10 * 3 ** min(k, 10), 4).shape[1] == 4
    assert len(lent._IDLE) <= lent._KEPT
    large = lent.lent(MOST_BYTES // 4 + 1)
    del large
    assert all(piece.nbytes <= 1.1 * MOST_BYTES for piece in lent._IDLE)
