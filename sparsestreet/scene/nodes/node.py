"""A node of the scene graph: Gaussians that move together, with their settings, density control, mask, regularizers."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.optim import Optimizer

from sparsestreet.geometry.boxes import displacement
from sparsestreet.ops.activate import activate
from sparsestreet.ops.raw import RawGaussians
from sparsestreet.scene.density import DensityStrategy
from sparsestreet.scene.gaussians import INTENSITIES, Rows, drop_parameter
from sparsestreet.scene.initialize.gaussians import Points, init_gaussians
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.learning_rate import Rates, rates_of, usual_rates
from sparsestreet.scene.masks import Mask, MaskScope, MaskSettings
from sparsestreet.scene.state import SceneState
from sparsestreet.types import Gaussians, Track, View

REACH = 5
"""Most keyframes between a pose and those it is compared with (DriveStudio draws one distance of 1 ... 5 a step)."""


def sharp_shape(log_scales: Float[Tensor, "n 3"], max_axis_ratio: float) -> Float[Tensor, ""]:
    """Return the mean of relu(log s_max - log s_min - log r), above 0 if axes differ by more than a factor r.

    DriveStudio's term, ``sharp_shape_ratio``, is linear in the ratio. The ratio overflows for a needle, and its
    gradient grows with it; the logarithm does neither.

    >>> sharp_shape(torch.tensor([[0.0, 0.0, 0.0]]), max_axis_ratio=10.0).item()
    0.0
    """
    ratio = log_scales.amax(1) - log_scales.amin(1)
    return (ratio - math.log(max_axis_ratio)).relu().sum() / max(len(log_scales), 1)


def sharp_shape_ratio(log_scales: Float[Tensor, "n 3"], max_axis_ratio: float) -> Float[Tensor, ""]:
    """Return the mean of max(s_max / s_min, r) - r, DriveStudio's term against needles.

    >>> sharp_shape_ratio(torch.tensor([[12.0, 1.0, 1.0], [2.0, 1.0, 1.0]]).log(), max_axis_ratio=10.0).item()
    1.0
    """
    ratio = (log_scales.amax(1) - log_scales.amin(1)).exp()
    return (ratio - max_axis_ratio).relu().sum() / max(len(log_scales), 1)


def excess_volume(log_scales: Float[Tensor, "n 3"], quantile: float) -> Float[Tensor, ""]:
    """Return the mean of relu(v - p) of the products v of the scales, cubic meters, and p their quantile.

    p is the floor(quantile n)-th smallest of them, and is differentiated too, as in DriveStudio.

    >>> excess_volume(torch.tensor([[1.0], [2.0], [3.0], [6.0]]).log().expand(4, 3) / 3, quantile=0.75).item()
    0.75
    """
    volumes = log_scales.sum(1).exp()
    rank = int(len(volumes) * quantile)
    if rank < 1:
        return volumes.new_zeros(())
    return (volumes - torch.kthvalue(volumes, rank).values).relu().mean()


def temporal_smoothness_at(
    times: Float[Tensor, "i k"],
    translations: Float[Tensor, "i k 3"],
    valid: Bool[Tensor, "i k"],
    time: float,
    distance: int,
) -> Float[Tensor, ""]:
    """Return the part of ``temporal_smoothness`` of the keyframes at one time and their neighbors at one distance.

    The mean is over the objects that have all three keyframes. DriveStudio's term of a step: the time is that of its
    view, the distance is drawn. A keyframe is that of a time up to half of the shortest step between keyframes away,
    because cameras have instants of their own. 0 if no object has all three.

    >>> jerk = torch.tensor([[[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    >>> whole = torch.ones(1, 3, dtype=torch.bool)
    >>> temporal_smoothness_at(torch.tensor([[0.0, 0.5, 1.0]]), jerk, whole, time=0.5, distance=1).item()
    2.0
    """
    here = (times - time).abs().masked_fill(~valid, torch.inf)
    steps = torch.where(valid[:, 1:], times[:, 1:] - times[:, :-1], torch.inf)
    # Just above a half: a camera may fire in the middle of two boxes.
    near = here.amin(1) < 0.501 * torch.nn.functional.pad(steps, (0, 1), value=torch.inf).amin()
    middle = here.argmin(1)[:, None, None]
    return _mean_bend(times, translations, valid, middle, torch.full_like(middle, distance), near[:, None, None])


def temporal_smoothness(
    times: Float[Tensor, "i k"], translations: Float[Tensor, "i k 3"], valid: Bool[Tensor, "i k"]
) -> Float[Tensor, ""]:
    """Return how far keyframes lie off the straight line between two others, meters, as the mean of |t+ + t- - 2 t|.

    The mean is over all objects, coordinates, keyframes and neighbors 1 to ``REACH`` keyframes before and after.
    Gradients go only to the middle keyframe. If the three are not evenly spaced (frames are held out), the line is
    taken at the time of the middle one. DriveStudio's term, of one frame and one distance a step, equals this on
    average.

    >>> steady = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]])
    >>> temporal_smoothness(torch.tensor([[0.0, 0.5, 1.0]]), steady, torch.ones(1, 3, dtype=torch.bool)).item()
    0.0
    """
    middle = torch.arange(times.shape[1], device=times.device)[None, :, None]
    distance = torch.arange(1, REACH + 1, device=times.device)[None, None]
    return _mean_bend(times, translations, valid, middle, distance, torch.ones_like(middle, dtype=torch.bool))


def _mean_bend(
    times: Float[Tensor, "i k"],
    translations: Float[Tensor, "i k 3"],
    valid: Bool[Tensor, "i k"],
    middle: Int[Tensor, "#i m 1"],
    distance: Int[Tensor, "#i 1 r"],
    counts: Bool[Tensor, "#i m 1"],
) -> Float[Tensor, ""]:
    """Return the mean |t+ + t- - 2 t| over the keyframes that count and have neighbors at these distances."""
    count, each = times.shape[1], torch.arange(len(times), device=times.device)[:, None, None]
    before, after = middle - distance, middle + distance
    inside = counts & (before >= 0) & (after < count)
    before, after = before.clamp(min=0), after.clamp(max=count - 1)
    # Valid keyframes come first, so the last of three decides.
    whole = inside & valid[each, after]
    spans = torch.where(whole, times[each, after] - times[each, before], 1.0)
    fraction = (times[each, middle] - times[each, before]) / spans
    fixed = translations.detach()
    line = torch.lerp(fixed[each, before], fixed[each, after], fraction[..., None])
    bends = 2 * (translations[each, middle] - line).abs().mean(-1)
    return torch.where(whole, bends, 0.0).sum() / whole.sum().clamp(min=1)


BYTES_PER_NUMBER = 4
"""Sizes are stated as float32, even if a test or an optimizer holds another precision."""


@dataclass(frozen=True, kw_only=True)
class NodeSettings(ABC):
    """All settings of one node class; callbacks, losses and rules read them here and nowhere else.

    Raises ValueError for limits that contradict each other.
    """

    classes: Sequence[str] = ()
    """Class names of the log whose tracks the node takes."""
    min_displacement: float | None = None
    """Meters; tracks whose boxes are nowhere farther apart than this, or than their noise explains, are left to the
    static nodes (``geometry.boxes``). None: it is not asked."""
    min_path_length: float = 0.0
    """Meters; so are tracks whose steps from box to box, noise included, add up to no more (DriveStudio's rule)."""
    has_body_pose: bool | None = None
    """True: the node takes only tracks with body poses; False: only tracks without; None: both."""
    min_gaussians: int = 0
    """K_min of the paper: neither masks nor pruning leave fewer Gaussians in the node class."""
    min_instance_gaussians: float = 0.0
    """Least number of Gaussians that pruning leaves of each object, per 1,000 pixels that it fills in the training view
    that shows it largest. An object that has fewer keeps all."""
    max_gaussians: int | None = None
    """Density control stops here; None: no limit."""
    limit_rises: bool = False
    """Whether ``max_gaussians`` holds where growth ends only, and before it a limit that rises evenly with the steps
    from the rows at the start. Steps cost less while there are few; what splits late splits where detail is missing."""
    sh_degree: int = 3
    mask: MaskSettings | None = None
    """None: the node has no mask."""
    masked: bool = True
    """Whether the mask, if there is one, is trained in this run."""
    run_mask: MaskSettings | None = None
    """The mask that this run trains in place of ``mask``; None: that one."""
    density: DensityStrategy | None = None
    """None: density control never changes the node."""
    densify_until: float | None = None
    """Fraction of the run after which no Gaussians are added; None: the schedule decides."""
    prunable: bool = True
    """Whether pruning rules may remove Gaussians of this node."""
    sharp_shape: float = 0.0
    """Weight of the term against needles (see ``sharp_shape``); 0: the term is not computed."""
    max_axis_ratio: float = 10.0
    """Ratio of a Gaussian's longest to its shortest axis above which that term counts."""
    sharp_shape_form: Literal["log", "ratio"] = "log"
    """``ratio``: DriveStudio's term, linear in the ratio (see ``sharp_shape_ratio``)."""
    sharp_shape_every: int = 1
    """Steps from one that has the term to the next."""
    learning_rates: Rates = field(default_factory=usual_rates)
    """Column, parameter or module of the node -> its rate; the longest name that matches wins. A mapping of a rate's
    fields becomes a rate."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "learning_rates", rates_of(self.learning_rates))
        if self.min_gaussians < 0:
            raise ValueError(f"min_gaussians must be >= 0, got {self.min_gaussians}")
        if not self.min_instance_gaussians >= 0:
            raise ValueError(
                f"min_instance_gaussians must be >= 0 Gaussians per 1,000 pixels, got {self.min_instance_gaussians}"
            )
        if not (self.sharp_shape >= 0 and self.max_axis_ratio >= 1):
            raise ValueError(
                f"sharp_shape is a weight >= 0 and max_axis_ratio a ratio >= 1, got {self.sharp_shape} and "
                f"{self.max_axis_ratio}"
            )
        if self.sharp_shape_every < 1:
            raise ValueError(f"sharp_shape_every counts steps and must be >= 1, got {self.sharp_shape_every}")
        if self.densify_until is not None and not 0 <= self.densify_until <= 1:
            raise ValueError(f"densify_until is a fraction of the run in [0, 1], got {self.densify_until}")
        if self.max_gaussians is not None and self.max_gaussians < 1:
            raise ValueError(f"max_gaussians must be >= 1 or null, got {self.max_gaussians}")

    def takes(self, track: Track) -> bool:
        """Whether the node claims a track of the log."""
        fits = self.has_body_pose is None or self.has_body_pose == (track.body is not None)
        return fits and track.class_name in self.classes and self._moves(track)

    def _moves(self, track: Track) -> bool:
        far = self.min_displacement is None or displacement(track) > self.min_displacement
        return far and track.path_length > self.min_path_length

    @property
    def mask_settings(self) -> MaskSettings | None:
        """The mask that is trained in this run, if any."""
        own = None if self.mask is None else self.run_mask or self.mask
        return own if self.masked else None

    @abstractmethod
    def build(self, data: TrainingData, generator: torch.Generator) -> "Node | None":
        """Make the node from training data; return None if it would have no instance."""

    @abstractmethod
    def restore(self, rows: Rows, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Node":
        """Return the node of a scene file from its table, all its tensors by name, and its ``Node.header``."""

    def start(
        self,
        data: TrainingData,
        points: Points,
        scales: Float[Tensor, " n"],
        opacities: Float[Tensor, " n"],
        generator: torch.Generator,
        *,
        columns: Mapping[str, Tensor] | None = None,
        buffers: Mapping[str, Tensor] | None = None,
        scope: MaskScope | None = None,
    ) -> tuple[Rows, Mask | None]:
        """Return the table of a new node, one Gaussian a point, and its mask.

        ``scales`` are meters, ``opacities`` lie in (0, 1). ``columns`` are learned in addition to those of every node;
        ``buffers`` are further data of each row. ``scope`` says where and when the mask's instances are (None:
        everywhere, always).
        """
        if scope is None:
            scope = MaskScope.whole(data.times, data.log.center, data.log.radius)
        mask = None if self.mask_settings is None else self.mask_settings.build(self.min_gaussians, scope)
        rows = init_gaussians(
            points.positions,
            points.colors,
            scales,
            opacities=opacities,
            sh_degree=self.sh_degree,
            generator=generator,
            columns=columns,
            mask_columns={} if mask is None else mask.initial_columns(len(points)),
            buffers=buffers,
        )
        return rows, mask


@dataclass(frozen=True)
class Instances:
    """The objects of a node."""

    names: tuple[str, ...]
    """Names of their tracks in the log."""
    ids: Int[Tensor, " n"]
    """Row of the node -> its instance."""
    sizes: Float[Tensor, "i 3"]
    """Length, width, height of their boxes, meters."""
    spans: Float[Tensor, "i 2"] | None = None
    """Normalized times from when to when they may be there; None: unknown."""
    classes: tuple[str, ...] | None = None
    """Class names of their tracks, "" where they are not known; None: unknown."""

    def counts(self) -> Int[Tensor, " i"]:
        """Return the number of rows of every instance."""
        return torch.bincount(self.ids, minlength=len(self.names))


class Node(nn.Module, ABC):
    """One node class: a table of Gaussians with an optional mask.

    The rows hold ``means``, ``log_scales``, ``quaternions``, ``opacity_logits``, ``sh_dc`` [n, 1, 3],
    ``sh_rest`` [n, k - 1, 3] and, while a mask is being trained, the mask's columns. They stay unmasked, because a
    scale of 0 has no logarithm and no ratio. Only activation applies the mask, so densification, culling and
    regularizers see the hidden rows.
    """

    settings: NodeSettings
    rows: Rows
    mask: Mask | None

    def __init__(self, settings: NodeSettings, rows: Rows, mask: Mask | None = None) -> None:
        super().__init__()
        held, wanted = sorted(rows.transient), sorted(mask.columns if mask is not None else ())
        if held != wanted:
            raise ValueError(
                f"a mask and its columns come together, but the mask needs {wanted} and the table has {held}: "
                "make the table with NodeSettings.start, or leave both out"
            )
        self.settings = settings
        self.rows = rows
        self.mask = mask

    @abstractmethod
    def raw_at(self, view: View, state: SceneState) -> RawGaussians:
        """Return the node's Gaussians in a view before activation, and how they are masked and placed.

        A view without frame and camera index is novel, and only its time counts.
        """

    def displacements_over(self, span: float, view: View, raw: RawGaussians) -> Float[Tensor, "n 3"] | None:
        """How far each row moves in the world, in meters, during a normalized time around the view's; None: not at all.

        ``raw`` is what the node answered for the view. Asked for views with a rolling shutter alone, without gradients.
        """
        return None

    def gaussians_at(self, view: View, state: SceneState) -> Gaussians:
        """Return the node's Gaussians in the world, activated, with the mask applied."""
        return activate([self.raw_at(view, state)], sh_degree=state.sh_degree)

    def own_regularizers(
        self, raw: RawGaussians, drawn: Bool[Tensor, " n"], state: SceneState
    ) -> dict[str, Float[Tensor, ""]]:
        """Return terms of the loss that concern only the node, by name, each with its weight.

        ``raw`` is what the node returned for the view of this step, so nothing is computed twice. ``drawn`` are the
        rows that the view shows. A term that pulls at all rows in every step beats the image at rows that few views
        show. The reason: Adam steps by its learning rate however small a lone gradient is.
        """
        return {}

    def regularizers(
        self, view: View, raw: RawGaussians, drawn: Bool[Tensor, " n"], state: SceneState
    ) -> dict[str, Float[Tensor, ""]]:
        """Return the node's own terms, those of its density strategy, and those that have a weight in the settings."""
        settings = self.settings
        shape = {}
        if settings.sharp_shape > 0 and state.step % settings.sharp_shape_every == 0:
            term = sharp_shape if settings.sharp_shape_form == "log" else sharp_shape_ratio
            # Activation applies the mask, so hidden Gaussians still have their shape here.
            shape["sharp_shape"] = settings.sharp_shape * term(self.rows.log_scales, settings.max_axis_ratio)
        if settings.density is not None:
            shape |= settings.density.regularizers(self.rows)
        return shape | self.own_regularizers(raw, drawn, state)

    def outside(self) -> Bool[Tensor, " n"] | None:
        """Return whether each row left the bounds of its instance; None for a node without bounds."""
        return None

    def instances(self) -> Instances | None:
        """Return the node's objects; None for a node without objects."""
        return None

    def header(self) -> dict[str, Any]:
        """Return what a scene file needs in addition to settings and tensors; JSON values only."""
        return {}

    def pose_bytes(self) -> int:
        """Return the float32 bytes of what moves the rows over time; 0 for a static node."""
        return 0

    def stored(self, view: View) -> RawGaussians:
        """Return the learned rows, with the mask at the time of a view."""
        rows = self.rows
        return RawGaussians(
            rows.means,
            rows.log_scales,
            rows.quaternions,
            rows.opacity_logits,
            rows.sh_dc,
            rows.sh_rest,
            multipliers=None if self.mask is None else self.mask.multipliers(rows, view.time),
        )

    def finish_mask(self, optimizer: Optimizer | None = None) -> None:
        """Replaces the mask by its result, and removes what it learned from the table and the optimizer.

        A node without a mask, or with a finished one, stays unchanged.
        """
        if self.mask is None or not self.mask.columns:
            return
        learned, (self.mask, buffers) = self.mask, self.mask.finish(self.rows)
        for name in learned.columns:
            self.rows.drop_column(name, optimizer)
        for parameter in learned.parameters():
            if optimizer is not None:
                drop_parameter(optimizer, parameter)
        for name, values in buffers.items():
            self.rows.register_buffer(name, values)

    def row_bytes(self) -> int:
        """Return the float32 bytes of the rows without their masks, and without intensities, which no image needs; an
        instance id is one number, bits are packed."""
        columns = self.rows.columns()
        return sum(_bytes(columns[name]) for name in columns.keys() - self.rows.transient - {INTENSITIES})

    def _load_from_state_dict(self, state_dict, prefix, *args) -> None:
        """Finishes the mask first if the checkpoint lacks the mask's columns, because it is from after the mask stage.

        The buffers of the finished mask come from the initial rows; the checkpoint then replaces them.
        """
        if self.mask is not None and not any(f"{prefix}rows.{name}" in state_dict for name in self.mask.columns):
            self.finish_mask()
        super()._load_from_state_dict(state_dict, prefix, *args)


def _bytes(column: Tensor) -> int:
    return column.numel() * (1 if column.dtype == torch.uint8 else BYTES_PER_NUMBER)


def stored_frame_periods(header: Mapping[str, Any]) -> float:
    """Return ``DrivingLog.frame_periods`` from a node's header in a scene file; older files have the number of frames.

    >>> stored_frame_periods({"frame_periods": 3.5}), stored_frame_periods({"num_frames": 4})
    (3.5, 3.0)
    """
    return header["frame_periods"] if "frame_periods" in header else float(header["num_frames"] - 1)
