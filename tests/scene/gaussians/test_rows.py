import pytest
import torch

from sparsestreet.scene.gaussians import RowPlan, Rows
from tests.scene.street import random_rows, static_mask

MASK = static_mask()


def trained(count: int = 6, steps: int = 3) -> tuple[Rows, torch.optim.Adam]:
    """Rows after a few Adam steps with gradients that differ in every entry."""
    rows = random_rows(count, 0, mask=MASK, instances=torch.arange(count) % 3)
    groups = [{"params": [parameter], "name": name} for name, parameter in rows.named_parameters()]
    optimizer = torch.optim.Adam(groups, lr=0.01, eps=1e-15)
    generator = torch.Generator().manual_seed(1)
    for _ in range(steps):
        for parameter in rows.parameters():
            parameter.grad = torch.randn(parameter.shape, generator=generator)
        optimizer.step()
    return rows, optimizer


def snapshot(rows: Rows, optimizer: torch.optim.Adam) -> tuple[dict, dict, dict]:
    values = {name: column.detach().clone() for name, column in rows.columns().items()}
    first = {name: optimizer.state[p]["exp_avg"].clone() for name, p in rows.named_parameters()}
    second = {name: optimizer.state[p]["exp_avg_sq"].clone() for name, p in rows.named_parameters()}
    return values, first, second


def test_values_moments_and_buffers_follow_their_rows():
    rows, optimizer = trained()
    values, first, second = snapshot(rows, optimizer)
    source = torch.tensor([5, 0, 0, 3])
    fresh = torch.tensor([False, False, True, False])
    new_means = torch.full((4, 3), 7.0)
    plan = RowPlan(6, source, fresh, {"means": new_means}, frozenset({"opacity_logits"}), frozenset({"sh_dc"}))
    rows.resize(plan, optimizer)
    assert len(rows) == 4
    for name, column in rows.columns().items():
        for new, old in enumerate(source.tolist()):
            expected = new_means[new] if name == "means" else values[name][old]
            assert torch.equal(column[new], expected), name
    for name, parameter in rows.named_parameters():
        state = optimizer.state[parameter]
        for new, old in enumerate(source.tolist()):
            zeroed = fresh[new] or name == "opacity_logits"
            for key, before in (("exp_avg", first), ("exp_avg_sq", second)):
                inherited = (name, key) == ("sh_dc", "exp_avg_sq")
                expected = torch.zeros_like(before[name][old]) if zeroed and not inherited else before[name][old]
                assert torch.equal(state[key][new], expected), (name, key)
        assert float(state["step"]) == 3
    assert len(optimizer.state) == sum(1 for _ in rows.parameters())
    held = {id(p) for group in optimizer.param_groups for p in group["params"]}
    assert held == {id(p) for p in rows.parameters()}


def test_training_goes_on_as_if_removed_rows_had_never_been():
    """Adam works entry by entry: what is kept must take the same path with and without the others."""
    rows, optimizer = trained()
    alone, alone_optimizer = trained()
    kept = torch.tensor([True, False, True, True, False, True])
    rows.resize(RowPlan.keep(kept), optimizer)
    generator = torch.Generator().manual_seed(9)
    for (_, small), (_, large) in zip(rows.named_parameters(), alone.named_parameters(), strict=True):
        large.grad = torch.randn(large.shape, generator=generator)
        small.grad = large.grad[kept].clone()
    optimizer.step()
    alone_optimizer.step()
    for name, column in rows.columns().items():
        assert torch.equal(column, alone.columns()[name][kept]), name


def test_a_frozen_column_stays_frozen_and_out_of_the_optimizer():
    rows = random_rows(6, 0, mask=MASK)
    rows.means.requires_grad_(False)
    trainable = [parameter for parameter in rows.parameters() if parameter.requires_grad]
    optimizer = torch.optim.Adam(trainable)
    means = rows.means.clone()
    rows.resize(RowPlan(6, torch.tensor([5, 0, 3]), torch.tensor([False, True, False])), optimizer)
    assert not rows.means.requires_grad
    assert torch.equal(rows.means, means[[5, 0, 3]])
    assert all(parameter.requires_grad for name, parameter in rows.named_parameters() if name != "means")
    assert all(rows.means is not held for group in optimizer.param_groups for held in group["params"])
    # Also through a checkpoint, of another length or of the same.
    for count in (3, 8):
        rows.load_state_dict(random_rows(count, 1, mask=MASK).state_dict())
        assert len(rows) == count
        assert [name for name, parameter in rows.named_parameters() if not parameter.requires_grad] == ["means"]


def test_resizing_before_the_first_step_and_without_optimizer():
    rows = random_rows(3, 0)
    optimizer = torch.optim.Adam(rows.parameters())
    rows.resize(RowPlan.keep(torch.tensor([True, False, True])), optimizer)
    rows.resize(RowPlan.keep(torch.tensor([True, False])))
    assert len(rows) == 1


def test_all_rows_may_go():
    rows, optimizer = trained()
    rows.resize(RowPlan.keep(torch.zeros(6, dtype=torch.bool)), optimizer)
    assert len(rows) == 0
    for parameter in rows.parameters():
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()


def test_an_unknown_edit_changes_nothing():
    rows, optimizer = trained()
    before = snapshot(rows, optimizer)[0]
    source, fresh = torch.tensor([0]), torch.tensor([False])
    edit = RowPlan(6, source, fresh, {"mean": torch.zeros(1, 3)})
    for plan in (edit, RowPlan(6, source, fresh, inherited_second_moments=frozenset({"mean"}))):
        with pytest.raises(KeyError, match="mean"):
            rows.resize(plan, optimizer)
    assert all(torch.equal(column, before[name]) for name, column in rows.columns().items())


def test_an_edit_of_the_wrong_length_is_an_error():
    rows = random_rows(3, 0)
    for shape in ((2, 3), (1, 4)):
        with pytest.raises(ValueError, match="edit of 'means' has shape"):
            rows.resize(RowPlan(3, torch.tensor([0]), torch.tensor([False]), {"means": torch.zeros(shape)}))
    assert len(rows) == 3


def test_a_stale_plan_is_refused():
    with pytest.raises(ValueError, match="made for 2 rows, the table has 3"):
        random_rows(3, 0).resize(RowPlan.keep(torch.tensor([True, False])))


def test_a_plan_names_rows_that_exist():
    with pytest.raises(ValueError, match="sources -1 to 2"):
        RowPlan(3, torch.tensor([-1, 2]), torch.tensor([False, False]))


def test_a_foreign_optimizer_is_refused():
    _rows, optimizer = trained()
    with pytest.raises(ValueError, match="does not hold"):
        random_rows(3, 0).resize(RowPlan.keep(torch.ones(3, dtype=torch.bool)), optimizer)


def test_a_checkpoint_brings_its_rows_and_whether_masks_are_left():
    finished = random_rows(5, 0, mask=MASK)
    finished.drop_column("mask_logits")
    fresh = random_rows(3, 1, mask=MASK)
    fresh.load_state_dict(finished.state_dict())
    assert len(fresh) == 5
    assert "mask_logits" not in fresh.columns()
    assert torch.equal(fresh.means, finished.means)


def test_a_checkpoint_of_another_column_shape_is_refused():
    state = random_rows(3, 0).state_dict()
    state["means"] = torch.zeros(3, 4)
    with pytest.raises(RuntimeError, match="size mismatch for means"):
        random_rows(3, 0).load_state_dict(state)


def test_columns_of_different_lengths_are_an_error():
    with pytest.raises(ValueError, match="same number of rows"):
        Rows({"means": torch.zeros(2, 3), "opacity_logits": torch.zeros(3)})


def test_a_dropped_column_leaves_the_optimizer():
    rows, optimizer = trained()
    logits = rows.mask_logits
    rows.drop_column("mask_logits", optimizer)
    assert "mask_logits" not in rows.columns()
    assert logits not in optimizer.state
    assert all(logits is not parameter for group in optimizer.param_groups for parameter in group["params"])
