"""A metrics.csv that a logger begins anew, kept together."""

from pathlib import Path

import pytest

from sparsestreet.training.curves import kept_curves


def write(path: Path, text: str) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)


@pytest.mark.parametrize("resumed_at", [20, 29])
def test_rows_before_the_checkpoint_stay_and_the_later_ones_are_the_new(tmp_path, resumed_at):
    """The step at which a run goes on is taken again."""
    path = tmp_path / "curves" / "metrics.csv"
    write(path, "psnr,step\n10,9\n11,19\n12,29\n")
    with kept_curves(tmp_path, resumed_at=resumed_at):
        write(path, "psnr,step,val/psnr\n22,29,\n,30,25\n")
    assert path.read_text() == "psnr,step,val/psnr\n10,9,\n11,19,\n22,29,\n,30,25\n"


def test_a_new_run_begins_a_new_file(tmp_path):
    path = tmp_path / "curves" / "metrics.csv"
    write(path, "psnr,step\n10,9\n")
    with kept_curves(tmp_path, resumed_at=None):
        write(path, "psnr,step\n20,9\n")
    assert path.read_text() == "psnr,step\n20,9\n"


def test_they_stay_where_training_stops_again_before_it_logs(tmp_path):
    path = tmp_path / "curves" / "metrics.csv"
    write(path, "psnr,step\n10,9\n")
    with pytest.raises(SystemExit), kept_curves(tmp_path, resumed_at=15):
        path.unlink()
        raise SystemExit
    assert path.read_text() == "psnr,step\n10,9\n"


def test_a_kill_while_a_run_goes_on_takes_no_row(tmp_path):
    """Twice: before Lightning begins its file anew, and when it has logged."""
    path = tmp_path / "curves" / "metrics.csv"
    write(path, "psnr,step\n10,9\n11,19\n")
    killed = kept_curves(tmp_path, resumed_at=15)
    killed.__enter__()
    again = kept_curves(tmp_path, resumed_at=15)
    again.__enter__()
    write(path, "psnr,step,val/psnr\n21,19,\n,20,25\n22,29,\n")
    with kept_curves(tmp_path, resumed_at=25):
        write(path, "psnr,step\n32,29\n")
    assert path.read_text() == "psnr,step,val/psnr\n10,9,\n21,19,\n,20,25\n32,29,\n"
    assert [each.name for each in path.parent.iterdir()] == [path.name]


def test_without_a_file_there_is_nothing_to_keep(tmp_path):
    with kept_curves(tmp_path, resumed_at=15):
        pass
    assert list(tmp_path.iterdir()) == []
