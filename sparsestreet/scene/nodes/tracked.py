"""The common part of nodes of annotated objects: their initialization, and the poses along their tracks."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor, nn

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.boxes import view_lag
from sparsestreet.geometry.trajectories import Trajectories, smoothed
from sparsestreet.ops.poses import poses_at
from sparsestreet.ops.raw import Placement, Poses, RawGaussians
from sparsestreet.scene.density import outside_boxes
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.generators import named_generator
from sparsestreet.scene.initialize.gaussians import Points, box_surface_points, neighbor_scales
from sparsestreet.scene.initialize.sources import points_from_images, returns_in_boxes
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.learning_rate import Rates, usual_track_rates
from sparsestreet.scene.masks import Mask, MaskScope
from sparsestreet.scene.nodes.node import (
    BYTES_PER_NUMBER,
    REACH,
    Instances,
    Node,
    NodeSettings,
    temporal_smoothness,
    temporal_smoothness_at,
)
from sparsestreet.scene.state import SceneState
from sparsestreet.types import Track, View


@dataclass(frozen=True, kw_only=True)
class TrackedSettings(NodeSettings):
    """Settings of objects. They start from lidar returns of all training instants, pooled in the frame of each object's
    box, and from points from images there."""

    min_instance_gaussians: float = 10.0
    points_per_instance: int = 5000
    box_points: int = 1000
    """An instance with fewer points than this gets additional random points on the faces of its box; 0: none does, and
    an instance without any point is left out."""
    initial_opacity: float = 0.1
    max_gap: int = 2
    """Frames' worth of time; within its span, an object is present up to this far from a training annotation."""
    learning_rates: Rates = field(default_factory=usual_track_rates)
    temporal_smooth: float = 0.0
    """Weight of the term that keeps learned tracks smooth (see ``temporal_smoothness``); 0: the term is
    not computed."""
    temporal_smooth_of: Literal["all", "frame"] = "all"
    """``all``: the mean over all frames and distances at every step; ``frame``: that of the step's frame and one drawn
    distance, as in DriveStudio."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.temporal_smooth >= 0:
            raise ValueError(f"temporal_smooth is a weight >= 0, got {self.temporal_smooth}")

    @property
    @abstractmethod
    def node_class(self) -> "type[Tracked]":
        """The node class of these settings."""

    def build(self, data: TrainingData, generator: torch.Generator) -> "Tracked | None":
        """Build the node without boxes of frames that have no training image (held out, or outside the range).

        Instances without any point are left out; None if there is no instance.
        """
        tracks = [track for track in data.tracks if any(int(frame) not in data.held_out for frame in track.frames)]
        if not tracks:
            return None
        measured = returns_in_boxes(tracks, data)
        objects = [
            self._object_points(track, Points.concatenate([points_from_images(track, data), returns]), generator)
            for track, returns in zip(tracks, measured, strict=True)
        ]
        tracks = [track for track, points in zip(tracks, objects, strict=True) if len(points)]
        objects = [points for points in objects if len(points)]
        if not tracks:
            return None
        counts = torch.tensor([len(points) for points in objects])
        keyframes = Trajectories.from_tracks(tracks, data.held_out, data.log.num_frames)
        sizes = torch.stack([track.size.float() for track in tracks])
        rows, mask = self.start(
            data,
            Points.concatenate(objects),
            # Per instance, because in their own frames all objects lie on top of each other.
            torch.cat([neighbor_scales(points.positions) for points in objects]),
            torch.full((int(counts.sum()),), self.initial_opacity),
            generator,
            buffers={"instances": torch.repeat_interleave(torch.arange(len(tracks)), counts)},
            scope=MaskScope(keyframes.times, keyframes.valid, torch.zeros_like(sizes), sizes / 2),
        )
        return self.node_class(
            self,
            rows,
            keyframes,
            sizes,
            names=tuple(track.name for track in tracks),
            classes=tuple(track.class_name for track in tracks),
            max_gap=self.max_gap / data.log.frame_periods + view_lag(tracks, data.log.views),
            mask=mask,
        )

    def restore(self, rows: Rows, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Tracked":
        trajectories = stored_keyframes(tensors)
        return self.node_class(self, rows, trajectories, tensors["sizes"], **stored_objects(header))

    def _object_points(self, track: Track, measured: Points, generator: torch.Generator) -> Points:
        """Return one object's colored points in its box frame, filled up if there are too few."""
        points = measured.sampled(self.points_per_instance, generator)
        missing = min(self.box_points, self.points_per_instance) - len(points)
        if missing <= 0:
            return points
        color = points.colors.mean(0) if len(points) else torch.full((3,), 0.5)
        surface = box_surface_points(missing, track.size.float(), generator)
        return Points.concatenate([points, Points(surface, color.expand(missing, 3))])


def stored_keyframes(tensors: Mapping[str, Tensor]) -> Trajectories:
    """Return the annotated poses among the tensors of a node."""
    return Trajectories(
        tensors["keyframe_times"],
        tensors["keyframe_quaternions"],
        tensors["keyframe_translations"],
        tensors["keyframe_valid"],
        tensors["spans"],
    )


def stored_objects(header: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a scene file says of a node's objects, as ``Tracked`` takes it; older files have no classes."""
    classes = tuple(header["classes"]) if "classes" in header else None
    return {"names": tuple(header["names"]), "classes": classes, "max_gap": header["max_gap"]}


def matrices(poses: Poses) -> Float64[np.ndarray, "i 4 4"]:
    """Return poses as world_from_box, on the host."""
    frames = np.tile(np.eye(4), (len(poses.quaternions), 1, 1))
    frames[:, :3, :3] = quat.to_matrix(poses.quaternions.detach().double()).cpu().numpy()
    frames[:, :3, 3] = poses.translations.detach().cpu().numpy()
    return frames


def moved_by_boxes(
    means: Float[Tensor, "n 3"], instances: Int[Tensor, " n"], before: Poses, after: Poses
) -> Float[Tensor, "n 3"]:
    """Return how far means in boxes, meters, move in the world as their boxes do."""
    turn = quat.to_matrix(after.quaternions) - quat.to_matrix(before.quaternions)
    shift = after.translations - before.translations
    return (turn[instances] @ means[:, :, None]).squeeze(-1) + shift[instances]


class Tracked(Node):
    """All instances of one node class: rows in the box frame of the instance named by the buffer ``instances``.

    The pose of a keyframe is its annotation with learned corrections, zero at the start (see ``ops.poses.poses_at``).
    """

    settings: TrackedSettings
    keyframe_times: Tensor
    keyframe_quaternions: Tensor
    keyframe_translations: Tensor
    keyframe_valid: Tensor
    spans: Tensor
    sizes: Tensor

    def __init__(
        self,
        settings: TrackedSettings,
        rows: Rows,
        keyframes: Trajectories,
        sizes: Float[Tensor, "i 3"],
        *,
        names: Sequence[str] | None = None,
        classes: Sequence[str] | None = None,
        max_gap: float = 0.05,
        mask: Mask | None = None,
    ) -> None:
        """Make a node from its tables.

        Args:
            settings: the settings of the node.
            rows: columns as in ``Node``, and the buffer ``instances`` [n] int64: row of ``keyframes``.
            keyframes: training poses of every instance.
            sizes: length, width, height of every instance's box, meters.
            names: names of the instances' tracks; None: their numbers.
            classes: class names of the tracks; None: not known.
            max_gap: normalized time to the nearest keyframe beyond which an instance counts as absent.
            mask: the mask, if the rows have its columns.

        Raises:
            ValueError: if sizes, names and keyframes disagree in their number of instances, or a row names an unknown
                instance.
        """
        super().__init__(settings, rows, mask)
        num_instances = keyframes.times.shape[0]
        self.names = tuple(str(index) for index in range(num_instances)) if names is None else tuple(names)
        self.classes = ("",) * num_instances if classes is None else tuple(classes)
        if sizes.shape[0] != num_instances or len(self.names) != num_instances:
            raise ValueError(
                f"every instance needs a box size and a name, got {sizes.shape[0]} sizes and {len(self.names)} names "
                f"for {num_instances} instances"
            )
        if len(rows) and not 0 <= int(rows.instances.min()) <= int(rows.instances.max()) < num_instances:
            raise ValueError(
                f"rows name instances {int(rows.instances.min())} to {int(rows.instances.max())}, but there are "
                f"{num_instances}: number them as the rows of the keyframes"
            )
        self.max_gap = max_gap
        self.register_buffer("sizes", sizes)
        self.register_buffer("keyframe_times", keyframes.times)
        self.register_buffer("keyframe_quaternions", keyframes.quaternions)
        self.register_buffer("keyframe_translations", keyframes.translations)
        self.register_buffer("keyframe_valid", keyframes.valid)
        self.register_buffer("spans", keyframes.spans)
        self.rotation_deltas = nn.Parameter(torch.zeros_like(keyframes.translations))
        self.translation_deltas = nn.Parameter(torch.zeros_like(keyframes.translations))

    def fix_boxes(self) -> None:
        """Ends learning of the boxes' corrections: they stay what they are, and the optimizer has none of them."""
        for name in ("rotation_deltas", "translation_deltas"):
            values = getattr(self, name).detach()
            delattr(self, name)
            self.register_buffer(name, values)

    def smooth_boxes(self) -> None:
        """Start the boxes' corrections where they make each object's path smooth (``geometry.trajectories``)."""
        with torch.no_grad():
            rotations, translations = smoothed(self.keyframes)
            self.rotation_deltas.copy_(rotations)
            self.translation_deltas.copy_(translations)

    def placed(self, view: View) -> RawGaussians:
        """Return the stored rows, each placed by its instance's box at the view's time; opacity 0 if it is absent."""
        return replace(self.stored(view), placement=Placement(self.pose_at(view.time), self.rows.instances))

    def pose_at(self, time: float) -> Poses:
        """Return pose and presence of every instance at a normalized time."""
        return poses_at(self.keyframes, self.rotation_deltas, self.translation_deltas, time, self.max_gap)

    def object_frames(self, poses: Poses) -> Float64[np.ndarray, "i 4 4"]:
        """Return the frames of all objects at such poses: world_from_object, x ahead, y left, z up."""
        return matrices(poses)

    def frame_height(self, instance: int) -> float:
        """Return how far the origin of an object's frame is above the ground that it stands on, meters."""
        return float(self.sizes[instance, 2]) / 2

    def displacements_over(self, span: float, view: View, raw: RawGaussians) -> Float[Tensor, "n 3"]:
        """Return the motion of the rows' boxes; a body that walks meanwhile, or a network's change, is left out."""
        before, after = (self.pose_at(view.time + side * span / 2) for side in (-1, 1))
        return moved_by_boxes(raw.means, self.rows.instances, before, after)

    def regularizers(
        self, view: View, raw: RawGaussians, drawn: Bool[Tensor, " n"], state: SceneState
    ) -> dict[str, Float[Tensor, ""]]:
        terms, weight = super().regularizers(view, raw, drawn, state), self.settings.temporal_smooth
        if weight > 0:
            learned = self.keyframe_translations + self.translation_deltas
            table = self.keyframe_times, learned, self.keyframe_valid
            if self.settings.temporal_smooth_of == "all":
                smooth = temporal_smoothness(*table)
            else:
                # It depends on the step alone, so a resumed run draws the same as an uninterrupted one.
                generator = named_generator(0, f"temporal smooth {state.step}")
                distance = int(torch.randint(1, REACH + 1, (), generator=generator))
                smooth = temporal_smoothness_at(*table, view.time, distance)
            terms["temporal_smooth"] = weight * smooth
        return terms

    @property
    def keyframes(self) -> Trajectories:
        """Return the annotated poses of the training frames, without corrections."""
        return stored_keyframes(dict(self.named_buffers(recurse=False)))

    def instances(self) -> Instances:
        """Return the objects, named like their tracks."""
        return Instances(self.names, self.rows.instances, self.sizes, self.spans, self.classes)

    def header(self) -> dict[str, Any]:
        return {"names": list(self.names), "classes": list(self.classes), "max_gap": self.max_gap}

    def pose_bytes(self) -> int:
        """Return the float32 bytes of the keyframes: each a time, a quaternion and a translation with corrections."""
        return BYTES_PER_NUMBER * 8 * int(self.keyframe_valid.sum())


@dataclass(frozen=True, kw_only=True)
class RigidSettings(TrackedSettings):
    """``TrackedSettings`` with the distance by which a Gaussian may leave its box."""

    min_displacement: float | None = 1.0
    min_gaussians: int = 1000
    max_gaussians: int | None = 8000
    points_per_instance: int = 300
    box_margin: float = 0.1
    """Meters by which a row's center may lie outside its box; annotated boxes are about this tight."""

    @property
    def node_class(self) -> "type[Rigid]":
        return Rigid


class Rigid(Tracked):
    """Objects whose Gaussians keep their places in the box."""

    settings: RigidSettings

    def raw_at(self, view: View, state: SceneState) -> RawGaussians:
        """Return every instance's Gaussians at its pose; opacity is exactly 0 if the instance is absent."""
        return self.placed(view)

    def outside(self) -> Bool[Tensor, " n"]:
        """Return whether each row's center left its box by more than ``box_margin``."""
        return outside_boxes(self.rows.means, self.rows.instances, self.sizes, margin=self.settings.box_margin)
