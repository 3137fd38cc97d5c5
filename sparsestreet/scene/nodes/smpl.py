"""People as bodies on a skeleton (the SMPL nodes of OmniRe, Chen et al. 2024)."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from scipy.spatial import KDTree
from torch import Tensor, nn

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.boxes import view_lag
from sparsestreet.geometry.skeleton import NUM_JOINTS, Bones, posed_bones, skin
from sparsestreet.geometry.trajectories import Trajectories, keyframe_interval
from sparsestreet.ops.raw import Poses, RawGaussians
from sparsestreet.scene.body import Anatomy, Body, BodyTemplate, BuiltinBody, People, people_of, surface, trained_poses
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.initialize.gaussians import Points
from sparsestreet.scene.initialize.sources import points_from_images, returns_in_boxes
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.masks import Mask, MaskScope
from sparsestreet.scene.nodes.node import BYTES_PER_NUMBER, excess_volume
from sparsestreet.scene.nodes.tracked import Tracked, TrackedSettings, matrices, stored_keyframes, stored_objects
from sparsestreet.scene.state import SceneState
from sparsestreet.types import Track, View

_log = logging.getLogger(__name__)

_COLORED_BY = 4
"""Number of measured points that give a vertex its first color."""

_APART = 100.0
"""Meters between people in the search for neighbors, so that no neighbor is on another person."""


@dataclass(frozen=True, kw_only=True)
class SmplSettings(TrackedSettings):
    """Settings of people, who start with a Gaussian at each vertex."""

    has_body_pose: bool | None = True
    initial_opacity: float = 0.99
    body: Body = field(default_factory=BuiltinBody)
    """The surface, and the joints that move it."""
    random_colors: bool = False
    """Whether vertices start in random colors (DriveStudio); False: in that of points measured near them."""
    neighbors: int = 3
    """K: number of neighboring Gaussians on the body, itself included, that should be alike."""
    neighbor_weight: float = 1.0e-3
    """Weight of the mean spread among neighbors, for each of rotations, scales, opacities and harmonics."""
    scale_weight: float = 0.05
    """Weight of the mean squared longest axis, square meters."""
    volume_weight: float = 0.0
    """Weight of ``excess_volume`` above ``volume_quantile`` (DriveStudio's scaling_reg); 0: none."""
    volume_quantile: float = 0.99
    volume_from: float = 0.2
    """Fraction of the run at which that term starts."""
    smoothness_weight: float = 0.0
    """Weight of the distance of joints, as unit quaternions, from the middle of the keyframes before and after."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.has_body_pose:
            raise ValueError(
                f"a node of bodies takes only tracks with body poses, got has_body_pose={self.has_body_pose}: say true"
            )
        if not (self.volume_weight >= 0 and 0 < self.volume_quantile <= 1):
            raise ValueError(
                "volume_weight is a weight >= 0 and volume_quantile lies in (0, 1], got "
                f"{self.volume_weight} and {self.volume_quantile}"
            )
        if self.neighbors < 2:
            raise ValueError(f"neighbors counts the Gaussian itself, so it must be at least 2, got {self.neighbors}")

    @property
    def node_class(self) -> "type[Smpl]":
        return Smpl

    def build(self, data: TrainingData, generator: torch.Generator) -> "Smpl | None":
        """Build the node without people who have no pose in a training frame; a warning counts them."""
        tracks = [track for track in data.tracks if bool(trained_poses(track, data.held_out).any())]
        if len(tracks) < len(data.tracks):
            _log.warning("%d people have no pose in a training frame and are left out", len(data.tracks) - len(tracks))
        if not tracks:
            return None
        template = self.body.load()
        people = people_of(tracks, template, data.held_out, data.log.num_frames)
        rows, mask = self._start(data, tracks, template, people, generator)
        return Smpl(
            self,
            rows,
            people.keyframes,
            torch.stack([track.size.float() for track in tracks]),
            anatomy=Anatomy.of(template, people),
            names=tuple(track.name for track in tracks),
            classes=tuple(track.class_name for track in tracks),
            max_gap=self.max_gap / data.log.frame_periods + view_lag(tracks, data.log.views),
            mask=mask,
        )

    def restore(self, rows: Rows, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Smpl":
        trajectories = stored_keyframes(tensors)
        anatomy = Anatomy(**{part.name: tensors[part.name] for part in fields(Anatomy)})
        return Smpl(self, rows, trajectories, tensors["sizes"], anatomy=anatomy, **stored_objects(header))

    def _start(
        self,
        data: TrainingData,
        tracks: Sequence[Track],
        template: BodyTemplate,
        people: People,
        generator: torch.Generator,
    ) -> tuple[Rows, Mask | None]:
        """Start with discs along the surface, each as large as its vertex's part of it, and half as thick."""
        count, per_person = people.vertices.shape[:2]
        surfaces = [surface(vertices, template.faces) for vertices in people.vertices]
        areas, normals = (torch.cat(parts) for parts in zip(*surfaces, strict=True))
        radii = (areas / torch.pi).sqrt()
        low, high = people.vertices.amin(1), people.vertices.amax(1)
        if self.random_colors:
            colors = torch.rand(count * per_person, 3, generator=generator)
        else:
            colors = _colors(tracks, data, people.places)
        rows, mask = self.start(
            data,
            Points(people.vertices.flatten(0, 1), colors),
            radii,
            torch.full_like(radii, self.initial_opacity),
            generator,
            buffers={
                "instances": torch.arange(count).repeat_interleave(per_person),
                "vertex_ids": torch.arange(per_person).repeat(count),
            },
            scope=MaskScope(people.keyframes.times, people.keyframes.valid, (low + high) / 2, (high - low) / 2),
        )
        with torch.no_grad():
            rows.log_scales[:, 2] -= np.log(2)
            rows.quaternions.copy_(_from_third_axis(normals))
        return rows, mask


def _colors(tracks: Sequence[Track], data: TrainingData, places: Float[Tensor, "i v 3"]) -> Float[Tensor, "n 3"]:
    """Return for each vertex the mean color of the nearest measured points of its box; gray without any.

    Measured points are returns and points from images, pooled over all frames; limbs swing about their mean places.
    """
    colors = []
    pooled = returns_in_boxes(tracks, data)
    for track, returns, vertices in zip(tracks, pooled, places, strict=True):
        measured = Points.concatenate([returns, points_from_images(track, data)])
        if len(measured) == 0:
            colors.append(torch.full_like(vertices, 0.5))
            continue
        tree = KDTree(measured.positions.numpy())
        nearest_first = list(range(1, min(_COLORED_BY, len(measured)) + 1))
        _, nearest = tree.query(vertices.numpy(), k=nearest_first)  # pyright: ignore[reportArgumentType]
        colors.append(measured.colors[torch.from_numpy(nearest)].mean(1))
    return torch.cat(colors)


def _from_third_axis(directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Return the shortest rotation that takes the z axis to each unit direction."""
    x, y, z = directions.unbind(1)
    # Half of the turn lies between the axis and the direction; straight down, any axis works.
    turn = torch.stack((1 + z, -y, x, torch.zeros_like(z)), 1)
    down = torch.tensor([0.0, 1.0, 0.0, 0.0])
    return quat.normalized(torch.where((z < -0.9999)[:, None], down, turn))


class Smpl(Tracked):
    """Rows at rest, relative to their person's pelvis. The skeleton moves them; the pose of the pelvis places them.

    Poses of the pelvis are those of ``Tracked``. The other joints have keyframes at the same times, with learned
    corrections as rotation vectors, zero at the start.
    """

    settings: SmplSettings
    vertices: Tensor
    attached: Tensor
    weights: Tensor
    joints: Tensor
    joint_keyframes: Tensor

    def __init__(
        self,
        settings: SmplSettings,
        rows: Rows,
        keyframes: Trajectories,
        sizes: Float[Tensor, "i 3"],
        *,
        anatomy: Anatomy,
        names: Sequence[str] | None = None,
        classes: Sequence[str] | None = None,
        max_gap: float = 0.05,
        mask: Mask | None = None,
    ) -> None:
        """Take the arguments of ``Tracked``; rows also have the buffer ``vertex_ids`` [n] int64, template vertices."""
        super().__init__(settings, rows, keyframes, sizes, names=names, classes=classes, max_gap=max_gap, mask=mask)
        for name, values in vars(anatomy).items():
            self.register_buffer(name, values)
        self.joint_deltas = nn.Parameter(torch.zeros_like(anatomy.joint_keyframes[..., 1:]))
        # The vertices of the last search, and the rows next to each.
        self._neighbors: tuple[Tensor, Tensor] | None = None

    def raw_at(self, view: View, state: SceneState) -> RawGaussians:
        """Return every person's Gaussians, moved by the skeleton; opacity is exactly 0 if the person is absent."""
        raw = self.placed(view)
        bones = posed_bones(self.joints, self.joint_rotations(view.time))
        all_bones = Bones(bones.transforms.flatten(0, 1), bones.quaternions.flatten(0, 1))
        attached = self.attached[self.rows.vertex_ids] + NUM_JOINTS * self.rows.instances[:, None]
        weights = self.weights[self.rows.vertex_ids]
        means, quaternions = skin(raw.means, raw.quaternions, all_bones, attached, weights)
        return replace(raw, means=means, quaternions=quaternions)

    def object_frames(self, poses: Poses) -> Float64[np.ndarray, "i 4 4"]:
        """Return upright frames at the pelvis; x is where its z points, seen from above."""
        frames = matrices(poses)
        ahead = frames[:, :2, 2]
        yaws = np.arctan2(ahead[:, 1], ahead[:, 0])
        frames[:, :3, :3] = np.eye(3)
        frames[:, 0, 0] = frames[:, 1, 1] = np.cos(yaws)
        frames[:, 1, 0] = np.sin(yaws)
        frames[:, 0, 1] = -np.sin(yaws)
        return frames

    def frame_height(self, instance: int) -> float:
        """Return how far the pelvis of a person at rest is above the soles."""
        own = self.rows.means.detach()[self.rows.instances == instance, 1]
        # A few Gaussians may have left the body.
        return float(-own.quantile(0.005)) if len(own) else 0.0

    def joint_rotations(self, time: float) -> Float[Tensor, "i 24 4"]:
        """Return the joints of every person relative to their parents at a time; the pelvis is at rest."""
        table = self.keyframes
        at = keyframe_interval(table.times, table.valid, table.spans, time, self.max_gap)
        each = torch.arange(len(at.lower), device=at.lower.device)
        lower, upper = (
            quat.multiply(self.joint_keyframes[each, place], quat.from_rotation_vector(self.joint_deltas[each, place]))
            for place in (at.lower, at.upper)
        )
        turned = quat.slerp(lower, upper, at.fraction[:, None].expand(lower.shape[:2]))
        pelvis = torch.zeros_like(turned[:, :1])
        pelvis[..., 0] = 1
        return torch.cat((pelvis, turned), 1)

    def own_regularizers(
        self, raw: RawGaussians, drawn: Bool[Tensor, " n"], state: SceneState
    ) -> dict[str, Float[Tensor, ""]]:
        """Return those of ``neighbors``, ``scale``, ``volume`` and ``smoothness`` that have a weight."""
        terms, settings = {}, self.settings
        if len(self.rows) and settings.neighbor_weight > 0:
            terms["neighbors"] = settings.neighbor_weight * self._spread(raw, drawn)
        if len(self.rows) and settings.scale_weight > 0:
            terms["scale"] = settings.scale_weight * _mean_of(raw.log_scales.exp().amax(1).square(), drawn)
        if len(self.rows) and settings.volume_weight > 0 and state.progress >= settings.volume_from:
            terms["volume"] = settings.volume_weight * excess_volume(raw.log_scales, settings.volume_quantile)
        if settings.smoothness_weight > 0:
            terms["smoothness"] = settings.smoothness_weight * self._unevenness()
        return terms

    def pose_bytes(self) -> int:
        """Return the bytes of ``Tracked`` with 23 quaternions a keyframe, and the body's vertices, joints, weights."""
        per_keyframe = 4 * (NUM_JOINTS - 1) * int(self.keyframe_valid.sum())
        body = sum(part.numel() for part in (self.vertices, self.attached, self.weights, self.joints))
        return super().pose_bytes() + BYTES_PER_NUMBER * (per_keyframe + body)

    def _spread(self, raw: RawGaussians, drawn: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
        """Return the mean standard deviation among neighbors of drawn rows, summed over attributes."""
        attributes = (
            quat.normalized(self.rows.quaternions),
            raw.log_scales.exp(),
            torch.sigmoid(raw.opacity_logits)[:, None],
            raw.sh_dc.flatten(1),
            raw.sh_rest.flatten(1),
        )
        widths = [attribute.shape[1] for attribute in attributes if attribute.shape[1]]
        near = torch.cat(attributes, 1)[self._nearest()]
        # Written out, because torch's std and norm are ten times slower on the CPU. Equal neighbors have gradient 0.
        variance = (near - near.mean(1, keepdim=True)).square().sum(1) / (near.shape[1] - 1)
        spread = (variance + 1e-12).sqrt()
        return torch.stack([_mean_of(part.mean(1), drawn) for part in spread.split(widths, 1)]).sum()

    def _unevenness(self) -> Float[Tensor, ""]:
        """Return the mean squared distance of joints from the interpolation of their neighbors in time."""
        turned = quat.multiply(self.joint_keyframes, quat.from_rotation_vector(self.joint_deltas))
        before, here, after = (self.keyframe_times[:, start : start - 2 or None] for start in range(3))
        # Held-out frames leave gaps, so the times decide where the middle is.
        fraction = (here - before) / torch.where(after > before, after - before, 1.0)
        first, middle, last = (turned[:, start : start - 2 or None] for start in range(3))
        distance = torch.lerp(first, last, fraction[..., None, None]) - middle
        counts = self.keyframe_valid[:, 2:]
        return (distance.square().sum((2, 3)) * counts).sum() / ((NUM_JOINTS - 1) * counts.sum()).clamp(min=1)

    def _nearest(self) -> Int[Tensor, "n k"]:
        """Return the nearest rows on the body at rest, itself included; searches again when the rows have changed."""
        vertices = self.rows.vertex_ids
        # Every plan replaces this tensor, even if the number of rows stays the same.
        if self._neighbors is None or self._neighbors[0] is not vertices:
            apart = _APART * self.rows.instances[:, None].float()
            places = torch.cat((self.vertices[vertices], apart), 1).cpu().numpy()
            distances, found = KDTree(places).query(places, k=self.settings.neighbors)
            itself = np.arange(len(places))[:, None]
            found = np.where(distances < _APART / 2, found, itself)
            self._neighbors = vertices, torch.from_numpy(found).to(self.rows.means.device)
        return self._neighbors[1]


def _mean_of(values: Float[Tensor, " n"], drawn: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
    return (values * drawn).sum() / drawn.sum().clamp(min=1)
