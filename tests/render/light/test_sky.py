"""Air between ground and lens: interpolated between the tables, and down to none at the ground."""

import numpy as np
import pytest

from glintrack.atmosphere import solve_tables
from glintrack.case.design import Case
from glintrack.render import unpack_sky


def test_below_the_lowest_table_the_air_is_thinner_in_proportion():
    """500 m by the tables and by those from 1000 m alone: 3 % of the band's light, a tenth of the air's.

    Up to 60° from nadir. In the strong bands of water vapour, which saturate, the error is larger.
    """
    tables = solve_tables(Case().atmosphere)
    known, guessed = (unpack_sky(of, 500.0) for of in (tables, tables.isel(altitude=slice(1, None))))
    near = known.view_zenith_rad <= np.radians(60)
    passed = [sky.transmittance[:, near].mean(axis=0) for sky in (known, guessed)]
    np.testing.assert_allclose(*passed, rtol=0.03)
    path = [np.tensordot(sky.path_map[..., 0], sky.path_spectrum, axes=(2, 0)) for sky in (known, guessed)]
    assert np.median(path[1] / path[0]) == pytest.approx(1, abs=0.1)


def test_at_the_ground_there_is_no_air_and_above_the_tables_nothing_is_known():
    tables = solve_tables(Case().atmosphere)
    ground = unpack_sky(tables, 0.0)
    assert np.all(ground.transmittance == 1) and np.all(ground.path_map == 0)
    with pytest.raises(ValueError, match="must lie within the atmosphere's tables, 0 to 10000 m; got 10001"):
        unpack_sky(tables, 10001.0)
