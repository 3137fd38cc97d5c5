"""The backward pass over one view, and what is counted of its rows, as functions of tensors."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from sparsestreet.ops.raster import SHAPE, LeaveOneOutSums, empty_gradients
from sparsestreet.ops.triton.counters import (
    CHANGE_COUNT,
    COUNTER_COUNT,
    GATHERED_COUNT,
    count_tiles_pixels,
    remove_from_tiles,
)
from sparsestreet.ops.triton.gradients import GATE_PLACE, OPTIONS, ROWS, block_of, project_rows_backward, sum_slots
from sparsestreet.ops.triton.launch import launch
from sparsestreet.ops.triton.lists import Lists
from sparsestreet.ops.triton.pixels import ONE_WARP, Ends, decompose, differentiate_view, pixel_arguments
from sparsestreet.ops.triton.screen import Screen, contiguous, effects, fields_of, given_or, parts_of
from sparsestreet.ops.triton.view import KernelView
from sparsestreet.types import Gaussians, LeaveOneOut


@dataclass(frozen=True)
class Inputs:
    """What a view is drawn of."""

    fields: tuple[Tensor, ...]
    """``Gaussians.learned``."""
    terms: int | None
    displacements: Float[Tensor, "n 3"] | None
    background: Float[Tensor, "..."] | None
    view: KernelView

    @property
    def gaussians(self) -> Gaussians:
        return Gaussians.of_learned(self.fields, self.terms, self.displacements)


class Cotangents(NamedTuple):
    """Gradients of the images; None: nothing depends on it."""

    rgb: Float[Tensor, "h w 3"] | None
    alpha: Float[Tensor, "h w"] | None
    depth: Float[Tensor, "h w"] | None


class Asked(NamedTuple):
    """What gets a gradient."""

    screen: bool
    gates: bool
    background: bool
    fields: tuple[bool, ...]


class Gradients(NamedTuple):
    """None: not asked for."""

    screen: Float[Tensor, "n 2"] | None
    gates: Float[Tensor, " n"] | None
    background: Float[Tensor, "..."] | None
    fields: tuple[Tensor | None, ...]


def differentiate(
    inputs: Inputs,
    screen: Screen,
    ends: Ends,
    depth: Float[Tensor, "h w"],
    cotangents: Cotangents,
    asked: Asked,
    changes: LeaveOneOutSums | None = None,
) -> Gradients:
    """Return the gradients of a view that was drawn with these ``ends`` and expected depths. Never waits."""
    fields, view = fields_of(inputs.gaussians), inputs.view
    transmittance, lists = ends.transmittance, screen.lists
    given = cotangents.rgb
    v_rgb = transmittance.new_zeros(*transmittance.shape, 3) if given is None else given.contiguous()
    v_passed, v_depth_sum, v_background = decompose(
        transmittance, depth, inputs.background, v_rgb,
        contiguous(cotangents.alpha), contiguous(cotangents.depth), asked.background,
    )  # fmt: skip
    if not any((asked.screen, asked.gates, *asked.fields)):
        return Gradients(None, None, v_background, (None,) * len(asked.fields))
    if changes is not None:
        # A loop of its own over the same lists: in the one below it would take the registers of gradients.
        changes.found = removed(screen, view, ends, len(fields[0]), changes.background, changes.pixel_weights)
    plain = view.settings.plain_gradients
    gradients = differentiate_view(screen, view, ends, v_rgb, v_passed, v_depth_sum, asked.screen and not plain)
    sums = transmittance.new_empty(len(fields[0]), gradients.shape[1])
    _sum_slots(gradients, lists, sums, 16, tl.float32)
    outputs, v_screen = empty_gradients(fields, inputs.terms, asked.fields), transmittance.new_empty(len(fields[0]), 2)
    for part in parts_of(fields, inputs.terms):
        v_first, v_rest = (outputs[SHAPE + place] for place in part.places)
        launch(
            project_rows_backward, part.end - part.start, block_of(view),
            *fields[:SHAPE], part.first, part.rest, given_or(inputs.displacements, fields[0]), screen.table,
            screen.records, screen.tile_counts, sums, *outputs[:SHAPE], v_first, given_or(v_rest, v_first),
            v_screen, part.start, part.end,
            SUMS=sums.shape[1], TERMS=part.terms, STORED=part.stored, REST=v_rest is not None,
            ANTIALIAS=view.settings.antialias, CLAMPED=view.settings.clamp_colors,
            DETACHED=view.settings.detach_directions, PLAIN=plain, **effects(view, inputs.displacements),
        )  # fmt: skip
    return Gradients(v_screen, _of_gates(screen, sums), v_background, tuple(outputs))


def _of_gates(screen: Screen, sums: Float[Tensor, "n s"]) -> Float[Tensor, " n"] | None:
    """Gradients of the gates; 0 for rows that were not drawn, whose sums are not written."""
    if not screen.gated:
        return None
    return torch.where(screen.tile_counts > 0, sums[:, GATE_PLACE], 0.0)


def counted(screen: Screen, view: KernelView, rows: int) -> Float[Tensor, "n 3"]:
    """Blend weight, touched pixels and dominated pixels of each row, float64."""
    lists = screen.lists
    counters = screen.records.new_empty(len(lists.slots), COUNTER_COUNT)
    launch(
        count_tiles_pixels, len(lists.order), 1,
        screen.records, lists.pair_rows, lists.slots, lists.begins, lists.ends, lists.order, counters,
        *pixel_arguments(view), view.transmittance_min, EXCLUSIVE=view.exclusive, options=ONE_WARP,
    )  # fmt: skip
    totals = torch.zeros(rows, COUNTER_COUNT, dtype=torch.float64, device=counters.device)
    _sum_slots(counters, lists, totals, 4, tl.float64)
    return totals


def removed(
    screen: Screen, view: KernelView, ends: Ends, rows: int, background: Tensor | None, pixel_weights: Tensor | None
) -> LeaveOneOut:
    """How much the view changes without each row; squared in one way, or in three by as many layers of weights."""
    three, lists, passed = pixel_weights is not None and pixel_weights.dim() == 3, screen.lists, ends.transmittance
    pairs = lists.sizes.pairs  # the tables may have room for more
    changes = passed.new_empty(pairs, GATHERED_COUNT if three else CHANGE_COUNT)
    behind, counts = contiguous(background), contiguous(pixel_weights)
    launch(
        remove_from_tiles, len(lists.order), 1,
        screen.records, lists.pair_rows, lists.slots, lists.begins, lists.ends, ends.lasts, lists.order,
        passed, given_or(behind, passed), given_or(counts, passed), changes, *pixel_arguments(view),
        BEHIND=behind is not None, WEIGHTED=counts is not None, THREE_WAYS=three, options=ONE_WARP,
    )  # fmt: skip
    totals = torch.zeros(rows, changes.shape[1], dtype=torch.float64, device=changes.device)
    _sum_slots(changes, lists, totals, 8 if three else 4, tl.float64)
    # A maximum is the same in any order.
    largest = torch.zeros_like(totals[:, 0])
    of_pairs = changes[lists.slots[:pairs], 0].double()
    largest.scatter_reduce_(0, lists.rows_of_pairs[:pairs].long(), of_pairs, "amax")
    found = LeaveOneOut(largest, totals[:, 2:], totals[:, 1])
    return found if three else replace(found, squared_change=found.squared_change[:, 0])


def _sum_slots(values: Tensor, lists: Lists, sums: Tensor, padded: int, kind: tl.dtype) -> None:
    launch(
        sum_slots, lists.sizes.rows, ROWS,
        values, lists.rows, lists.row_ends, lists.tile_counts, sums, lists.sizes.rows,
        COUNT=values.shape[1], PADDED=padded, SUM=kind, options=OPTIONS,
    )  # fmt: skip
