"""``--require``: exit codes."""

import pytest
import typer

from glintrack.cli.require import exit_by
from glintrack.metrics.requirement import Assessment


@pytest.mark.parametrize(
    ("answers", "code"), [(["yes", "no", "undecided"], 1), (["yes", "undecided"], 3), (["yes"], 0), ([], 0)]
)
def test_exit_code_says_what_is_met(answers, code):
    judged = [Assessment(0.5, 0.4, 0.6, answer) for answer in answers]
    if code == 0:
        exit_by(judged)
        return
    with pytest.raises(typer.Exit) as raised:
        exit_by(judged)
    assert raised.value.exit_code == code
