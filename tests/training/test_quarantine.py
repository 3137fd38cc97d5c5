"""A gradient that is not finite: rows of a node rest and are counted, and what is more than that ends the run."""

import logging

import pytest
import torch

from sparsestreet.host_copy import HostCopy
from sparsestreet.training import nonfinite
from sparsestreet.training.adam import RefusedRows, RowAdam
from sparsestreet.training.callbacks import Checkpoints
from sparsestreet.training.nonfinite import FEW, SHARE, NotFiniteError, Quarantine
from sparsestreet.training.optimizer import OptimizerSettings
from tests.training.stubs import background, fit, frame_at, make_system, rigid
from tests.training.test_finite import Late

MEANS = "nodes.background.rows.means"


def broken(system, column: str, row: int, at_step: int, value: float = torch.nan) -> None:
    """Let one number of a column's gradient be no number in one step (from 1)."""

    def spoil(gradient: torch.Tensor) -> torch.Tensor:
        if system.global_step + 1 != at_step:
            return gradient
        gradient = gradient.clone()
        gradient.view(len(gradient), -1)[row, 0] = value
        return gradient

    system.scene.get_parameter(column).register_hook(spoil)


@pytest.mark.parametrize("visible_only", [False, True])
def test_a_row_rests_for_the_step_and_is_named_once(visible_only, caplog, tmp_path):
    """All others end as they do without it, for rows touch each other only through the image: so in one step."""
    ends, counts = {}, {}
    for name in ("fine", "broken"):
        system = make_system({"background": background(20)}, optimizer=OptimizerSettings(visible_only=visible_only))
        start = system.scene.nodes["background"].rows.means.detach().clone()
        if name == "broken":
            broken(system, MEANS, 7, at_step=1, value=float("-inf"))
        with caplog.at_level(logging.WARNING):
            trainer = fit(system, [Checkpoints(tmp_path / name)], 1, frame_at(2))
        ends[name], counts[name] = system.scene.nodes["background"].rows.means.detach(), dict(system.quarantine.counts)
        moments = trainer.optimizers[0].state[system.scene.nodes["background"].rows.means]
    others = torch.arange(20) != 7
    assert torch.equal(ends["broken"][7], start[7])
    assert not torch.equal(ends["fine"][7], start[7])
    assert torch.equal(ends["broken"][others], ends["fine"][others])
    assert moments["exp_avg"][7].tolist() == [0, 0, 0]
    assert counts == {"fine": {}, "broken": {"background.means": 1}}
    said = [record.message for record in caplog.records if "not finite" in record.message]
    assert said == [
        "step 1, frame 2, camera 0: gradients are not finite: nodes.background.rows.means row 7 (1 of 20 rows). Such "
        "rows do not step; all are counted, and said at the end"
    ]
    checkpoint = torch.load(tmp_path / "broken" / "last.ckpt", weights_only=True)
    assert checkpoint["quarantined"] == {"background.means": 1}
    system.quarantine.counts = {}
    system.on_load_checkpoint(checkpoint)
    assert system.quarantine.counts == {"background.means": 1}


def test_a_later_row_is_counted_and_not_said_again(caplog):
    system = make_system({"background": background(20)})
    for step, row in ((1, 3), (2, 4), (3, 4)):
        broken(system, MEANS, row, at_step=step)
    with caplog.at_level(logging.WARNING):
        fit(system, [], 3, frame_at(2))
    assert system.quarantine.counts == {"background.means": 3}
    assert caplog.text.count("gradients are not finite") == 1


def refused(parameters: list[torch.Tensor], counts: list[list[int]]) -> RefusedRows:
    return RefusedRows(tuple(parameters), torch.tensor(counts))


def look(quarantine: Quarantine, rows: int, count: int, name: str = MEANS) -> None:
    parameter = torch.zeros(rows, 3)
    quarantine.look(refused([parameter], [[count, 0]]), [(name, parameter)], frame_at(2), 5)


@pytest.mark.parametrize(("rows", "most"), [(50, FEW), (5000, int(5000 * SHARE))])
def test_more_rows_than_the_share_end_the_run(rows, most):
    quarantine = Quarantine()
    look(quarantine, rows, most)
    assert quarantine.counts == {"background.means": most}
    said = rf"step 5, frame 2, camera 0: gradients are not finite: {MEANS} row 0 \({most + 1} of {rows:,} rows\)"
    with pytest.raises(NotFiniteError, match=said):
        look(quarantine, rows, most + 1)


@pytest.mark.parametrize("name", ["nodes.rigid.rotation_deltas", "effects.sky.texels", "nodes.body.field.0.weight"])
def test_what_is_no_row_of_a_node_ends_the_run(name):
    with pytest.raises(NotFiniteError, match=rf"{name} row 0 .*or no rows of a node.*newest checkpoint"):
        look(Quarantine(), 5, 1, name)


def test_a_pose_whose_gradient_is_not_finite_ends_the_run_and_stays_as_it_was(tmp_path):
    system = make_system({"rigid": rigid(10)})
    deltas = system.scene.get_parameter("nodes.rigid.translation_deltas")
    deltas.register_hook(lambda gradient: torch.full_like(gradient, torch.nan))
    with pytest.raises(NotFiniteError, match=r"step 1, .*nodes\.rigid\.translation_deltas row 0"):
        fit(system, [Checkpoints(tmp_path)], 3, frame_at(2))
    assert bool(deltas.isfinite().all())
    assert list(tmp_path.iterdir()) == []


def test_on_a_device_counts_are_read_one_step_later(monkeypatch):
    monkeypatch.setattr(nonfinite, "copy_to_host", lambda values: HostCopy(values.as_subclass(torch.Tensor), None))
    watched, parameter = Quarantine(), torch.zeros(50, 3)

    def late(count: int, step: int) -> None:
        counts = torch.tensor([[count, 7]]).as_subclass(Late)
        watched.look(RefusedRows((parameter,), counts), [(MEANS, parameter)], frame_at(step), step)

    late(2, 1)
    assert watched.counts == {}
    late(0, 2)
    assert watched.counts == {"background.means": 2}
    late(11, 3)
    with pytest.raises(NotFiniteError, match="step 3, frame 3"):
        late(0, 4)
    late(1, 4)
    watched.settle()
    watched.settle()
    assert watched.counts == {"background.means": 3}


def test_names_follow_parameters_that_are_replaced():
    quarantine, first, second = Quarantine(), torch.zeros(50, 3), torch.zeros(60, 3)
    quarantine.look(refused([first], [[1, 0]]), [(MEANS, first)], frame_at(1), 1)
    quarantine.look(refused([second], [[1, 0]]), [("nodes.rigid.rows.means", second)], frame_at(1), 2)
    assert quarantine.counts == {"background.means": 1, "rigid.means": 1}


def test_wide_rows_step_by_numbers():
    """A face of a sky does not rest for one texel."""
    texels = torch.nn.Parameter(torch.zeros(6, 16, 16, 3))
    optimizer = RowAdam([{"params": [texels], "lr": 0.1}])
    texels.grad = torch.ones_like(texels)
    texels.grad[2, 3, 4, 1] = torch.nan
    optimizer.step()
    assert int((texels == 0).sum()) == 1
    assert optimizer.refused is not None
    assert optimizer.refused.counts.tolist() == [[1, 2 * 768 + 3 * 48 + 4 * 3 + 1]]


def test_steps_of_an_older_checkpoint_come_to_the_host():
    """torch's fused Adam keeps them where the parameter is."""
    parameter = torch.nn.Parameter(torch.ones(3))
    older = torch.optim.Adam([parameter], lr=0.1, fused=True)
    parameter.grad = torch.ones(3)
    older.step()
    optimizer = RowAdam([{"params": [parameter], "lr": 0.1}])
    optimizer.load_state_dict(older.state_dict())
    assert optimizer.param_groups[0]["fused"] is None
    assert optimizer.state[parameter]["step"].device.type == "cpu"
    optimizer.step()
    assert float(optimizer.state[parameter]["step"]) == 2
