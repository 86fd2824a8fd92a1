"""``glintrack study`` as a user meets it."""

import pyarrow.parquet
import pytest
from typer.testing import CliRunner

from glintrack.cli import study as study_command
from glintrack.cli.app import app, main
from tests.study.cases import TWELVE, cheap, write_study


@pytest.fixture
def cheap_cases(monkeypatch):
    whole = study_command.studies.run_study

    def run(plan, folder, pool, cache, callback):
        cache.mkdir(exist_ok=True)
        return whole(plan, folder, pool, cache, cheap, callback)

    monkeypatch.setattr(study_command.studies, "run_study", run)


def invoke(*arguments):
    return CliRunner().invoke(app, ["study", *map(str, arguments)])


def test_a_study_is_flown_resumed_and_reported(tmp_path, cheap_cases):
    study, out, cache = write_study(tmp_path, TWELVE), tmp_path / "out", tmp_path / "cache"
    first = invoke(study, "-o", out, "--serial", "--cache", cache)
    assert first.exit_code == 0, first.output
    assert "12 of 12 cases to simulate" in first.output and "12 of 12 cases finished" in first.output.replace(
        "\n", " "
    )
    again = invoke(study, "-o", out, "--serial", "--cache", cache)
    assert "0 of 12 cases to simulate" in again.output and "frames per second and core" in again.output
    told = invoke("report", out)
    assert told.exit_code == 0, told.output
    assert "sensor.pitch_um" in told.output and "wrote" in told.output
    report = {p.name for p in (out / "report").iterdir()}
    assert {f"{name}.csv" for name in ("effects", "interactions", "contrasts", "pareto")} <= report
    assert {"effects.parquet", "pareto.png"} <= report
    assert {"effects_completeness.png", "effects_completeness.pdf", "contrasts_purity.png"} <= report


def test_requirements_judge_every_point(tmp_path, cheap_cases, monkeypatch):
    out = tmp_path / "out"
    study = write_study(tmp_path, TWELVE)
    met = invoke(study, "-o", out, "--serial", "--cache", tmp_path / "cache", "--require", "completeness>=0")
    assert met.exit_code == 0, met.output
    assert "completeness >= 0 (" in met.output and met.output.count("yes") >= 2
    reads, read_table = [], pyarrow.parquet.read_table
    monkeypatch.setattr(pyarrow.parquet, "read_table", lambda *a, **k: reads.append(a) or read_table(*a, **k))
    missed = invoke("report", out, "--require", "completeness>=1")
    assert missed.exit_code == 1, missed.output
    assert len(reads) == 1
    strange = invoke("report", out, "--require", "all.completeness>=0.5")
    assert strange.exit_code != 0 and "`--require` must name a channel" in str(strange.exception)


def test_a_dry_run_writes_nothing(tmp_path):
    out, cache = tmp_path / "out", tmp_path / "cache"
    told = invoke(write_study(tmp_path, TWELVE), "-o", out, "--dry-run", "--cache", cache)
    assert told.exit_code == 0, told.output
    for word in ("cases", "12 to simulate", "frames", "96", "time", "disk", "nothing written"):
        assert word in told.output
    assert not out.exists() and not cache.exists()


@pytest.mark.parametrize(
    ("given", "expected"), [("1", "96 (96 designs)"), ("2", "192 (96 designs × 2 replicates)")]
)
def test_a_dry_run_counts_the_replicates_asked_for(given, expected, tmp_path):
    done = invoke("ranks", "--replicates", given, "--dry-run", "-o", tmp_path / "out")
    assert done.exit_code == 0 and expected in done.output


def test_failed_cases_are_told_and_the_exit_code_says_so(tmp_path, cheap_cases):
    study = write_study(tmp_path, "[axes]\nsensor.read_noise_e = [20, 13]\n")
    told = invoke(study, "-o", tmp_path / "out", "--serial", "--cache", tmp_path / "cache")
    assert told.exit_code == 1
    assert "the optics fell off" in told.output and "1 cases failed" in told.output


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["none.toml"], "`study` must be a readable file; got none.toml"),
        (["bad.toml"], "Did you mean `pitch_um`?"),
        (["good.toml", "--serial", "--workers", "2"], "`--serial` must not be given"),
        (["report", "."], "`result` must be the folder of a study"),
        (["quickstart", "--dry-run"], "got the case quickstart. Run `glintrack run quickstart`"),
        (["mine.toml"], "got the case mine.toml. Run `glintrack run mine.toml`"),
        (["good.toml", "-o", "other"], "must be the folder of a study"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(tmp_path, monkeypatch, capsys, arguments, complaint):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "good.toml").write_text("[axes]\nsensor.pitch_um = [17, 8.5]\n")
    (tmp_path / "bad.toml").write_text("[axes]\nsensor.pich_um = [17]\n")
    (tmp_path / "mine.toml").write_text('like = "quickstart"\nchannels = ["pan"]\n')
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").write_text("")
    monkeypatch.setattr("sys.argv", ["glintrack", "study", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr().err
    assert ended.value.code == 2 and complaint in said and said.count("\n") == 1


def test_an_axis_that_changes_the_field_is_told_before_it_is_flown(tmp_path):
    told = invoke(write_study(tmp_path, TWELVE), "-o", tmp_path / "out", "--dry-run")
    said = "`sensor.pitch_um` changes the field too"
    assert said in told.output and "constraints.constant_field = true" in told.output
    held = write_study(tmp_path, TWELVE.replace("[axes]", "[constraints]\nconstant_field = true\n[axes]"))
    assert said not in invoke(held, "-o", tmp_path / "out", "--dry-run").output


def test_flights_too_short_to_say_anything_are_told_before_they_are_flown(tmp_path):
    said = "a flight of 2 frames at 2 Hz is too short for a tracker"
    short = TWELVE.replace("[axes]", "[base]\nflight.frames = 2\n[axes]")
    assert said in invoke(write_study(tmp_path, short), "-o", tmp_path / "out", "--dry-run").output
    enough = TWELVE.replace("[axes]", "[base]\nflight.frames = 12\n[axes]")
    told = invoke(write_study(tmp_path, enough), "-o", tmp_path / "out", "--dry-run")
    assert told.exit_code == 0 and "says little" not in told.output


@pytest.mark.parametrize("name", ["table1", "standard", "polarization", "polarization_fine"])  # ranks: above
def test_packaged_studies_are_valid(name, tmp_path):
    told = invoke(name, "--dry-run", "-o", tmp_path / "out", "--cache", tmp_path / "cache")
    assert told.exit_code == 0, told.output
