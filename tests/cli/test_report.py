"""The table on the command line."""

import json

import pytest

from sparsestreet.cli.commands.report import report
from sparsestreet.records.summary import SUMMARY
from tests.evaluation.frames import make_summary
from tests.report.sweep_folder import write_sweep


@pytest.fixture
def runs(tmp_path):
    """Two streets, one of them with two configurations."""
    for name, summary in {
        "a": make_summary("plain", scene="a"),
        "b": make_summary("plain", scene="b"),
        "removal_db=0.1": make_summary("ours", scene="a", config={"schedule.removal_db": 0.1}),
        "removal_db=0.2": make_summary("ours", scene="a", config={"schedule.removal_db": 0.2}),
    }.items():
        SUMMARY.write(tmp_path / name, summary)
    return tmp_path


def test_tables_are_printed_and_written(runs, tmp_path, capsys):
    table = tmp_path / "table.md"
    assert report([str(runs), "baseline=plain", f"markdown={table}"]) == 0
    text = table.read_text()
    assert text.count("### ") == 3
    assert "| ours schedule.removal_db=0.2 against plain |" in text
    assert "mean over scenes" in capsys.readouterr().out


def test_records_of_runs_are_kept_in_a_line_each(tmp_path, capsys):
    """All that a table shows, without a folder of the machine, whose runs may lie anywhere."""
    away = "sparsestreet train data.root=/home/me/drive out=~/x/run seed=3 data.a=[/k/l,/m/n] b=1/2"
    SUMMARY.write(tmp_path / "a/b", make_summary("plain", seed=3, training_psnr=28.25, milliseconds=41.5, command=away))
    SUMMARY.write(tmp_path / "c", make_summary("ours", gaussians={"background": 7}, psnr=24.125, vehicle_psnr=None))
    kept = tmp_path / "new/kept.jsonl"
    assert report([str(tmp_path), f"records={kept}"]) == 0
    assert f"{kept}: a line for each run" in capsys.readouterr().out
    assert len(kept.read_bytes()) < 2 * 4096
    first, second = (json.loads(line) for line in kept.read_text().splitlines())
    assert first["command"] == "sparsestreet train data.root=drive out=run seed=3 data.a=[l,n] b=1/2"
    assert (first["label"], first["seed"], first["frame_ms"]) == ("plain", 3, 41.5)
    assert (first["quality"]["training"]["psnr_full"], first["quality"]["held_out"]["psnr_vehicle"]) == (28.25, 22.0)
    assert (second["gaussians"], second["bytes_total"]) == ({"background": 7}, 4 * 59 * 7)
    assert second["quality"]["held_out"]["psnr_full"] == 24.125


@pytest.mark.lengthy
def test_the_report_of_a_sweep(tmp_path, capsys):
    """In the layout that the sweep's name asks for; with a figure where one is wanted."""
    sweep, picture = write_sweep(tmp_path), tmp_path / "time.png"
    (sweep / "multirun.yaml").write_text("hydra: {runtime: {choices: {sweep: table5_ablation}}}")
    assert report([f"sweep={sweep}", f"figure={picture}"]) == 0
    text = (sweep / "report" / "tables.md").read_text()
    assert "### Table 5 of the paper" in text
    assert "| w/o Node Pruning (not run) |" in text
    assert "streetgs+paper, seed 0: failed" in text
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert f"{sweep / 'report'}: tables.md" in capsys.readouterr().out
