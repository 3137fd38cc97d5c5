"""Images that are measured by several processes have the numbers that one process finds, bit for bit."""

from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from lightning import Callback, Trainer

from sparsestreet.data.datamodule import StreetData
from sparsestreet.evaluation import evaluate
from sparsestreet.evaluation.run import help_to_evaluate
from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.records.costs import COSTS
from sparsestreet.records.summary import HELD_OUT, QUALITY, TRAINING, RunSummary
from sparsestreet.training.run import CPU_TRAINER, fit
from tests.conftest import unchecked
from tests.evaluation.dark import evaluate as evaluated
from tests.evaluation.dark import make_frames
from tests.evaluation.scenes import OPTIONS, small_scene
from tests.training.parallel.several import PATIENCE, several, trainers
from tests.training.parallel.street import data, system

pytestmark = pytest.mark.lengthy
SIZE = 3
HELD, SEEN = 5, 4
"""Images of both splits: no multiples of the processes."""


def measure(folder: Path, ranks: Ranks = ALONE) -> RunSummary | None:
    held_out, training = make_frames(HELD), make_frames(SEEN, first=1)
    if ranks.rank == 0:
        return evaluated(folder, held_out, training, ranks=ranks)
    help_to_evaluate(
        small_scene(), tuple(held_out), tuple(training), options=OPTIONS, out=folder, device="cpu", ranks=ranks
    )
    return None


def of_images(folder: Path) -> dict[str, Any]:
    """All that does not depend on time."""
    predictions = {path.name: path.read_bytes() for path in (folder / "predictions" / HELD_OUT).iterdir()}
    pictures = {path.name: path.read_bytes() for path in (folder / "pictures").iterdir()}
    quality = {split: (folder / QUALITY[split].name).read_bytes() for split in (HELD_OUT, TRAINING)}
    return {"predictions": predictions, "pictures": pictures, "quality": quality, "gains": COSTS.read(folder).gains}


def talk(folder: Path, rank: int) -> dict[str, Any]:
    """A whole evaluation; then one in which the render of a process is not finite."""
    dist.init_process_group("gloo", rank=rank, world_size=SIZE, timeout=timedelta(seconds=PATIENCE))
    ranks, measured = Ranks(rank, SIZE), []
    quality = evaluate._quality
    evaluate._quality = lambda pixels, frame, *rest: measured.append(frame.indices) or quality(pixels, frame, *rest)
    with unchecked():
        summary = measure(folder / f"{rank}", ranks)
    said = {"measured": measured[:], "images": summary and summary.images, "files": (folder / f"{rank}").exists()}
    if rank == 1:
        evaluate.screen_image = _not_finite
    try:
        list(evaluate.evaluate_frames(small_scene(), make_frames(HELD), OPTIONS, ranks=ranks))
    except ValueError as error:
        said["error"] = str(error)
    return said


def _not_finite(scene: Any, view: Any, options: Any) -> Any:
    raise ValueError(f"the render of frame {view.frame_index} has NaN")


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    folder = tmp_path_factory.mktemp("evaluated")
    return folder, several(SIZE, partial(talk, folder), folder)


def test_the_first_process_writes_what_one_process_writes(answers, tmp_path):
    folder, said = answers
    with unchecked():
        one = measure(tmp_path)
    assert of_images(folder / "0") == of_images(tmp_path)
    assert said[0]["images"] == one.images == {HELD_OUT: HELD, TRAINING: SEEN}
    assert [answer["files"] for answer in said] == [True, False, False]


def test_each_process_measures_its_share(answers):
    """Of 5 and 4 images, and 5 once more without the sky."""
    measured = [answer["measured"] for answer in answers[1]]
    assert [len(images) for images in measured] == [2 + 2 + 2, 2 + 1 + 2, 1 + 1 + 1]
    assert len({image for images in measured for image in images}) == HELD + SEEN


def test_a_render_that_is_not_finite_is_an_error_of_all(answers):
    assert [answer["error"] for answer in answers[1]] == ["the render of frame 10 has NaN"] * SIZE


class Curve(Callback):
    """What each validation logged, and on how many images of its own a process looked."""

    def __init__(self) -> None:
        self.logged: list[dict[str, float]] = []
        self.images: list[int] = []

    def on_validation_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, *place: Any) -> None:
        self.images.append(batch.frame_index)

    def on_validation_end(self, trainer: Trainer, pl_module: Any) -> None:
        if not trainer.sanity_checking:
            self.logged.append({name: float(value) for name, value in trainer.callback_metrics.items()
                                if name.startswith("val/")})  # fmt: skip


def curve(folder: Path, make_trainer: Any, stride: int) -> Curve:
    seen = Curve()
    street = StreetData(data().driving_log, stride=stride, offset=0)
    fit(system(), street, [seen], make_trainer, folder, max_steps=12)
    return seen


@pytest.mark.parametrize(("stride", "shares"), [(2, [{0, 4}, {2, 6}]), (7, [{0}, {0}])])
def test_validation_is_shared(stride, shares, tmp_path):
    """Where there are as many images as processes; the means are those of one process, in all."""
    found = several(
        2,
        lambda rank: vars(curve(tmp_path, trainers(2, limit_val_batches=1.0, val_check_interval=3), stride)),
        tmp_path,
    )
    one = curve(tmp_path, partial(CPU_TRAINER, accumulate_grad_batches=2, val_check_interval=6), stride)
    assert len(one.logged) == 2
    assert [each["logged"] for each in found] == [one.logged] * 2
    assert [set(each["images"]) for each in found] == shares
    assert torch.tensor([look["val/psnr"] for look in one.logged]).isfinite().all()
