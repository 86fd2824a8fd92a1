"""Each kind of fault in an array gives one sentence that names the variable and what came."""

import numpy as np
import pytest
import xarray as xr

from glintrack.core.schema import COORDINATE_UNITS, SCHEMAS, Variable, check

RADIANCE = "W m-2 sr-1 um-1"
SIZES = {"stokes": 3}


def example(name, size=4, dtype=float):
    """The least dataset that satisfies a schema: lowest legal numbers, units on everything."""
    variables, coords = {}, {}
    for variable, variable_schema in SCHEMAS[name].items():
        shape = [SIZES.get(dim, size) for dim in variable_schema.dims]
        level = variable_schema.lowest if np.isfinite(variable_schema.lowest) else 0.5
        attrs = {"units": variable_schema.units}
        if "stokes" in variable_schema.dims:
            attrs["stokes_frame"] = "meridian"
            coords["stokes"] = ["I", "Q", "U"]
        for dim in variable_schema.dims:
            if dim in COORDINATE_UNITS:
                units = "element" if name == "frame" and dim in "xy" else COORDINATE_UNITS[dim]
                coords[dim] = (dim, np.arange(size, dtype=float), {"units": units})
        values = (
            np.full(shape, variable_schema.choices[0])
            if variable_schema.choices
            else np.full(shape, level, dtype)
        )
        variables[variable] = (variable_schema.dims, values, attrs)
    return xr.Dataset(variables, coords)


@pytest.mark.parametrize("name", SCHEMAS)
def test_what_fits_is_returned_itself(name):
    dataset = example(name)
    assert check(dataset, name) is dataset


@pytest.mark.parametrize("name", SCHEMAS)
def test_nothing_at_all_fits_too(name):
    check(example(name, size=0), name)


@pytest.mark.parametrize(("name", "variable"), [(n, v) for n, vs in SCHEMAS.items() for v in vs])
def test_every_variable_is_required(name, variable):
    with pytest.raises(ValueError, match=rf"^`{name}\.{variable}` must be present; got only \["):
        check(example(name).drop_vars(variable), name)


@pytest.mark.parametrize(("name", "variable"), [(n, v) for n, vs in SCHEMAS.items() for v in vs])
def test_every_unit_is_required(name, variable):
    dataset = example(name)
    dataset[variable].attrs["units"] = "furlong"
    with pytest.raises(ValueError, match=rf"^`{name}\.{variable}` must have units '.*'; got 'furlong'\.$"):
        check(dataset, name)
    del dataset[variable].attrs["units"]
    with pytest.raises(ValueError, match=rf"^`{name}\.{variable}` must have units '.*'; got None\.$"):
        check(dataset, name)


def test_dims_must_come_in_order():
    with pytest.raises(ValueError, match=r"`frame\.pan` must have dims \('y', 'x'\); got \('x', 'y'\)"):
        check(example("frame").transpose("x", "y", "stokes"), "frame")


@pytest.mark.parametrize(("value", "label"), [(np.nan, "nan"), (np.inf, "inf")])
def test_numbers_must_be_finite_where_no_data_is_no_option(value, label):
    dataset = example("terrain")
    dataset["height"].values[1, :2] = value
    with pytest.raises(ValueError, match=r"`terrain\.height` must be finite; got 2 that are not"):
        check(dataset, "terrain")


def test_nan_marks_no_data_where_allowed():
    dataset = example("frame")
    dataset["pan"].values[:] = np.nan
    check(dataset, "frame")


def test_infinity_is_never_data():
    dataset = example("image")
    dataset["pan"].values[0, 0] = np.inf
    with pytest.raises(ValueError, match=r"`image\.pan` must be finite; got 1 that are not"):
        check(dataset, "image")


@pytest.mark.parametrize(("value", "came"), [(-0.1, "got -0.1 to 0"), (1.5, "got 0 to 1.5")])
def test_range_is_named_with_what_came(value, came):
    dataset = example("materials")
    dataset["roughness"].values[2] = value
    with pytest.raises(ValueError, match=rf"`materials\.roughness` must lie within 0 to 1; {came}"):
        check(dataset, "materials")


def test_texts_are_of_the_choices():
    dataset = example("tracks")
    dataset["status"] = ("track", np.full(4, "lost"), {"units": "1"})
    with pytest.raises(ValueError, match=r"`tracks\.status` must be one of measured, .*; got lost"):
        check(dataset, "tracks")


def test_stokes_coordinate_must_be_the_components():
    dataset = example("frame").assign_coords(stokes=["I", "U", "Q"])
    message = r"`frame\.stokes_radiance` must have a stokes coordinate I Q U \[V\]; got"
    with pytest.raises(ValueError, match=rf"{message} \['I', 'U', 'Q'\]"):
        check(dataset, "frame")
    with pytest.raises(ValueError, match=rf"{message} None"):
        check(example("frame").drop_vars("stokes"), "frame")


def test_four_components_will_do():
    attrs = {"units": RADIANCE, "stokes_frame": "detector"}
    whole = xr.Dataset(
        {
            "pan": (("y", "x"), np.zeros((2, 2)), {"units": RADIANCE}),
            "stokes_radiance": (("y", "x", "stokes"), np.zeros((2, 2, 4)), attrs),
        },
        coords={"stokes": ["I", "Q", "U", "V"]},
    )
    check(whole, "frame")


@pytest.mark.parametrize("frame", [None, "sensor"])
def test_stokes_frame_must_be_named(frame):
    dataset = example("image")
    dataset["stokes_radiance"].attrs["stokes_frame"] = frame
    with pytest.raises(
        ValueError, match=rf"`image\.stokes_radiance` must name its stokes_frame .*; got {frame!r}"
    ):
        check(dataset, "image")


def test_coordinates_have_units_too():
    dataset = example("terrain")
    dataset["x"].attrs["units"] = "km"
    with pytest.raises(ValueError, match=r"`terrain\.x` must have units 'm'; got 'km'"):
        check(dataset, "terrain")


def test_a_frames_axes_count_elements():
    dataset = example("frame")
    dataset["y"].attrs["units"] = "m"
    with pytest.raises(ValueError, match=r"`frame\.y` must have units 'element'; got 'm'"):
        check(dataset, "frame")


def test_integers_are_numbers():
    check(example("truth", dtype=int), "truth")


def test_faults_are_one_sentence():
    for broken in (example("tracks").drop_vars("east_m"), example("tracks").rename(track="object")):
        with pytest.raises(ValueError, match=" must ") as caught:
            check(broken, "tracks")
        assert (
            "\n" not in str(caught.value) and " must " in str(caught.value) and "; got " in str(caught.value)
        )


def test_no_schema_names_a_dim_beyond_the_conventions():
    listed = set("time y x wavelength stokes vehicle track material channel".split())
    listed |= {"zenith", "view_zenith", "azimuth", "altitude", "sky_component", "path_component", "query"}
    listed |= {"gap"}  # of an etalon
    for variables in SCHEMAS.values():
        for variable in variables.values():
            assert isinstance(variable, Variable) and set(variable.dims) <= listed
