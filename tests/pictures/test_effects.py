"""The picture of a run's effects is drawn from its records alone."""

from dataclasses import replace
from pathlib import Path

from PIL import Image

from sparsestreet.pictures.effects import draw_effects
from sparsestreet.records.costs import EffectGain, update_costs
from sparsestreet.records.run import RUN
from tests.evaluation.frames import make_summary
from tests.report.test_costs import LENS


def height(run: Path) -> int:
    with Image.open(run / "pictures" / "effects.png") as image:
        return image.height


def test_a_row_for_each_effect(tmp_path):
    run = replace(make_summary("m").run, effects=(LENS,))
    RUN.write(tmp_path, run)
    draw_effects(tmp_path)
    assert not (tmp_path / "pictures").exists()  # nothing was measured
    update_costs(tmp_path, effects={"lens": 0.5}, gains={"lens": EffectGain(2.0, None, None, 4)})
    draw_effects(tmp_path)
    one = height(tmp_path)
    RUN.write(tmp_path, replace(run, effects=(LENS, replace(LENS, name="sky", on=False))))
    draw_effects(tmp_path)
    assert height(tmp_path) > one


def test_a_run_without_a_plan_gets_none(tmp_path):
    RUN.write(tmp_path, make_summary("m").run)
    update_costs(tmp_path, effects={"sky": 0.5})
    draw_effects(tmp_path)
    assert not (tmp_path / "pictures").exists()
