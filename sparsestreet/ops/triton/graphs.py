"""The op as CUDA graphs: what the host has said once for a kind of view is said again by one call.

Launches of a rendering take the host longer than many renderings take a device. Views of one kind (a scene's tables, a
size, settings; not the camera's place, nor values) start the same launches on tables of the same size. Such a view's
second rendering is captured, over tables that stay: activated columns and the camera's numbers are copied into them,
images and gradients out of them, so that what was returned stays as it is. Tables of harmonics are read where they are.

Lists have a room that is fixed. As ever, the host waits for the numbers of rows and pairs once all is queued. A view
that does not fit is drawn again without a graph, and the next one is captured with more room.
"""

import threading
import weakref
from collections import Counter, OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef

from sparsestreet.host_copy import copy_to_host
from sparsestreet.ops.raster import SHAPE
from sparsestreet.ops.triton.lists import PAIR_LIMIT, like, list_rows, predicted, remember
from sparsestreet.ops.triton.parts import Room, Sizes
from sparsestreet.ops.triton.passes import Asked, Cotangents, Gradients, Inputs, differentiate
from sparsestreet.ops.triton.pixels import Layers, blend_view
from sparsestreet.ops.triton.screen import Screen, list_in, project_all, read
from sparsestreet.ops.triton.view import KernelView

Answer = TypeVar("Answer")
MAX_KEPT = 8
"""Kinds of views that are kept. Each holds what a rendering and its backward pass need, in memory of its own."""


COUNTS: Counter[str] = Counter()
"""Of this process: passes that were "captured", renderings "replayed", and those done "again" for lack of room."""


class Images(NamedTuple):
    """The tensors of a Rendering."""

    rgb: Float[Tensor, "h w 3"]
    alpha: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"]
    radii: Float[Tensor, " n"]


def drawn(inputs: Inputs, lasts: bool) -> "tuple[Lease, Images] | None":
    """Draw a view by its graph; ``lasts``: whether a backward pass will follow.

    None: its kind has not been seen before, its graph is still needed for a backward pass, or its lists did not fit.
    Raises as ``splat`` does.
    """
    with _lock:
        key = _kind_of(inputs, lasts)
        if key not in _kept:
            _forget()
            _kept[key] = None
            return None
        _kept.move_to_end(key)
        graph = _kept[key]
        if graph is None:
            rows, view = len(inputs.fields[0]), inputs.view
            room = predicted(like(rows, view, inputs.fields[0].device), rows, PAIR_LIMIT)
            if room is None:
                return None
            graph = _kept[key] = ViewGraph(inputs, room, lasts)
        if graph.is_leased:
            return None
        found = graph.draw(inputs)
        if found is None:
            _kept[key] = None
        return found


_kept: "OrderedDict[tuple, ViewGraph | None]" = OrderedDict()
"""By kind, the one that was used last at the end; None: seen once, without a graph."""
_lock = threading.Lock()


def _kind_of(inputs: Inputs, lasts: bool) -> tuple:
    """What must be the same for a graph to be the launches of a view."""
    view, background, moved = inputs.view, inputs.background, inputs.displacements
    camera, means = view.camera, inputs.fields[0]
    tables = tuple((table.data_ptr(), tuple(table.shape)) for table in inputs.fields[SHAPE:])
    switches = view.distorted, view.rolling, view.columns, moved is None, lasts
    behind = None if background is None else tuple(background.shape)
    return means.device, len(means), tables, inputs.terms, camera.width, camera.height, view.settings, switches, behind


def _forget() -> None:
    """Leave out graphs of tables that are gone, and the one that was used longest ago where there are too many."""
    for key, graph in list(_kept.items()):
        if graph is not None and graph.is_stale:
            del _kept[key]
    while len(_kept) >= MAX_KEPT:
        _kept.popitem(last=False)


@dataclass(frozen=True)
class PlacedView(KernelView):
    """A view whose numbers are those that stand in a table at the time of a launch."""

    numbers: Float[Tensor, " numbers"] = field(kw_only=True)

    def table(self, device: torch.device) -> Float[Tensor, " numbers"]:
        return self.numbers


class ViewGraph:
    """The launches of one kind of view, forward and backward, over tables that stay."""

    def __init__(self, inputs: Inputs, room: Room, lasts: bool) -> None:
        self._room, self._memory = room, Memory()
        self._given = [torch.empty_like(one) for one in _changing(inputs)]
        self._storages = [StorageWeakRef(table.untyped_storage()) for table in inputs.fields[SHAPE:]]
        self._lease: weakref.ref[Lease] | None = None
        self._backward: dict[tuple, BackwardGraph | None] = {}
        torch._foreach_copy_(self._given, _changing(inputs))
        placed = self.placed(inputs)
        gaussians, view = placed.gaussians, placed.view
        # Two graphs, so that the host has the sizes while pixels are blended.
        self._list, (self._projection, visible) = self.captured(
            lambda: (
                projection := project_all(gaussians, view),
                list_rows(projection.records, projection.tile_counts, projection.sums, room, view),
            )
        )
        # Whoever makes a table for rows or pairs makes it for all that there is room for.
        visible.sizes.pairs, visible.sizes.rows = room.pairs, room.rows
        self._sizes, projection = visible.sizes.on_device, self._projection

        def blend() -> tuple[Screen, Layers]:
            screen = list_in(room, projection, visible, view)
            return screen, blend_view(screen, view, lasts, placed.background)

        self._list()  # pixels are blended once before they are captured
        self._blend, (self.screen, self.layers) = self.captured(blend)

    @property
    def is_leased(self) -> bool:
        """Whether a backward pass may still come that needs the tables as they are."""
        return self._lease is not None and self._lease() is not None

    @property
    def is_stale(self) -> bool:
        """Whether nobody has the harmonics any more that it reads."""
        return any(storage.expired() for storage in self._storages)

    def placed(self, inputs: Inputs) -> Inputs:
        """The same inputs, where the graph reads them."""
        given = iter(self._given)
        fields = (*(next(given) for _ in range(SHAPE)), *inputs.fields[SHAPE:])
        view = PlacedView(inputs.view.camera, inputs.view.settings, numbers=next(given))
        displacements, background = (None if one is None else next(given) for one in _optional(inputs))
        return replace(inputs, fields=fields, view=view, displacements=displacements, background=background)

    def captured(self, run: Callable[[], Answer]) -> tuple[Callable[[], None], Answer]:
        """Capture what ``run`` starts, in the view's own memory."""
        COUNTS["captured"] += 1
        return self._memory.captured(run)

    def draw(self, inputs: Inputs) -> "tuple[Lease, Images] | None":
        """None: the lists do not fit their room."""
        torch._foreach_copy_(self._given, _changing(inputs))
        self._list()
        counted = copy_to_host(self._sizes)
        self._blend()
        layers = self.layers
        images = Images(*_copies((layers.rgb, layers.alpha, layers.depth, self.screen.radii)))
        sizes = Sizes(self._sizes)
        read(sizes, counted, inputs.gaussians, self._projection)
        if not self._room.holds(sizes.pairs, sizes.rows):
            COUNTS["again"] += 1
            return None
        rows = len(inputs.fields[0])
        remember(like(rows, inputs.view, self._sizes.device), sizes.rows, sizes.pairs)
        COUNTS["replayed"] += 1
        lease = Lease(self)
        self._lease = weakref.ref(lease)
        return lease, images

    def differentiate(self, inputs: Inputs, cotangents: Cotangents, asked: Asked) -> Gradients:
        """Gradients of the view that was drawn last."""
        kind = asked, tuple(one is None for one in cotangents)
        if kind not in self._backward:
            self._backward[kind] = None
            layers = self.layers
            return differentiate(self.placed(inputs), self.screen, layers.ends, layers.depth, cotangents, asked)
        graph = self._backward[kind]
        if graph is None:
            graph = self._backward[kind] = BackwardGraph(self, inputs, cotangents, asked)
        return graph.differentiate(cotangents)


class BackwardGraph:
    """The launches of a backward pass that gets and gives the same kinds of gradients."""

    def __init__(self, forward: ViewGraph, inputs: Inputs, cotangents: Cotangents, asked: Asked) -> None:
        given = [None if one is None else torch.zeros_like(one.contiguous()) for one in cotangents]
        placed, screen, layers = forward.placed(inputs), forward.screen, forward.layers
        self._given = [one for one in given if one is not None]
        self._run, self._found = forward.captured(
            lambda: differentiate(placed, screen, layers.ends, layers.depth, Cotangents(*given), asked)
        )

    def differentiate(self, cotangents: Cotangents) -> Gradients:
        torch._foreach_copy_(self._given, [one for one in cotangents if one is not None])
        self._run()
        screen, gates, background, fields = self._found
        written = iter(_copies([one for one in (screen, background, *fields) if one is not None]))
        screen, background, *fields = (None if one is None else next(written) for one in (screen, background, *fields))
        return Gradients(screen, gates, background, tuple(fields))


@dataclass(frozen=True)
class Lease:
    """A view as its graph has drawn it. While somebody has it the graph draws no other.

    It does not hold the images: these hold their backward pass, which holds the lease."""

    graph: ViewGraph

    def differentiate(self, inputs: Inputs, cotangents: Cotangents, asked: Asked) -> Gradients:
        """Return the gradients; ``inputs`` as they were drawn."""
        return self.graph.differentiate(inputs, cotangents, asked)


class Memory:
    """Captures graphs whose tables lie in memory of their own. Graphs of two views that shared it would write over what
    the other still needs for its backward pass."""

    def __init__(self) -> None:
        self._pool = torch.cuda.graph_pool_handle()

    def captured(self, run: Callable[[], Answer]) -> tuple[Callable[[], None], Answer]:
        """Capture what ``run`` starts. Returns what starts it again, and where that writes its answer."""
        run()  # compiles kernels and loads them, which a capture must not
        graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            # Other threads read images meanwhile, into memory that they ask CUDA for.
            graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
            try:
                answer = run()
            finally:
                graph.capture_end()
        torch.cuda.current_stream().wait_stream(stream)
        return graph.replay, answer


def _changing(inputs: Inputs) -> list[Tensor]:
    """What is copied for every view."""
    fields = inputs.fields[:SHAPE]
    table = inputs.view.table(fields[0].device)
    return [*fields, table, *(one for one in _optional(inputs) if one is not None)]


def _optional(inputs: Inputs) -> tuple[Tensor | None, Tensor | None]:
    return inputs.displacements, inputs.background


def _copies(values: Sequence[Tensor]) -> list[Tensor]:
    copies = [torch.empty_like(value) for value in values]
    torch._foreach_copy_(copies, list(values))
    return copies
