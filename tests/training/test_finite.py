"""NaN and infinities stop a training in the step that shows them, with their names, and no checkpoint has them."""

import pytest
import torch

from sparsestreet.host_copy import HostCopy
from sparsestreet.training import nonfinite
from sparsestreet.training.callbacks import Checkpoints, step_of
from sparsestreet.training.nonfinite import LossWatch, NotFiniteError, not_finite
from tests.scene.street import frame_at
from tests.training.stubs import StubTrainer, background, make_system


@pytest.fixture
def system():
    return make_system({"background": background(5)})


def test_a_loss_that_is_not_finite_names_view_term_and_parameter(system):
    frame, names, watch = frame_at(2), ("photometric", "depth"), LossWatch()
    watch.look(names, torch.tensor([1.0, 2.0]), system.scene, frame, 7)
    broken = torch.tensor([1.0, float("inf")])
    with pytest.raises(NotFiniteError, match=r"step 8: the loss of frame 2, camera 0 is .*\(depth = inf\); all param"):
        watch.look(names, broken, system.scene, frame, 8)
    with torch.no_grad():
        system.scene.nodes["background"].rows.sh_dc[3, 0, 1] = torch.nan
    with pytest.raises(NotFiniteError, match=r"parameters: nodes\.background\.rows\.sh_dc row 3 \(1 of 5 rows\)"):
        watch.look(names, broken, system.scene, frame, 8)


class Late(torch.Tensor):
    """Numbers that say they lie on a GPU."""

    device = torch.device("cuda")


def test_on_a_device_a_loss_is_looked_at_one_step_later(system, monkeypatch):
    """What arrives is read at the next look, and when somebody settles; nothing is read twice."""
    monkeypatch.setattr(nonfinite, "copy_to_host", lambda values: HostCopy(values.as_subclass(torch.Tensor), None))
    values = {kind: torch.tensor([1.0, value]).as_subclass(Late) for kind, value in (("fine", 2.0), ("bad", torch.nan))}
    watch = LossWatch()
    watch.look(("a", "b"), values["fine"], system.scene, frame_at(1), 1)
    watch.look(("a", "b"), values["bad"], system.scene, frame_at(2), 2)
    with pytest.raises(NotFiniteError, match=r"step 2: the loss of frame 2, camera 0 .*\(b = nan\)"):
        watch.look(("a", "b"), values["fine"], system.scene, frame_at(3), 3)
    watch.settle()
    watch.look(("a", "b"), values["bad"], system.scene, frame_at(4), 4)
    with pytest.raises(NotFiniteError, match="step 4: the loss of frame 4"):
        watch.settle()
    watch.settle()


def test_opposite_infinities_and_sums_that_overflow():
    opposite = torch.tensor([1.0, float("inf"), float("-inf")])
    assert not_finite([("a", opposite)]) == ["a row 1 (2 of 3 rows)"]
    assert not_finite([("a", torch.full((4,), 3e38)), ("b", torch.zeros(0, 3)), ("c", torch.tensor(2.0))]) == []
    assert not_finite([("c", torch.tensor(torch.nan))]) == ["c row 0 (1 of 1 rows)"]


def test_no_checkpoint_holds_what_is_not_finite(tmp_path):
    trainer = StubTrainer(make_system({"background": background(5)}), [Checkpoints(tmp_path, 2)], max_steps=9)
    trainer.walk(1)
    trainer.walk(2)
    before = (tmp_path / "last.ckpt").read_bytes()
    with torch.no_grad():
        trainer.system.scene.nodes["background"].rows.means[4, 2] = float("-inf")
    trainer.walk(3)
    with pytest.raises(NotFiniteError, match=r"after step 4 .*nodes\.background\.rows\.means row 4"):
        trainer.walk(4)
    assert (tmp_path / "last.ckpt").read_bytes() == before


class Hostile:
    def __reduce__(self):
        return exec, ("raise SystemExit('it ran')",)


def test_a_checkpoint_with_an_object_in_it_is_refused(tmp_path):
    path = tmp_path / "last.ckpt"
    torch.save({"global_step": 3, "callbacks": {"evil": Hostile()}}, path)
    with pytest.raises(ValueError, match="what may run code, which is never opened"):
        step_of(path)
    torch.save({"global_step": 3, "state_dict": {"a": torch.zeros(2)}}, path)
    assert step_of(path) == 3
