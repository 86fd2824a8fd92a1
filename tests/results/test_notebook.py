"""A run in a notebook shows a progress bar below its cell, and elsewhere nothing."""

import builtins
import sys
from types import SimpleNamespace

import pytest

from glintrack import Case
from glintrack.core.progress import step
from glintrack.results import run as functions


class Stop(Exception):
    """End of the run before anything is written."""


@pytest.fixture
def run_two_frames(monkeypatch, tmp_path):
    """Function that runs two frames of two channels and stops."""

    def simulate(case, callback, **options):
        with step("building <the city>"):
            pass
        for frame in (0, 0, 1, 1):
            callback(SimpleNamespace(index=frame))
        raise Stop

    monkeypatch.setattr(functions, "simulate", simulate)
    monkeypatch.setattr(functions.Recorder, "record", lambda self, epoch: None)
    monkeypatch.setattr(functions.FlightBudget, "measure", lambda self, epoch: None)

    def run():
        with pytest.raises(Stop):
            functions.run(Case().replace({"flight.frames": 2}), tmp_path / "result")

    return run


def test_a_notebook_shows_steps_and_frames(monkeypatch, run_two_frames):
    shown = []
    handle = SimpleNamespace(update=shown.append)
    display = SimpleNamespace(HTML=str, display=lambda text, display_id: handle)
    shell = type("ZMQInteractiveShell", (), {})()  # that of a notebook's kernel
    monkeypatch.setattr(builtins, "get_ipython", lambda: shell, raising=False)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    run_two_frames()
    done = [text.partition("</progress> ")[2].strip() for text in shown]
    start, step_text, *rest = done
    assert (start, step_text) == ("0 of 2 frames", "0 of 2 frames building &lt;the city&gt;")
    assert rest == ["0 of 2 frames", "1 of 2 frames", "2 of 2 frames"]
    assert '<progress value="2" max="2">' in shown[-1]


def test_a_program_needs_no_notebook(monkeypatch, run_two_frames):
    monkeypatch.setitem(sys.modules, "IPython.display", None)  # an import would fail
    run_two_frames()
