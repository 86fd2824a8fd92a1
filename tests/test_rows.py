"""Tables that grow epoch by epoch."""

import numpy as np
import xarray as xr

from glintrack.core.records import Rows


def epoch(k):
    """As many rows as the last digit of k says."""
    n = k % 10
    values = {"a": ("row", np.arange(n) + 100.0 * k, {"units": "m"}), "b": (("row", "w"), np.full((n, 2), k))}
    return xr.Dataset(values, {"w": [0.5, 0.7], "id": ("row", np.arange(n))})


def test_rows_are_those_of_all_epochs_in_order():
    table = Rows()
    for k in range(200):
        table = table.append(epoch(k))
    xr.testing.assert_identical(table.to_dataset(), xr.concat([epoch(k) for k in range(200)], "row"))


def test_a_table_is_not_changed_by_the_next():
    before = Rows().append(epoch(3))
    after = before.append(epoch(4))
    assert (before.to_dataset().sizes["row"], after.to_dataset().sizes["row"]) == (3, 7)


def test_no_epochs_are_no_table():
    assert not Rows().to_dataset().sizes
