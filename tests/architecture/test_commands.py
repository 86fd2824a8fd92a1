"""A Python user can do everything that a command can: each command's work is a public function."""

import ast
import importlib
import inspect

import pytest

from glintrack.cli.app import load_program

# command -> public functions that do its work; the command reads options, calls them and tells
WORK = {
    "atmosphere plot": ("glintrack.results.figures.sky.fisheye", "glintrack.results.figures.sky.spectra"),
    "atmosphere solve": ("glintrack.atmosphere.solve_tables",),
    "bound": ("glintrack.bounds.run.measure_bounds", "glintrack.bounds.tasks.measure_tasks"),
    "case check": ("glintrack.case.design.Case.from_toml", "glintrack.assess_case"),
    "case list": ("glintrack.list_cases",),
    "case new": ("glintrack.case.data_sheet.case_text",),
    "case schema": ("glintrack.core.designs.keys_of",),
    "dataset baseline": ("glintrack.dataset.score_baselines",),
    "dataset build": ("glintrack.dataset.plan_dataset", "glintrack.dataset.build_dataset"),
    "dataset label": ("glintrack.report.frames_page.write_label_page",),
    "device etalon": ("glintrack.devices.etalon.tabulate",),
    "device micromirror": (
        "glintrack.devices.micromirror.tabulate",
        "glintrack.devices.micromirror.model3d.superpixel_glb",
    ),
    "device wiregrid": ("glintrack.devices.wire_grid.response",),
    "optimize": ("glintrack.study.optimize.read_optimization", "glintrack.study.optimize.run_search"),
    "ortho": ("glintrack.rectify",),
    "polarimetry": ("glintrack.measure_polarization", "glintrack.sensor.read_analysers"),
    "render": ("glintrack.render.frame.render_product", "glintrack.render.frame.cube_blocks"),
    "report": ("glintrack.report.build_page",),
    "run": ("glintrack.run",),
    "scene build": ("glintrack.build_scene",),
    "scene export": ("glintrack.scene.glb",),
    "scene preview": ("glintrack.render.preview.preview",),
    "scene traffic": ("glintrack.scene.record_traffic", "glintrack.scene.write_recording"),
    "score": ("glintrack.score",),
    "sensor expose": ("glintrack.results.run.expose_view",),
    "sensor ghosts": ("glintrack.sensor.ghosts",),
    "sensor lens": ("glintrack.sensor.lens_quality",),
    "sensor list": ("glintrack.sensor.design_names", "glintrack.sensor.catalogue.read_catalogue"),
    "sensor show": ("glintrack.sensor.sensor.summary", "glintrack.assess_case"),
    "study report": ("glintrack.study.write_report",),
    "study run": ("glintrack.study.run_study",),
    "track": ("glintrack.track_detections", "glintrack.track_frames"),
    "video": ("glintrack.report.write_video",),
    "warm-up": ("glintrack.compile_kernels",),
    "view": ("glintrack.report.serve_result",),
}


def commands(command, path=""):
    """Name and function of every command."""
    if not getattr(command, "commands", None):
        return {path: command.callback}
    found = {}
    for name, inner in command.commands.items():
        found |= commands(inner, f"{path} {name}".strip())
    return found


CALLED = commands(load_program())


def public(name):
    """The object of a dotted name, in a module or in a class of one."""
    parts = name.split(".")
    for n in range(len(parts) - 1, 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:n]))
        except ModuleNotFoundError:
            continue
        for part in parts[n:]:
            found = getattr(found, part)
        return found
    raise AttributeError(name)


def names_used(module):
    """Every name and attribute that a module's functions mention."""
    nodes = list(ast.walk(ast.parse(inspect.getsource(module))))
    names = {n.id for n in nodes if isinstance(n, ast.Name)}
    attributes = {n.attr for n in nodes if isinstance(n, ast.Attribute)}
    imported = [alias for n in nodes if isinstance(n, ast.ImportFrom) for alias in n.names]
    renamed = {alias.name for alias in imported if alias.asname in names}  # `run as fly`
    return names | attributes | renamed


def test_every_command_is_named_here():
    assert sorted(CALLED) == sorted(WORK)


@pytest.mark.parametrize("command", WORK)
def test_the_work_of_a_command_is_a_public_function_that_it_calls(command):
    called = CALLED[command]
    assert called is not None
    module = inspect.getmodule(inspect.unwrap(called))
    assert module is not None
    for name in WORK[command]:
        work = public(name)
        assert callable(work) and inspect.getdoc(work)
        assert not work.__module__.startswith("glintrack.cli")
        assert not any(part.startswith("_") for part in name.split("."))
        assert work.__name__ in names_used(module), f"`{command}` does not call {name}"
