"""The curves of a training, from files written by hand."""

import pytest

from sparsestreet.pictures import history
from sparsestreet.pictures.history import draw_history
from sparsestreet.records.curves import LEDGER, MASK, PRUNING, CountChange
from sparsestreet.records.run import RUN
from sparsestreet.records.strict_json import RecordError, write_atomically
from sparsestreet.training.callbacks import mask_training, pruning
from tests.evaluation.frames import make_run

CHANGES = [
    CountChange(0, "background", 0, 100, "seeds"),
    CountChange(0, "rigid", 0, 20, "seeds"),
    CountChange(10, "background", 100, 130, "densify"),
    CountChange(10, "background", 130, 120, "cull"),
    CountChange(20, "rigid", 20, 15, MASK),
    CountChange(20, "background", 120, 90, MASK),
    CountChange(30, "background", 90, 40, PRUNING),
]


@pytest.fixture
def drawn(monkeypatch):
    """What was handed to the plots, by the file's name."""
    calls = {}
    monkeypatch.setattr(history, "plot_counts", lambda path, *rest: calls.update({path.name: rest}))
    monkeypatch.setattr(history, "plot_psnr", lambda path, *rest: calls.update({path.name: rest}))
    return calls


def test_counts_stay_between_changes_and_events_are_marked(tmp_path, drawn):
    LEDGER.write(tmp_path, CHANGES)
    draw_history(tmp_path)
    steps, counts, events = drawn["counts.png"]
    assert steps == [0, 10, 20, 30]
    assert counts == {"background": [100, 120, 90, 40], "rigid": [20, 20, 15, 15]}
    assert events == [(20, "mask"), (30, "pruning")]
    assert "psnr.png" not in drawn


def test_the_callbacks_give_the_reasons_that_are_marked():
    assert set(history.MARKED) == {mask_training.REASON, pruning.REASON}


def test_psnr_is_taken_where_it_was_logged(tmp_path, drawn):
    LEDGER.write(tmp_path, CHANGES)
    (tmp_path / "curves").mkdir()
    (tmp_path / "curves" / "metrics.csv").write_text(
        "epoch,psnr,step,train/l1,val/psnr\n0,20.5,9,0.1,\n0,,9,,18.25\n1,21.5,19,0.1,\n"
    )
    draw_history(tmp_path)
    curves, events, title = drawn["psnr.png"]
    assert title == "PSNR over training"
    assert curves == {"training, running mean": ((9, 19), (20.5, 21.5)), "held out": ((9,), (18.25,))}
    assert events == [(20, "mask"), (30, "pruning")]


def test_held_out_views_are_drawn_over_seconds(tmp_path, drawn):
    (tmp_path / "curves").mkdir()
    (tmp_path / "curves" / "held_out.csv").write_text(
        "seconds,step,psnr_full,psnr_human,psnr_vehicle\n1.500,10,20.5,,19.5\n3.000,20,21.5,,20.0\n"
    )
    draw_history(tmp_path)
    curves, events, title, along = drawn["held_out.png"]
    assert curves == {"full image": ((1.5, 3.0), (20.5, 21.5)), "vehicles": ((1.5, 3.0), (19.5, 20.0))}
    assert (events, along) == ((), "seconds")
    assert "without evaluation" in title


def test_files_that_were_not_written_leave_their_picture_out(tmp_path, drawn):
    draw_history(tmp_path)
    (tmp_path / "curves").mkdir()
    (tmp_path / "curves" / "metrics.csv").write_text("epoch,step\n0,9\n")
    draw_history(tmp_path)
    assert drawn == {}


@pytest.mark.lengthy
def test_the_pictures_are_drawn(tmp_path):
    LEDGER.write(tmp_path, CHANGES)
    draw_history(tmp_path)
    assert (tmp_path / "curves" / "counts.png").read_bytes().startswith(b"\x89PNG")


def test_the_ledger_is_read_as_it_was_written(tmp_path):
    path = LEDGER.path(tmp_path)
    LEDGER.write(tmp_path, CHANGES)
    assert path == tmp_path / "records" / "counts.csv"
    assert path.read_text().splitlines()[:2] == ["step,node,before,after,reason", "0,background,0,100,seeds"]
    assert LEDGER.read(tmp_path) == CHANGES


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("step,node\n", r"counts\.csv: the header is"),
        ("", r"counts\.csv: the header is"),
        ("step,node,before,after,reason\n0,a,0,ten,seeds\n", r"counts\.csv, line 2: .*ten"),
        (
            "step,node,before,after,reason\n0,a,0,1,seeds\n1,a,0\n",
            r"counts\.csv, line 3: 3 cells, expected 5; train the run again",
        ),
    ],
)
def test_a_malformed_ledger_names_file_and_line(tmp_path, text, message):
    write_atomically(LEDGER.path(tmp_path), text)
    with pytest.raises(RecordError, match=message):
        LEDGER.read(tmp_path)


def test_a_curve_reaches_the_last_step_and_says_that_nothing_was_held_out(tmp_path, drawn):
    """The last change is at step 30 of 400, and validation never came."""
    LEDGER.write(tmp_path, CHANGES)
    RUN.write(tmp_path, make_run(steps=400))
    (tmp_path / "curves").mkdir()
    (tmp_path / "curves" / "metrics.csv").write_text("epoch,psnr,step\n0,20.5,9\n")
    draw_history(tmp_path)
    steps, counts, _ = drawn["counts.png"]
    assert (steps[-2:], counts["background"][-2:]) == ([30, 400], [40, 40])
    assert "no look at held-out views: trainer.val_check_interval" in drawn["psnr.png"][2]
