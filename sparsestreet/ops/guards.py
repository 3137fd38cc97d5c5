"""Counts which guards of the op act on a view; docs/stability.md says what each is for."""

from dataclasses import astuple, dataclass, replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from sparsestreet.ops.reference import on_screen
from sparsestreet.ops.reference.projection import (
    COMPENSATION_FLOOR,
    Reason,
    axes_in_camera,
    row_reasons,
    sigma_points_held,
    slopes_held,
    to_camera,
)
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.validate import check_dtype, check_structure, check_values
from sparsestreet.types import Camera, Gaussians

_ALARMS = ("vanished", "overflowed", "identity_quaternion", "color_held")


@dataclass(frozen=True)
class Guards:
    """Numbers of rows by guard; ``+`` adds up views, starting from ``Guards()``.

    Each row is in exactly one of the first nine: that of the first reason that holds, or ``drawn``. The others count
    rows that are drawn; a row may be in several.

    >>> Guards(drawn=2, near=1) + Guards(drawn=3) == Guards(drawn=5, near=1)
    True
    >>> Guards(drawn=3, overflowed=1).alarms
    {'overflowed': 1}
    """

    drawn: int = 0
    """As in ``Rendering.visible``. (A row whose alpha equals the cut-off to the last bit is drawn with radius 0.)"""
    masked: int = 0
    """Opacity 0; nothing else of such a row is read."""
    near: int = 0
    """At the near plane, nearer, or behind the camera."""
    past_fold: int = 0
    """Past the fold: farther off the axis than the lens polynomial describes."""
    outruns_shutter: int = 0
    """Moves over the image nearly as fast as the image is read, in the same direction."""
    vanished: int = 0
    """Screen determinant too small, which happens only without blur. An alarm."""
    overflowed: int = 0
    """Larger on the screen, or farther away, than the dtype can square. An alarm."""
    faint: int = 0
    """Peak alpha below ``alpha_min``, or below what float32 holds (2^-126)."""
    outside: int = 0
    """The box holds no pixel center of the image."""

    identity_quaternion: int = 0
    """A quaternion of length zero, replaced by the identity. An alarm."""
    slope_held: int = 0
    """Without a lens: the Jacobian is taken at the limit of its slope."""
    sigma_point_held: int = 0
    """With a lens: a sigma point is moved to the near plane, or lies past the fold where the lens is continued."""
    compensation_held: int = 0
    """The antialias compensation is at its floor."""
    alpha_clamped: int = 0
    """Peak alpha above ``alpha_max``."""
    color_cut: int = 0
    """A color channel at 0 or below, which is black and has no gradient."""
    color_held: int = 0
    """With ``half_colors``: a channel above the largest float16. An alarm."""

    def __add__(self, other: "Guards") -> "Guards":
        return Guards(*(mine + theirs for mine, theirs in zip(astuple(self), astuple(other), strict=True)))

    @property
    def alarms(self) -> dict[str, int]:
        """The guards that acted although no clean scene needs them, with their counts; empty if all is well."""
        return {name: count for name in _ALARMS if (count := getattr(self, name))}


@torch.no_grad()
def guards(
    gaussians: Gaussians,
    camera: Camera,
    *,
    settings: SplatSettings = SplatSettings(),  # noqa: B008 (frozen)
) -> Guards:
    """Count what :func:`splat` with the same arguments culls and limits, on any device.

    It projects anew, as the reference does, in the dtype of the Gaussians. Where rounding decides about a row, another
    backend may decide otherwise. :func:`splat` itself does not count, so it pays nothing.

    Raises ValueError as :func:`splat` does.

    >>> means = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0]])  # the second is behind the camera
    >>> pair = Gaussians(means, torch.ones(2, 4), torch.full((2, 3), 0.1), torch.full((2,), 0.5), torch.zeros(2, 1, 3))
    >>> camera = Camera(torch.eye(4), torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), width=16, height=16)
    >>> guards(pair, camera) == Guards(drawn=1, near=1)
    True
    """
    check_structure(gaussians, camera, None)
    check_dtype(gaussians, "guards")
    with torch.autocast(gaussians.means.device.type, enabled=False):
        reasons = row_reasons(gaussians, camera, settings)
        drawn = reasons == Reason.DRAWN
        check_values(gaussians, drawn)
        counts = torch.bincount(reasons, minlength=len(Reason)).tolist()
        acting = _acting(gaussians, drawn.nonzero().squeeze(-1), camera, settings)
        acted = {name: int(rows.sum()) for name, rows in acting.items()}
    return Guards(**{reason.name.lower(): counts[reason] for reason in Reason}, **acted)


def _acting(
    gaussians: Gaussians, rows: Int[Tensor, " v"], camera: Camera, settings: SplatSettings
) -> dict[str, Bool[Tensor, " v"]]:
    """Which of the drawn rows each guard acts on."""
    # Colors before rounding.
    splats = on_screen(gaussians, rows, camera, replace(settings, half_colors=False))
    in_camera, none = to_camera(gaussians.means[rows], camera), torch.zeros_like(rows, dtype=torch.bool)
    if camera.distortion is None:
        slope_held, sigma_point_held = slopes_held(in_camera, camera), none
    else:
        axes = axes_in_camera(gaussians, rows, camera)
        slope_held, sigma_point_held = none, sigma_points_held(in_camera, axes, camera.distortion, settings.near_plane)
    return {
        "identity_quaternion": (gaussians.quaternions[rows] == 0).all(-1),
        "slope_held": slope_held,
        "sigma_point_held": sigma_point_held,
        "compensation_held": none if splats.ratios is None else splats.ratios <= COMPENSATION_FLOOR**2,
        "alpha_clamped": splats.opacities > settings.alpha_max,
        "color_cut": (splats.colors <= 0).any(-1),
        "color_held": (splats.colors > torch.finfo(torch.float16).max).any(-1) if settings.half_colors else none,
    }
