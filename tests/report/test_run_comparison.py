"""Runs side by side, from their files."""

import numpy as np
import pytest
from PIL import Image

from sparsestreet.pictures.images import write_picture
from sparsestreet.records.summary import HELD_OUT, QUALITY, SUMMARY, TRAINING
from sparsestreet.report import run_comparison
from sparsestreet.report.run_comparison import compare_runs
from tests.evaluation.frames import make_image, make_summary
from tests.evaluation.tiles import COLORS, make_picture
from tests.pictures.test_sheets import LEGEND, order_of, row_within, written

__all__ = ["written"]


def write_run(folder, color, psnr, split=HELD_OUT, **summary):
    views = {"psnr": psnr} if split == HELD_OUT else {"psnr": None, "training_psnr": psnr}
    SUMMARY.write(folder, make_summary(**views, **summary))
    quality = [make_image(3, 1, psnr=psnr + 1)]
    QUALITY[split].write(folder, quality)
    write_picture(folder / "pictures", make_picture(render=color))
    return folder


def test_run_folders_make_a_sheet(tmp_path, written):
    """Each run shows its own renders, PSNR and size; shares are of the first run."""
    colors = {"plain": (10, 200, 10), "paper": (60, 180, 60), "removal": (10, 120, 10)}
    runs = [
        write_run(tmp_path / "plain", colors["plain"], 25.0, label="plain", caps={"background": 1000}),
        write_run(tmp_path / "paper", colors["paper"], 24.0, label="paper", gaussians={"background": 600}),
        write_run(tmp_path / "removal", colors["removal"], 24.5, label="removal", gaussians={"background": 300}),
    ]
    compare_runs(runs, tmp_path / "sheets" / "comparison.png", legend=LEGEND)
    with Image.open(tmp_path / "sheets" / "comparison.png") as image:
        sheet = np.asarray(image)
    assert sheet.shape[1] > 4 * 480
    assert order_of(sheet, row_within(sheet, colors["plain"])) == [COLORS["truth"], *colors.values()]
    for text in (
        *("street: PSNR over 6 held-out images", "plain, 25.00 dB", "paper, 24.00 dB", "removal, 24.50 dB"),
        *("error: 26.00 dB in this image", "error: 25.00 dB in this image", "error: 25.50 dB in this image"),
        *("1,200 Gaussians, held down by a cap", "600 Gaussians, 50 % of plain", "300 Gaussians, 25 % of plain"),
    ):
        assert text in written


def test_runs_of_one_label_are_told_apart(tmp_path, written):
    by_option = [
        write_run(tmp_path / str(value), COLORS["render"], 25.0, label="m", config={"x": value}) for value in (1, 2)
    ]
    compare_runs(by_option, tmp_path / "sheet.png")
    assert {"m x=1, 25.00 dB", "m x=2, 25.00 dB"} < set(written)
    by_seed = [write_run(tmp_path / str(seed), COLORS["render"], 25.0, label="m", seed=seed) for seed in (1, 2)]
    compare_runs(by_seed, tmp_path / "sheet.png")
    assert {"m (seed 1), 25.00 dB", "m (seed 2), 25.00 dB"} < set(written)


def test_what_cannot_be_compared_is_named(tmp_path):
    plain = write_run(tmp_path / "plain", COLORS["render"], 25.0)
    other = write_run(tmp_path / "other", COLORS["render"], 25.0, scene="kitti")
    with pytest.raises(ValueError, match="different scenes, kitti, street: compare runs of one scene"):
        compare_runs([plain, other], tmp_path / "sheet.png")
    QUALITY[HELD_OUT].write(other, [])
    with pytest.raises(ValueError, match=r"pictures of \(frame, camera\) \[\(3, 1\)\] and no quality of them"):
        compare_runs([other, other], tmp_path / "sheet.png")


def test_a_column_is_of_its_run(tmp_path, monkeypatch):
    """Two views of each; what is handed to the sheet, number by number."""
    drawn = []
    blank = np.zeros((2, 2, 3), dtype=np.uint8)
    monkeypatch.setattr(
        run_comparison, "comparison_sheet", lambda columns, **how: drawn.append((columns, how)) or blank
    )
    runs = []
    for place, name in enumerate(("plain", "ours")):
        run = write_run(
            tmp_path / name, COLORS["render"], 25.0 - place, label=name, gaussians={"a": 1200 - 900 * place}
        )
        write_picture(run / "pictures", make_picture(7))
        QUALITY[HELD_OUT].write(run, [make_image(7, 1, psnr=20.0 + place), make_image(3, 1, psnr=30.0 + place)])
        runs.append(run)
    compare_runs(runs, tmp_path / "sheet.png", legend=LEGEND)
    ((columns, how),) = drawn
    assert how == {"title": "street: PSNR over 6 held-out images", "legend": LEGEND}
    assert [(one.label, one.size) for one in columns] == [
        ("plain, 25.00 dB", "1,200 Gaussians"), ("ours, 24.00 dB", "300 Gaussians, 25 % of plain"),
    ]  # fmt: skip
    assert [[(one.frame, one.camera) for one in column.pictures] for column in columns] == [[(3, 1), (7, 1)]] * 2
    assert [column.psnr for column in columns] == [[30.0, 20.0], [31.0, 21.0]]
    compare_runs(runs[::-1], tmp_path / "sheet.png")
    assert drawn[1][0][1].size == "1,200 Gaussians, 400 % of ours"
    # One that holds out nothing beside one that does; nothing to be a share of.
    whole = write_run(tmp_path / "c", COLORS["render"], 30.0, TRAINING, label="c", gaussians={"x": 0, "y": 0})
    one = write_run(tmp_path / "d", COLORS["render"], 25.0, label="d", gaussians={"x": 3})
    compare_runs([whole, one], tmp_path / "sheet.png")
    columns, how = drawn[2]
    assert how["title"] == "street: PSNR over 6 training images"
    assert [column.label for column in columns] == ["c, 30.00 dB", "d, 25.00 dB"]
    assert (columns[0].psnr, columns[1].size) == ([31.0], "3 Gaussians, 300 % of c")
