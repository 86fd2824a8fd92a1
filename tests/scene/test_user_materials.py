"""A material by a CSV and ten lines of TOML; calibration panels anywhere."""

import numpy as np
import pytest

from glintrack.scene import SceneDesign, build_scene, load_materials
from glintrack.scene.materials import choose_paints, load_user_materials

LILAC = """[lilac]
file = "lilac.csv"
refractive_index = 1.48
roughness = 0.003
specular_weight = 1.0
share = 0.5
"""


def write(tmp_path, text=LILAC, values=(0.1, 0.3, 0.3), last_um=2.6):
    (tmp_path / "m.toml").write_text(text)
    rows = [f"{w},{v}" for w, v in zip((0.35, 0.6, last_um), values, strict=True)]
    (tmp_path / "lilac.csv").write_text("# measured by me\nwavelength_um,reflectance\n" + "\n".join(rows))
    return tmp_path / "m.toml"


def test_a_material_comes_after_the_librarys(tmp_path):
    library, mesh = load_user_materials(write(tmp_path))
    plain = load_materials()
    assert library["material"].values.tolist() == [*plain["material"].values, "lilac"] and mesh == {}
    mine = library.sel(material="lilac")
    expected = np.interp(mine["wavelength"], [0.35, 0.6, 2.6], [0.1, 0.3, 0.3])
    np.testing.assert_allclose(mine["reflectance"], expected, atol=1e-12)
    np.testing.assert_array_equal(library["reflectance"][:-1], plain["reflectance"])
    assert (mine["preview_rgb"] >= 0).all() and "lilac" not in plain["material"].values
    paints = choose_paints(library, np.arange(3000), 1)
    third = 0.5 / 1.5  # its share, to the library's whole
    three_deviations = 3 * np.sqrt(third * (1 - third) / 3000)
    assert abs((paints == library.sizes["material"] - 1).mean() - third) < three_deviations


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            {"values": (10, 30, 30)},
            "`lilac.csv` must have reflectance within 0 to 1; got 10 .*Divide percent by 100",
        ),
        ({"values": (0.1, -0.2, 0.3)}, "`lilac.csv` must have reflectance within 0 to 1; got -0.2"),
        ({"values": (0.1, "x", 0.3)}, "`reflectance` must hold numbers; got 'x' in row 3 of .*lilac.csv"),
        ({"last_um": 1.0}, "lilac.csv"),
        (
            {"text": LILAC.replace("lilac.csv", "gone.csv")},
            "`gone.csv` must be a file in the materials file",
        ),
        ({"text": LILAC.replace("[lilac]", "[asphalt]")}, "must give new names; got 'asphalt'"),
        ({"text": LILAC.replace("0.003", "7")}, "`lilac` must be a material: `roughness` must be .*1; got 7"),
        (
            {"text": LILAC.replace("roughness", "roughnes")},
            "`lilac` must be a material: `roughness?` must be ",
        ),
        ({"text": LILAC + "constant = 0.2\n"}, "exactly one of"),
        ({"text": LILAC + 'optical_constants = "water_nk"\n'}, "exactly one of refractive_index, optical"),
        (
            {"text": LILAC.replace("refractive_index = 1.48", 'optical_constants = "mud_nk"')},
            "`optical_constants` must be one of the packaged spectra; got 'mud_nk'",
        ),
        (
            {"text": LILAC.replace("refractive_index = 1.48", f'optical_constants = "{"m" * 300}"')},
            "`optical_constants` must be one of the packaged spectra; got 'mmm",
        ),
        ({"text": LILAC + "leaf_absorptance = 0.8\n"}, "`leaf_absorptance` must .* below 0.7; got 0.8"),
        ({"text": "[lilac"}, "`materials_file` must be valid TOML"),
        ({"text": "lilac = 3"}, "must hold one table a material"),
    ],
)
def test_bad_materials_get_one_sentence(tmp_path, change, sentence):
    with pytest.raises(ValueError, match=sentence) as error:
        load_user_materials(write(tmp_path, **change))
    assert "\n" not in str(error.value)


def test_a_leaf_and_an_interface_of_ones_own(tmp_path):
    text = LILAC.replace("refractive_index = 1.48", 'optical_constants_file = "nk.csv"')
    text += 'transmittance_column = "passed"\n'
    path = write(tmp_path, text)
    (tmp_path / "lilac.csv").write_text("wavelength_um,reflectance,passed\n0.4,0.1,0.2\n2.5,0.3,0.6\n")
    (tmp_path / "nk.csv").write_text("wavelength_um,n,k\n0.4,1.6,0\n2.5,1.4,0.1\n")
    mine = load_user_materials(path)[0].sel(material="lilac")
    np.testing.assert_allclose(mine["transmittance"], 2 * mine["reflectance"])
    np.testing.assert_allclose(mine["refractive_index_spectrum"][[0, -1]], [1.6, 1.4])
    assert float(mine["refractive_index"]) == pytest.approx(1.6 - 0.2 * 0.25 / 2.1)
    (tmp_path / "lilac.csv").write_text("wavelength_um,reflectance,passed\n0.4,0.1,0.2\n2.5,0.3,0.8\n")
    with pytest.raises(
        ValueError, match="`lilac` must have a transmittance of at least 0 and at most 1 less"
    ):
        load_user_materials(path)


def test_shares_of_paints_replace_the_librarys(tmp_path):
    path = write(tmp_path, LILAC + "\n[paint_shares]\npaint_white = 0.2\nlilac = 0.6\n")
    library, _ = load_user_materials(path)
    chosen = library["material"].values[choose_paints(library, np.arange(3000), 1)]
    assert set(chosen) == {"paint_white", "lilac"}
    assert np.mean(chosen == "lilac") == pytest.approx(0.75, abs=0.03)
    path.write_text("[paint_shares]\npaint_red = 1\n")  # no material of one's own
    library, _ = load_user_materials(path)
    assert set(library["material"].values[choose_paints(library, np.arange(30), 1)]) == {"paint_red"}
    others = load_materials()  # of the next case in this process
    assert len(set(others["material"].values[choose_paints(others, np.arange(300), 1)])) > 3


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ("paint_shares = 3", "`paint_shares` must be a table of paints and shares, such as .*; got 3"),
        ("[paint_shares]", "`paint_shares` must be a table"),
        ("[paint_shares]\npaint_pink = 0.1", "`paint_shares` must name materials, .*; got 'paint_pink'"),
        ("[paint_shares]\npaint_red = 34", "`paint_shares.paint_red` must be a share from 0 to 1; got 34"),
        ("[paint_shares]\npaint_red = nan", "`paint_shares.paint_red` must be a share from 0 to 1; got nan"),
        ("[paint_shares]\npaint_red = 0", "`paint_shares` must have a share above 0"),
    ],
)
def test_bad_shares_of_paints_get_one_sentence(tmp_path, table, sentence):
    path = tmp_path / "m.toml"
    path.write_text(table)
    with pytest.raises(ValueError, match=sentence) as error:
        load_user_materials(path)
    assert "\n" not in str(error.value)


def test_panels_lie_where_they_are_asked_for_with_nothing_on_them(tmp_path):
    panel = {"east_m": -225.0, "north_m": 135.0, "length_m": 30.0, "width_m": 10.0, "heading_deg": 90.0}
    panels = [{**panel, "material": "panel_50"}, {**panel, "north_m": 100.0, "material": "lilac"}]
    materials = str(write(tmp_path, LILAC.replace("share = 0.5", "")))  # or cars would wear it
    city = build_scene(SceneDesign(panels=panels, materials_file=materials, relief_m=0.0))
    names = list(city.materials["material"].values)
    for material, north in (("panel_50", 135.0), ("lilac", 100.0)):
        mine = city.static.vertices[
            np.unique(city.static.faces[city.static.material == names.index(material)])
        ]
        np.testing.assert_allclose(mine.min(axis=0), [-240, north - 5, -0.1], atol=1e-4)
        np.testing.assert_allclose(mine.max(axis=0), [-210, north + 5, 0.2], atol=1e-4)
    high = city.static.vertices[city.static.vertices[:, 2] > 0.3]
    over = (np.abs(high[:, 0] + 225) < 14) & (np.abs(high[:, 1] - 135) < 4)
    assert not over.any()


def test_a_panel_of_an_unknown_material_is_refused():
    panel = {"material": "panel_55", "east_m": 0, "north_m": 0}
    with pytest.raises(
        ValueError, match=r"`scene.panels.0.material` must be one of the library.*Did you mean"
    ):
        build_scene(SceneDesign(panels=[panel]))


def test_a_panel_beyond_the_window_is_refused():
    panel = {"material": "panel_50", "east_m": -9225.0, "north_m": 135.0}
    with pytest.raises(ValueError, match=r"`scene.panels.0` must lie in the window, .*got -9225 and 135 m"):
        build_scene(SceneDesign(panels=[panel]))


def test_a_material_varies_toward_a_known_one(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(
        "[mine]\nconstant = 0.2\nrefractive_index = 1.5\nroughness = 0.5\nspecular_weight = 0.1\n"
        'toward = "x"\n'
    )
    with pytest.raises(ValueError, match="`mine` must have a material as its `toward`; got 'x'"):
        load_user_materials(path)
