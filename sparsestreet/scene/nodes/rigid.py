"""Objects that move without changing their shape: cars, trams, trucks."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from sparsestreet.geometry import quaternions as quat
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.masks import StaticMask
from sparsestreet.scene.nodes.node import BYTES_PER_NUMBER, Node
from sparsestreet.scene.nodes.trajectory import Trajectories, keyframe_interval
from sparsestreet.types import Gaussians


class Rigid(Node):
    """All instances of one node class: rows in the box frame of the instance named by the buffer ``instances``.

    The pose of a keyframe is its annotation with a learned correction, both zero at the start: rotation
    R_knot exp([rotation_delta]) (a rotation vector in the box frame, radians) and translation t_knot +
    translation_delta (world, meters).
    """

    def __init__(
        self,
        rows: Rows,
        keyframes: Trajectories,
        sizes: Float[Tensor, "i 3"],
        mask: StaticMask | None = None,
        max_gap: float = 0.05,
    ) -> None:
        """Make a node of the tables.

        Args:
            rows: columns as in ``Node``, and the buffer ``instances`` [n] int64: row of ``keyframes``.
            keyframes: training poses of every instance.
            sizes: length, width, height of every instance's box, meters.
            mask: settings of the mask, if the rows have one.
            max_gap: normalized time to the nearest keyframe beyond which an instance counts as absent.

        Raises:
            ValueError: if sizes and keyframes disagree in their number of instances, or a row names none of them.
        """
        super().__init__(rows, mask)
        num_instances = keyframes.times.shape[0]
        if sizes.shape[0] != num_instances:
            raise ValueError(f"every instance needs a box size, got {sizes.shape[0]} for {num_instances} instances")
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

    def gaussians_at(self, time: float, sh_degree: int) -> Gaussians:
        """Every instance's Gaussians at its pose; opacity exactly 0 where the instance is absent."""
        local = self.activated(sh_degree)
        quaternions, translations, active = self.pose_at(time)
        instances: Int[Tensor, " n"] = self.rows.instances
        # One table, one gather: rotation matrix (9), quaternion (4), translation (3), presence (1) of each row's box.
        poses = (quat.to_matrix(quaternions).flatten(1), quaternions, translations, active[:, None].to(translations))
        row_poses = torch.cat(poses, dim=1).index_select(0, instances)
        rotation, quaternion, translation, presence = row_poses.split((9, 4, 3, 1), dim=1)
        # Written out instead of a matrix product, which autocast would round to bfloat16: meters become decimeters.
        means = (rotation.unflatten(1, (3, 3)) * local.means[:, None, :]).sum(-1) + translation
        return replace(
            local,
            means=means,
            quaternions=quat.multiply(quaternion, local.quaternions),
            opacities=local.opacities * presence.squeeze(1),
        )

    def pose_at(self, time: float) -> tuple[Float[Tensor, "i 4"], Float[Tensor, "i 3"], Bool[Tensor, " i"]]:
        """World-from-box rotation (unit, wxyz), box center (meters) and presence of every instance.

        Between two keyframes the translation is interpolated linearly and the rotation by slerp along the shorter arc.
        """
        at = keyframe_interval(self.keyframe_times, self.keyframe_valid, self.spans, time, self.max_gap)
        rotation_lower, translation_lower = self._refined_keyframes(at.lower)
        rotation_upper, translation_upper = self._refined_keyframes(at.upper)
        quaternions = quat.slerp(rotation_lower, rotation_upper, at.fraction)
        translations = torch.lerp(translation_lower, translation_upper, at.fraction[:, None])
        return quaternions, translations, at.active

    def instance_counts(self) -> Int[Tensor, " i"]:
        """Number of rows of every instance."""
        return torch.bincount(self.rows.instances, minlength=self.sizes.shape[0])

    def pose_bytes(self) -> int:
        """float32 bytes of the keyframes: a time, a quaternion and a translation each, corrections folded in."""
        return BYTES_PER_NUMBER * 8 * int(self.keyframe_valid.sum())

    def _refined_keyframes(self, keyframes: Int[Tensor, " i"]) -> tuple[Float[Tensor, "i 4"], Float[Tensor, "i 3"]]:
        """Corrected pose of one keyframe per instance."""
        each = torch.arange(keyframes.shape[0], device=keyframes.device)
        correction = quat.from_rotation_vector(self.rotation_deltas[each, keyframes])
        quaternions = quat.multiply(self.keyframe_quaternions[each, keyframes], correction)
        return quaternions, self.keyframe_translations[each, keyframes] + self.translation_deltas[each, keyframes]
