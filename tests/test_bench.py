"""`lodelight bench`: a table of medians out of runs in processes of their own."""

import json

import pytest

from lodelight.cli.bench import _cell
from lodelight.cli.main import main
from recordings import write_tum


def test_a_cell_is_the_median_with_its_range():
    runs = [{"ms_per_frame": {"mean": v}} for v in (12.0, 10.0, 30.0)]
    assert _cell(runs, ("ms_per_frame", "mean"), 1, 1) == "12.0 (10.0..30.0)"
    assert _cell(runs[:1], ("ms_per_frame", "mean"), 10, 0) == "120"
    assert _cell([{"ate": None}], ("ate", "final", "rmse_m"), 100, 2) == "-"


def test_runs_that_were_lost_throughout_are_reported_too(tmp_path, capsys):
    recording = write_tum(tmp_path / "grey")  # without a corner to track
    assert main(["bench", str(recording), "--runs", "1", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["machine"]["cores"] >= 1
    (metrics,) = result["runs"][str(recording)]
    assert metrics["tracked_fraction"] == 0.0
    assert metrics["frames"] == 6


@pytest.mark.parametrize("settings", [[], ["--set", "no.such=1"]])
def test_what_a_run_says_is_wrong_is_said_once(tmp_path, capsys, settings):
    recording = write_tum(tmp_path / "grey") if settings else tmp_path / "missing"
    assert main(["bench", str(recording), *settings]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "no.such" in err or "missing" in err
