"""One step of Adam for visible rows, in torch and in Triton, against torch's own optimizers."""

import pytest
import torch
from torch import Tensor

from sparsestreet.ops.adam import AdamStep, adam_step_
from sparsestreet.ops.backend import has_triton
from tests.ops.scenes import device_of, relative_error

BACKENDS = ["torch"] + ["triton"] * has_triton()
KINDS = [("torch", torch.float64), *((backend, torch.float32) for backend in BACKENDS)]
SHAPES = [(7, 3), (1, 1), (5,), (19, 15, 3), (2, 11, 13)]
STEPS, LR, BETAS, EPS = 5, 0.05, (0.8, 0.97), 1e-15
# Relative L2 against torch, of the parameter and of the moments. Five steps round a moment fifteen times by up to 6e-8,
# torch with other fusions than ours; a parameter, larger than its steps, hardly feels that.
BARS = {torch.float32: (1e-7, 2e-7), torch.float64: (1e-12, 1e-12)}


def inputs(shape, dtype, device, seed=0) -> tuple[Tensor, list[Tensor]]:
    """A parameter and gradients of sizes from 1e-6 to 1."""
    generator = torch.Generator().manual_seed(seed)
    start = torch.randn(shape, generator=generator, dtype=torch.float64)
    gradients = [
        torch.randn(shape, generator=generator, dtype=torch.float64)
        * 10 ** (-6 * torch.rand(shape, generator=generator, dtype=torch.float64))
        for _ in range(STEPS)
    ]
    return start.to(device, dtype), [gradient.to(device, dtype) for gradient in gradients]


def run(start: Tensor, gradients: list[Tensor], masks: list[Tensor], backend: str) -> tuple[Tensor, Tensor, Tensor]:
    parameter, first, second = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
    for count, (gradient, mask) in enumerate(zip(gradients, masks, strict=True), 1):
        adam_step_(parameter, gradient, first, second, mask, AdamStep(count, LR, BETAS, EPS), backend=backend)
    return parameter, first, second


def assert_close(result, truth, bars):
    names = {"parameter": bars[0], "exp_avg": bars[1], "exp_avg_sq": bars[1]}
    for (name, bar), value, wanted in zip(names.items(), result, truth, strict=True):
        assert relative_error(value, wanted) <= bar, name


@pytest.mark.parametrize(("backend", "dtype"), KINDS)
@pytest.mark.parametrize("shape", SHAPES)
def test_with_all_rows_visible_it_is_torchs_adam(shape, backend, dtype):
    start, gradients = inputs(shape, dtype, device_of(backend))
    mask = torch.ones(shape[0], dtype=torch.bool, device=start.device)
    theirs = torch.nn.Parameter(start.clone())
    adam = torch.optim.Adam([theirs], lr=LR, betas=BETAS, eps=EPS)
    for gradient in gradients:
        theirs.grad = gradient
        adam.step()
    state = adam.state[theirs]
    result = run(start, gradients, [mask] * STEPS, backend)
    assert_close(result, (theirs.detach(), state["exp_avg"], state["exp_avg_sq"]), BARS[dtype])


@pytest.mark.parametrize("backend", BACKENDS)
def test_with_changing_rows_it_is_torchs_sparse_adam(backend):
    """SparseAdam divides before it adds epsilon; at 1e-15 beside gradients of 1e-7 and more that cannot be seen."""
    dtype = torch.float32 if backend == "triton" else torch.float64
    start, gradients = inputs((31, 15, 3), dtype, device_of(backend))
    generator = torch.Generator().manual_seed(1)
    masks = [(torch.rand(31, generator=generator) < 0.4).to(start.device) for _ in range(STEPS)]
    theirs = torch.nn.Parameter(start.double().clone())
    adam = torch.optim.SparseAdam([theirs], lr=LR, betas=BETAS, eps=EPS)
    for gradient, mask in zip(gradients, masks, strict=True):
        rows = mask.nonzero()[:, 0]
        theirs.grad = torch.sparse_coo_tensor(
            rows[None], gradient[mask].double(), start.shape, check_invariants=True, is_coalesced=True
        )
        adam.step()
    state = adam.state[theirs]
    # 1e-15 beside the smallest root of a second moment, 1e-7.
    bars = BARS[dtype] if backend == "triton" else (1e-8, 1e-12)
    result = run(start, gradients, masks, backend)
    assert_close(result, (theirs.detach(), state["exp_avg"], state["exp_avg_sq"]), bars)
    never = ~torch.stack(masks).any(0)
    assert bool(never.any())
    assert torch.equal(result[0][never], start[never])


@pytest.mark.parametrize("backend", BACKENDS)
def test_rows_not_visible_keep_every_bit_whatever_they_hold(backend):
    """Not a number in a hidden gradient, minus zero and subnormal moments."""
    start, (gradient, *_) = inputs((300, 3), torch.float32, device_of(backend))
    mask = (torch.arange(300, device=start.device) % 3 == 1) & (torch.arange(300, device=start.device) > 50)
    gradient[~mask] = torch.nan
    first, second = torch.full_like(start, -0.0), torch.full_like(start, 1e-42)
    start[0] = -0.0
    before = [tensor.clone().view(torch.int32) for tensor in (start, first, second)]
    adam_step_(start, gradient, first, second, mask, AdamStep(3, LR), backend=backend)
    for tensor, bits in zip((start, first, second), before, strict=True):
        changed = (tensor.view(torch.int32) != bits).all(1)
        assert torch.equal(changed, mask)
        assert bool(tensor.isfinite().all())


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("shape", "visible"), [((0, 3), True), ((4, 0), True), ((0,), True), ((5, 3), False)])
def test_without_a_visible_number_nothing_changes(shape, visible, backend):
    fields = [torch.full(shape, value, device=device_of(backend)) for value in (1.0, 2.0, 3.0, 4.0)]
    before = [field.clone() for field in fields]
    mask = torch.full(shape[:1], visible, device=fields[0].device)
    parameter, gradient, first, second = fields
    adam_step_(parameter, gradient, first, second, mask, AdamStep(1, LR), backend=backend)
    assert all(torch.equal(field, old) for field, old in zip(fields, before, strict=True))


@pytest.mark.parametrize("backend", BACKENDS)
def test_gradient_and_mask_may_be_views(backend):
    start, (gradient, *_) = inputs((6, 6), torch.float32, device_of(backend))
    mask = (torch.arange(12, device=start.device) % 4 == 0)[::2]
    results = []
    for views in ((gradient.T, mask), (gradient.T.contiguous(), mask.clone())):
        parameter, first, second = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
        adam_step_(parameter, views[0], first, second, views[1], AdamStep(1, LR), backend=backend)
        results.append(parameter)
    assert torch.equal(*results)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_graph_of_older_values_refuses_its_backward_pass(backend):
    start, (gradient, *_) = inputs((6, 3), torch.float32, device_of(backend))
    parameter = start.clone().requires_grad_()
    loss = (parameter * parameter).sum()
    moments = torch.zeros_like(start), torch.zeros_like(start)
    visible = torch.ones(6, dtype=torch.bool, device=start.device)
    adam_step_(parameter, gradient, *moments, visible, AdamStep(1, LR), backend=backend)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


@pytest.mark.parametrize("backend", BACKENDS)
def test_moments_of_another_shape_are_an_error(backend):
    fields = [torch.zeros(4, width, device=device_of(backend)) for width in (3, 3, 2, 3)]
    mask = torch.ones(4, dtype=torch.bool, device=fields[0].device)
    with pytest.raises(ValueError, match="one shape"):
        adam_step_(fields[0], fields[1], fields[2], fields[3], mask, AdamStep(1, LR), backend=backend)


@pytest.mark.parametrize(
    ("backend", "dtype", "said"),
    [("cuda", torch.float32, "choose one of"), ("triton", torch.float64, "contiguous float32")],
)
def test_what_no_backend_takes_is_an_error(backend, dtype, said):
    if backend == "triton" and not has_triton():
        pytest.skip("the package triton is missing")
    empty = torch.zeros(0, 3, dtype=dtype)
    with pytest.raises(ValueError, match=said):
        adam_step_(empty, empty, empty, empty, torch.zeros(0, dtype=torch.bool), AdamStep(1, LR), backend=backend)
