"""Whether what is trained learns: every method, plain and sparsified."""

import csv

import pytest

from tests.cli.test_methods import METHODS


def column(path, name: str) -> list[float]:
    """The numbers of a curve, in the order of the steps."""
    with path.open() as file:
        return [float(row[name]) for row in csv.DictReader(file) if row.get(name)]


@pytest.mark.slow
@pytest.mark.parametrize("sparsify", ["none", "removal"])
@pytest.mark.parametrize("method", METHODS)
def test_training_and_held_out_views_improve(method: str, sparsify: str, run_train, tmp_path):
    out = run_train(
        tmp_path,
        f"method={method}",
        f"sparsify={sparsify}",
        "schedule.max_steps=300",
        "trainer.val_check_interval=30",
        "trainer.log_every_n_steps=5",
    )
    curves = out / "curves" / "metrics.csv"
    errors, held_out = column(curves, "train/photometric"), column(curves, "val/psnr")
    assert len(errors) >= 50
    assert len(held_out) == 10
    # Means over a sixth of the run: single steps see single images.
    assert sum(errors[-10:]) < 0.7 * sum(errors[:10])
    assert held_out[-1] > held_out[0] + 1
