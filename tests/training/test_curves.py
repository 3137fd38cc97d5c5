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


def test_without_a_file_there_is_nothing_to_keep(tmp_path):
    with kept_curves(tmp_path, resumed_at=15):
        pass
    assert list(tmp_path.iterdir()) == []
