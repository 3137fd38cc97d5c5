"""Harmonics in the tables of several nodes: the op says of them what it says of one table of the same numbers."""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from sparsestreet.ops import SplatSettings, contribution, leave_one_out, splat
from sparsestreet.ops.activate import activate
from sparsestreet.ops.raster import empty_gradients
from sparsestreet.ops.raw import Placement, Poses, RawGaussians
from sparsestreet.types import Camera, Gaussians, Harmonics, Shutter
from tests.conftest import unchecked
from tests.ops.scenes import (
    CPU,
    camera,
    cotangents,
    device_of,
    every_backend,
    every_double,
    every_precision,
    fill_buffers_with_nan,
    first_interpreted,
    random_gaussians,
    with_threads,
)
from tests.typed import as_a, there

VIEW = camera(9, 7)
ROLLING = replace(VIEW, shutter=Shutter(torch.tensor([0.02, 0.01, 0.0]), torch.tensor([0.0, 0.02, 0.01]), "left"))
DISTORTED = replace(VIEW, distortion=torch.tensor([0.1, -0.02, 0.001, 0.002, 0.0]))
ENDS, STORED = (7, 7, 39, 45), (8, 3, 15, 3)
"""Rows and degrees of four parts, the second of no row. Neither registers nor programs of kernels end with them."""


@dataclass(frozen=True)
class Case:
    view: Camera = VIEW
    settings: SplatSettings = SplatSettings()  # noqa: RUF009 (frozen)
    terms: int = 16
    gated: bool = False
    moved: bool = False
    resting: tuple[int, ...] = ()
    """Parts that let all but the first coefficients rest."""


CASES = {
    "gates, antialias and resting": Case(settings=SplatSettings(antialias=True), gated=True, resting=(2,)),
    "plain": Case(),
    "lens": Case(DISTORTED),
    "shutter": Case(ROLLING, moved=True, terms=9),
    "degree 1": Case(settings=SplatSettings.preset("drivestudio"), terms=4, resting=(0, 3)),
    "degree 0": Case(terms=1),
}


def street(dtype: torch.dtype, device: torch.device = CPU, seed: int = 0) -> Gaussians:
    """Random rows whose harmonics are in four pairs of tables; those of an instance that is absent have none."""
    drawn = random_gaussians(ENDS[-1], VIEW, terms=16, seed=seed)
    drawn.opacities[20:26] = 0.0
    drawn.dense_sh()[20:26] = torch.nan
    first, rest = [], []
    for begin, end, stored in zip((0, *ENDS), ENDS, STORED, strict=False):
        first.append(drawn.dense_sh()[begin:end, :1])
        rest.append(drawn.dense_sh()[begin:end, 1 : 1 + stored])
    fields = [value.to(device, dtype, copy=True).requires_grad_() for value in drawn.learned()[:4]]
    tables = [[value.to(device, dtype, copy=True).requires_grad_() for value in some] for some in (first, rest)]
    return Gaussians.of_learned([*fields, *tables[0], *tables[1]], 16)


def tables_of(rows: Gaussians) -> Harmonics:
    return as_a(Harmonics, rows.sh)


def drawn(rows: Gaussians, case: Case, backend: str, *, dense: bool) -> list[Tensor | None]:
    """Images, and the gradients of fields, tables and gates."""
    sh, (dtype, device) = tables_of(rows), (rows.means.dtype, rows.means.device)
    rest = tuple(table.detach() if place in case.resting else table for place, table in enumerate(sh.rest))
    sh = Harmonics(sh.first, rest, case.terms)
    moved = torch.linspace(-0.2, 0.2, 3 * len(rows), device=device, dtype=dtype).view(-1, 3) if case.moved else None
    given = replace(rows, sh=sh.dense() if dense else sh, displacements=moved)
    gates = torch.linspace(0, 1, len(rows), device=device, dtype=dtype).requires_grad_() if case.gated else None
    seen = splat(given, case.view, settings=case.settings, backend=backend, gates=gates)
    images = [seen.rgb, seen.alpha, seen.depth]
    wanted = [*rows.learned(), seen.screen_offsets, *([] if gates is None else [gates])]
    found = torch.autograd.grad(images, wanted, [v.to(rows.means) for v in cotangents(VIEW)], allow_unused=True)
    return [*images, seen.radii, *found]


@every_precision
@pytest.mark.parametrize("name", first_interpreted(*CASES))
def test_tables_are_drawn_as_one_table_of_the_same_numbers(monkeypatch, backend, dtype, name):
    """To the last bit, gradients too: what is padded adds zeros."""
    rows, case = street(dtype, device_of(backend)), CASES[name]
    expected = drawn(rows, case, backend, dense=True)
    fill_buffers_with_nan(monkeypatch)
    found = drawn(rows, case, backend, dense=False)
    for value, truth in zip(found, expected, strict=True):
        assert (value is None) == (truth is None)
        assert value is None or torch.equal(value, there(truth))
    assert there(found[0]).detach().abs().sum() > 0
    rests = found[8 + len(STORED) : 8 + 2 * len(STORED)]
    unused = [place in case.resting or case.terms == 1 for place in range(len(STORED))]
    # Of the part without a row a gradient, which is empty, says nothing.
    assert [rest is None for rest in rests] == [True] * 4 if case.terms == 1 else unused
    used = [there(rest)[:, : case.terms - 1].abs().sum() > 0 for rest in rests if rest is not None and len(rest)]
    assert all(used)
    assert not any(there(rest)[:, case.terms - 1 :].any() for rest in rests if rest is not None)


def test_gradients_that_nobody_asks_for_take_no_memory():
    fields = street(torch.float32).learned()
    for terms, place, some in ((16, 10, True), (16, 11, False), (1, 10, False)):
        asked = [one != 11 for one in range(len(fields))]
        assert (empty_gradients(fields, terms, asked)[place] is not None) == some


@every_backend
def test_what_rows_add_and_change_is_that_of_one_table(backend):
    rows = street(torch.float32, device_of(backend))
    dense = replace(rows, sh=rows.dense_sh())
    for measure in (contribution, leave_one_out):
        found, expected = (vars(measure(one, VIEW, backend=backend)) for one in (rows, dense))
        assert all(torch.equal(found[name], expected[name]) for name in expected)


@every_backend
def test_a_bad_coefficient_is_named_by_its_row_among_all(backend):
    rows = street(torch.float32, device_of(backend))
    visible = splat(rows, VIEW, backend=backend).visible[39:].nonzero()
    row = int(visible[0])
    with torch.no_grad():
        tables_of(rows).rest[3][row, 2, 1] = torch.inf
    for call in (splat, contribution, leave_one_out):
        with pytest.raises(ValueError, match=f"sh must be finite, but row {39 + row} has inf"):
            call(rows, VIEW, backend=backend)
    # What is not in use is not read.
    splat(replace(rows, sh=replace(tables_of(rows), terms=1)), VIEW, backend=backend)


@every_double
def test_the_gradient_of_a_coefficient_is_its_finite_difference(backend):
    """Of the third part, whose rows are the second that there are; the loss is linear but where colors end."""
    rows = street(torch.float64)
    table, upstream = tables_of(rows).rest[2], cotangents(VIEW)[0]
    gradient = drawn(rows, Case(), backend, dense=False)[8 + len(STORED) + 2]
    row, place, channel = divmod(int(there(gradient).abs().argmax()), 45)[0], 7, 1
    losses = []
    for step in (1e-6, -1e-6):
        with torch.no_grad():
            table[row, place, channel] += step
            losses.append(float((splat(rows, VIEW, backend=backend).rgb * upstream).sum()))
            table[row, place, channel] -= step
    (of_rgb,) = torch.autograd.grad((splat(rows, VIEW, backend=backend).rgb * upstream).sum(), table)
    # Losses of about 1 are rounded to 1e-16, differences of 2e-6 to 1e-10.
    assert float(of_rgb[row, place, channel]) == pytest.approx((losses[0] - losses[1]) / 2e-6, rel=1e-6, abs=1e-8)
    assert abs(float(of_rgb[row, place, channel])) > 1e-3


def test_the_same_bits_for_any_number_of_threads():
    """Parts of rows that threads take begin and end within tables."""
    rows = street(torch.float32)
    alone, *others = with_threads((1, 2, 3, 5), lambda: drawn(rows, Case(), "cpu", dense=False))
    for other in others:
        assert all(torch.equal(there(one), there(same)) for one, same in zip(alone, other, strict=True))


@pytest.mark.parametrize("backend", ["torch", "cpu"])
def test_activation_leaves_harmonics_where_nodes_keep_them(backend):
    shapes = ((3,), (3,), (4,), (), (1, 3))
    means, scales, turns, logits, first = (torch.ones(4, *shape) for shape in shapes)
    parts = [
        RawGaussians(means, scales, turns, logits, first.clone(), torch.ones(4, stored, 3)) for stored in (3, 15, 0)
    ]
    present = Poses(torch.eye(4)[:2], torch.zeros(2, 3), torch.tensor([True, False]))
    parts[1] = replace(parts[1], placement=Placement(present, torch.tensor([0, 1, 0, 1])))
    found = activate(parts, sh_degree=2, backend=backend)
    assert found.terms == 9
    for part, first, rest in zip(parts, tables_of(found).first, tables_of(found).rest, strict=True):
        assert first is part.sh_dc
        assert rest is part.sh_rest
    assert (found.opacities[4:8] > 0).tolist() == [True, False] * 2
    assert activate(parts[::2], sh_degree=2, backend=backend).terms == 4


def test_tables_that_cannot_be():
    rows = street(torch.float32)
    sh, none = tables_of(rows), torch.zeros(0, 1, 3)

    def refuse(message: str, tables: Harmonics) -> None:
        with pytest.raises(ValueError, match=message):
            splat(replace(rows, sh=tables), VIEW)

    wrong = {
        "have the 45 rows of means together.* got .7, 0, 32.": replace(sh, first=sh.first[:3], rest=sh.rest[:3]),
        "first and rest the same, got .*45. and": Harmonics((rows.dense_sh()[:, :1],), (sh.rest[0],), 16),
        "rest must store 0, 3, 8 or 15 coefficients .* got 4": replace(sh, rest=(sh.rest[0][:, :4], *sh.rest[1:])),
        "hold 1, 4, 9 or 16 terms .* got 5": replace(sh, terms=5),
        "share one dtype": replace(sh, rest=tuple(rest.double() for rest in sh.rest)),
    }
    for message, tables in wrong.items():
        refuse(message, tables)
    with unchecked():
        refuse("sh.first must have shape .0, 1, 3.", replace(sh, first=(sh.first[0], none[:, :0], *sh.first[2:])))
