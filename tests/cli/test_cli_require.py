"""``--require``: exit codes."""

import pytest
import typer

from glintrack.cli.options import check_answers


@pytest.mark.parametrize(
    ("answers", "code"), [(["yes", "no", "undecided"], 1), (["yes", "undecided"], 3), (["yes"], 0), ([], 0)]
)
def test_exit_code_says_what_is_met(answers, code):
    if code == 0:
        check_answers(answers)
        return
    with pytest.raises(typer.Exit) as raised:
        check_answers(answers)
    assert raised.value.exit_code == code
