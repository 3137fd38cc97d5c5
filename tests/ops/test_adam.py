"""Both Adams, of finite and of visible rows: all backends against torch's optimizers, and what they refuse."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from sparsestreet.ops.adam import NONE, AdamStep, adam_all_, adam_step_
from sparsestreet.ops.backend import has_triton
from sparsestreet.ops.cpu.library import load_library
from tests.ops.scenes import device_of, relative_error

VISIBLE_BACKENDS = ["torch"] + ["triton"] * has_triton()
BACKENDS = [*VISIBLE_BACKENDS, "cpu"]
every_backend = pytest.mark.parametrize("backend", BACKENDS)
every_visible = pytest.mark.parametrize("backend", VISIBLE_BACKENDS)
SHAPES = [(7, 15, 3), (1, 1), (5,), (300, 3), (21, 11)]
STEPS, LR, BETAS, EPS = 5, 0.05, (0.8, 0.97), 1e-15
# Five steps round a moment fifteen times by up to 6e-8, torch with other fusions than ours; a parameter, larger than
# its steps, hardly feels that.
BARS = (1e-7, 2e-7, 2e-7)
Fields = tuple[Tensor, Tensor, Tensor]
"""A parameter and both moments."""


def inputs(shape: tuple[int, ...], device: torch.device, dtype=torch.float32) -> tuple[Tensor, list[Tensor]]:
    """A parameter and gradients of sizes from 1e-6 to 1."""
    generator = torch.Generator().manual_seed(0)

    def gradient() -> Tensor:
        sizes = 10 ** (-6 * torch.rand(shape, generator=generator))
        return (torch.randn(shape, generator=generator) * sizes).to(device, dtype)

    gradients = [gradient() for _ in range(STEPS)]
    return torch.randn(shape, generator=generator).to(device, dtype), gradients


def nothing_refused(device: torch.device) -> Tensor:
    return torch.tensor([0, NONE], device=device)


def theirs(start: Tensor, gradients: list[Tensor], kind: Any = torch.optim.Adam, **options) -> Fields:
    parameter = torch.nn.Parameter(start.clone())
    adam = kind([parameter], lr=LR, betas=BETAS, eps=EPS, **options)
    for parameter.grad in gradients:
        adam.step()
    state = adam.state[parameter]
    return parameter.detach(), state["exp_avg"], state["exp_avg_sq"]


def adam_one_(fields: Fields, gradient: Tensor, refused: Tensor, step: AdamStep, width: int, **how: str) -> None:
    """``adam_all_`` of one parameter."""
    parameter, first, second = ([field] for field in fields)
    adam_all_(parameter, [gradient], first, second, refused[None], [step], [width], **how)


def of_finite_rows(fields: Fields, gradient: Tensor, step: AdamStep, backend: str) -> None:
    parameter, refused = fields[0], nothing_refused(gradient.device)
    width = parameter[:1].numel()
    adam_one_(fields, gradient, refused, step, width, backend=backend)
    assert refused.tolist() == [0, NONE]


def of_all_visible(fields: Fields, gradient: Tensor, step: AdamStep, backend: str) -> None:
    mask = torch.ones(len(gradient), dtype=torch.bool, device=gradient.device)
    adam_step_(fields[0], gradient, *fields[1:], mask, step, backend=backend)


def ours(start: Tensor, gradients: list[Tensor], backend: str, update: Callable[..., None] = of_finite_rows) -> Fields:
    fields = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
    for count, gradient in enumerate(gradients, 1):
        update(fields, gradient, AdamStep(count, LR, BETAS, EPS), backend)
    return fields


UPDATES = [(of_finite_rows, name) for name in BACKENDS] + [(of_all_visible, name) for name in VISIBLE_BACKENDS]
every_update = pytest.mark.parametrize(("update", "backend"), UPDATES)


@every_update
@pytest.mark.parametrize("shape", SHAPES)
def test_where_all_rows_step_it_is_torchs_adam(shape, update, backend):
    start, gradients = inputs(shape, device_of(backend))
    for found, wanted, bar in zip(ours(start, gradients, backend, update), theirs(start, gradients), BARS, strict=True):
        assert relative_error(found, wanted) <= bar


@pytest.mark.skipif(
    torch.backends.cpu.get_cpu_capability() not in ("AVX2", "AVX512")
    or load_library().splat_variant_name(-1) == b"baseline"
    or not torch.__version__.startswith("2.13."),
    reason="without fused multiplication torch and the library round otherwise, and torch may in other versions",
)
@pytest.mark.parametrize("shape", [*SHAPES, (3000, 4), (13,)])
def test_the_library_has_the_bits_of_torchs_fused_adam(shape):
    start, gradients = inputs(shape, torch.device("cpu"))
    wanted = theirs(start, gradients, fused=True)
    assert all(map(torch.equal, ours(start, gradients, "cpu"), wanted))


@every_backend
@pytest.mark.parametrize("shape", [(700, 15, 3), (300,), (130, 4)])
def test_rows_whose_gradient_is_not_finite_keep_every_bit_and_are_counted(shape, backend):
    """All others step as if these were not there. The table spans several blocks of a kernel."""
    start, (gradient, *_) = inputs(shape, device_of(backend))
    rows, width = shape[0], torch.Size(shape[1:]).numel()
    bad = torch.tensor([5, 6, rows - 1], device=start.device)
    clean = gradient.clone()
    for place, (row, value) in enumerate(zip(bad.tolist(), (torch.nan, torch.inf, -torch.inf), strict=True)):
        gradient.view(rows, width)[row, (place * 7) % width] = value
    before = start, torch.full_like(start, 0.25), torch.full_like(start, 0.5)
    results = []
    for given, counted in ((gradient, [3, 5]), (clean, [0, NONE])):
        fields, refused = [field.clone() for field in before], nothing_refused(start.device)
        adam_one_((fields[0], fields[1], fields[2]), given, refused, AdamStep(3, LR), width, backend=backend)
        assert refused.tolist() == counted
        results.append(fields)
    others = torch.ones(rows, dtype=torch.bool, device=start.device).index_fill(0, bad, False)
    for old, found, wanted in zip(before, *results, strict=True):
        assert torch.equal(found[bad], old[bad])
        # The library rounds the last numbers of a tensor otherwise only where they are the tensor's last.
        assert torch.equal(found[others], wanted[others])


WIDTHS = 5 * (3, 1, 45, 4, 256, 7, 130)
ROWS = 5 * (345, 1, 23, 1024, 9, 0, 8)
"""Of each width: programs that are full, or end in numbers of no 16 bytes, and none; more parameters than a table has
places at least."""


def several(device: torch.device, offset: int = 0) -> tuple[list[Tensor], list[Tensor], list[AdamStep]]:
    """Parameters of all widths and their gradients, with rows that are not finite; all but the first begin ``offset``
    numbers behind a multiple of 64 bytes."""
    generator = torch.Generator().manual_seed(4)
    made = []
    for rows, width in zip(2 * ROWS, 2 * WIDTHS, strict=True):
        room = torch.zeros(rows * width + offset, device=device)
        made.append(room[offset * (len(made) > 0) :][: rows * width].view(rows, width))
        made[-1].copy_(torch.randn(rows, width, generator=generator))
    parameters, gradients = made[: len(WIDTHS)], made[len(WIDTHS) :]
    for place, value in enumerate((torch.nan, torch.inf, -torch.inf, torch.nan)):
        gradients[place][-1 - place // 2, -1] = value
    gradients[3][700:702, 0] = torch.nan
    return parameters, gradients, [AdamStep(1 + place, 0.1 + place, BETAS, EPS) for place in range(len(WIDTHS))]


@every_backend
@pytest.mark.parametrize("offset", [0, 1])
def test_parameters_step_together_each_by_its_own_numbers(backend, offset):
    parameters, gradients, steps = several(device_of(backend), offset)
    before = [one.double() for one in parameters]
    first, second = [[torch.full_like(one, value) for one in parameters] for value in (0.25, 0.5)]
    refused = torch.tensor([[2, NONE]], device=device_of(backend)).repeat(len(WIDTHS), 1)
    adam_all_(parameters, gradients, first, second, refused, steps, WIDTHS, backend=backend)
    bad = [~gradient.isfinite().all(1) for gradient in gradients]
    firsts = [int(rows.nonzero()[0]) if bool(rows.any()) else NONE for rows in bad]
    assert refused.tolist() == [[2 + int(rows.sum()), row] for rows, row in zip(bad, firsts, strict=True)]
    for place, (step, old, gradient) in enumerate(zip(steps, before, gradients, strict=True)):
        m = 0.25 * BETAS[0] + (1 - BETAS[0]) * gradient.double()
        v = 0.5 * BETAS[1] + (1 - BETAS[1]) * gradient.double() ** 2
        root = (v / (1 - BETAS[1] ** step.count)).sqrt() + EPS
        rested = bad[place][:, None]
        wanted = (torch.where(rested, *pair) for pair in (
            (old, old - step.lr * m / (1 - BETAS[0] ** step.count) / root),
            (torch.full_like(old, 0.25), m), (torch.full_like(old, 0.5), v),
        ))  # fmt: skip
        for found, truth in zip((parameters[place], first[place], second[place]), wanted, strict=True):
            # A few roundings of numbers that are no larger than a step and the parameter.
            torch.testing.assert_close(found.double(), truth, rtol=1e-6, atol=1e-6 * step.lr)


@pytest.mark.skipif(not has_triton(), reason="needs the package triton")
def test_a_launch_is_played_back_with_other_numbers(monkeypatch):
    """What a recorded copy and launch read again is the memory of the host that ``fill`` writes."""
    from sparsestreet.ops.triton import adam

    launched, launch = [], adam.launch
    monkeypatch.setattr(adam, "launch", lambda *given, **options: launched.append((given, options)))
    device = device_of("triton")
    parameters, gradients, steps = several(device)
    first, second, others, more = [[torch.zeros_like(one) for one in parameters] for _ in range(4)]
    fresh, refused = [one.clone() for one in parameters], nothing_refused(device).repeat(len(WIDTHS), 1)
    tables = adam.AdamTables(parameters, gradients, first, second, refused, WIDTHS)
    tables.fill([AdamStep(9, 5.0).numbers] * len(WIDTHS))
    tables.launch()
    tables.fill([step.numbers for step in steps])
    (((kernel, items, block, table, *rest), options),) = launched
    table.copy_(tables.host)
    launch(kernel, items, block, table, *rest, **options)
    monkeypatch.setattr(adam, "launch", launch)
    adam_all_(fresh, gradients, others, more, refused, steps, WIDTHS, backend="triton")
    assert all(map(torch.equal, parameters, fresh))
    assert not any(isinstance(one, float) for one in rest)


@every_backend
def test_counts_add_up_and_the_first_row_stays_the_first(backend):
    start, (gradient, *_) = inputs((9, 3), device_of(backend))
    gradient[7] = torch.nan
    refused = torch.tensor([4, 2], device=start.device)
    moments = torch.zeros_like(start), torch.zeros_like(start)
    adam_one_((start, *moments), gradient, refused, AdamStep(1, LR), 3, backend=backend)
    assert refused.tolist() == [5, 2]


def test_huge_numbers_are_finite_and_none_at_all_is_no_error():
    gradient = torch.full((2, 3), 3e38)
    for backend in ("torch", "cpu"):
        of_finite_rows((torch.zeros(2, 3), torch.zeros(2, 3), torch.zeros(2, 3)), gradient, AdamStep(1, LR), backend)
    empty, refused = torch.zeros(0, 3), nothing_refused(gradient.device)
    adam_one_((empty, empty, empty), empty, refused, AdamStep(1, LR), 3)
    assert refused.tolist() == [0, NONE]


@every_visible
def test_with_changing_rows_it_is_torchs_sparse_adam(backend):
    """SparseAdam divides before it adds epsilon; at 1e-15 beside gradients of 1e-7 and more that cannot be seen."""
    dtype = torch.float32 if backend == "triton" else torch.float64
    start, gradients = inputs((31, 15, 3), device_of(backend), dtype)
    generator = torch.Generator().manual_seed(1)
    masks = [(torch.rand(31, generator=generator) < 0.4).to(start.device) for _ in range(STEPS)]
    sparse = [
        torch.sparse_coo_tensor(
            mask.nonzero().T, gradient[mask].double(), start.shape, check_invariants=True, is_coalesced=True
        )
        for gradient, mask in zip(gradients, masks, strict=True)
    ]
    wanted = theirs(start.double(), sparse, torch.optim.SparseAdam)
    found = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
    for count, (gradient, mask) in enumerate(zip(gradients, masks, strict=True), 1):
        adam_step_(found[0], gradient, *found[1:], mask, AdamStep(count, LR, BETAS, EPS), backend=backend)
    # 1e-15 beside the smallest root of a second moment, 1e-7.
    bars = BARS if backend == "triton" else (1e-8, 1e-12, 1e-12)
    for value, truth, bar in zip(found, wanted, bars, strict=True):
        assert relative_error(value, truth) <= bar
    never = ~torch.stack(masks).any(0)
    assert bool(never.any())
    assert torch.equal(found[0][never], start[never])


@every_visible
def test_rows_not_visible_keep_every_bit_whatever_they_hold(backend):
    """Not a number in a hidden gradient, minus zero and subnormal moments."""
    start, (gradient, *_) = inputs((300, 3), device_of(backend))
    mask = (torch.arange(300, device=start.device) % 3 == 1) & (torch.arange(300, device=start.device) > 50)
    gradient[~mask] = torch.nan
    start[0] = -0.0
    fields = start, torch.full_like(start, -0.0), torch.full_like(start, 1e-42)
    before = [tensor.clone().view(torch.int32) for tensor in fields]
    adam_step_(start, gradient, *fields[1:], mask, AdamStep(3, LR), backend=backend)
    for tensor, bits in zip(fields, before, strict=True):
        assert torch.equal((tensor.view(torch.int32) != bits).all(1), mask)
        assert bool(tensor.isfinite().all())


@every_visible
@pytest.mark.parametrize(("shape", "visible"), [((0, 3), True), ((4, 0), True), ((0,), True), ((5, 3), False)])
def test_without_a_visible_number_nothing_changes(shape, visible, backend):
    fields = [torch.full(shape, value, device=device_of(backend)) for value in (1.0, 2.0, 3.0, 4.0)]
    before = [field.clone() for field in fields]
    mask = torch.full(shape[:1], visible, device=fields[0].device)
    parameter, gradient, exp_avg, exp_avg_sq = fields
    adam_step_(parameter, gradient, exp_avg, exp_avg_sq, mask, AdamStep(1, LR), backend=backend)
    assert all(map(torch.equal, fields, before))


@every_update
def test_a_gradient_may_be_a_view(update, backend):
    start, (gradient, *_) = inputs((6, 6), device_of(backend))
    answers = [ours(start, [given], backend, update)[0] for given in (gradient.T, gradient.T.contiguous())]
    assert torch.equal(*answers)


@every_visible
def test_a_mask_may_be_a_view(backend):
    start, (gradient, *_) = inputs((6, 6), device_of(backend))
    mask, answers = (torch.arange(12, device=start.device) % 4 == 0)[::2], []
    for given in (mask, mask.clone()):
        fields = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
        adam_step_(fields[0], gradient, *fields[1:], given, AdamStep(1, LR), backend=backend)
        answers.append(fields[0])
    assert torch.equal(*answers)
    assert not torch.equal(answers[0], start)


@every_update
def test_a_graph_of_older_values_refuses_its_backward_pass(update, backend):
    start, (gradient, *_) = inputs((6, 3), device_of(backend))
    parameter = start.clone().requires_grad_()
    loss = (parameter * parameter).sum()
    update((parameter, torch.zeros_like(start), torch.zeros_like(start)), gradient, AdamStep(1, LR), backend)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_shapes_that_do_not_fit():
    start, refused = torch.zeros(6, 6), nothing_refused(torch.device("cpu"))
    with pytest.raises(ValueError, match="one shape"):
        adam_one_((start, start, start), start[:3], refused, AdamStep(1, LR), 6)
    with pytest.raises(ValueError, match="36 numbers do not come in rows of 5"):
        adam_one_((start, start, start), start, refused, AdamStep(1, LR), 5)
    with pytest.raises(ValueError, match="one shape"):
        adam_step_(start, start, start[:, :2], start, torch.ones(6, dtype=torch.bool), AdamStep(1, LR))
