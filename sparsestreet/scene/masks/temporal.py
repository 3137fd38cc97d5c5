"""A keep score for every Gaussian and time (the paper's mask for nodes that change their shape)."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from sparsestreet.scene.gaussians import Rows, Selection, keep_best
from sparsestreet.scene.masks.mask import BITS, BakedMask, Mask, MaskScope, check_mask, packed
from sparsestreet.scene.masks.static import straight_through

FEATURES = "mask_features"

_GOLDEN = (math.sqrt(5) - 1) / 2
"""Golden ratio - 1. Its multiples modulo 1 fill the unit interval evenly and choose the frames of successive steps."""

_ALWAYS = -1.0
"""A limit that every score exceeds."""

_TIMES_AT_ONCE = 8
"""Number of training frames whose scores are computed at once, to bound the memory."""


@dataclass(frozen=True)
class TemporalMaskSettings:
    """Settings of a temporal mask. Raises ValueError for a negative weight, or a threshold or sizes out of range."""

    sparsity_weight: float
    """lambda_n of the paper."""
    threshold: float = 0.01
    """epsilon of the paper."""
    initial_logit: float = 1.0
    features: int = 8
    """d of the paper: number of learned features of each Gaussian."""
    feature_times: int = 1
    """Times at which a Gaussian has features of its own, spread evenly over the log and interpolated between. 1: one
    vector f_k for all times, as for the network's t is enough to tell times apart; the number of frames: the paper's
    f_k^t to the letter."""
    frames: int = 4
    """T of the paper: number of training frames in the loss of a step, in addition to the current one."""
    width: int = 64
    """Width of the two hidden layers."""
    octaves: int = 4
    """Number of octaves of the sines and cosines that encode time and position."""
    visible_only: bool = False
    """True: the loss lowers a row's scores only in views that draw the row (see ``StaticMaskSettings``)."""
    image_closes: bool = True
    """False: the image's gradient may only raise scores, so only the sparsity loss closes masks. All rows share one
    network. If the image asks the same of all rows (thinner limbs, say), a mask of 0 or 1 cannot provide it. Then the
    network closes people at most times."""

    def __post_init__(self) -> None:
        check_mask(self.sparsity_weight, self.threshold)
        if min(self.features, self.feature_times, self.width) < 1 or min(self.frames, self.octaves) < 0:
            raise ValueError(
                "a mask over time needs features, feature_times and width >= 1, frames and octaves >= 0, got "
                f"{self.features}, {self.feature_times}, {self.width}, {self.frames} and {self.octaves}"
            )

    def build(self, min_gaussians: int, scope: MaskScope) -> "TemporalMask":
        return TemporalMask(self, min_gaussians, scope)


class TemporalMask(Mask):
    """sigma(MLP(f_k^t, t, p_k)) > epsilon, with the features f as the column ``mask_features``.

    p is the mean in units of its instance's half size, without gradient; t and p are encoded by sines and cosines. The
    network returns a logit. The paper's formula ends the network with a sigmoid; a second sigmoid after it would keep
    every score above 0.5. The first layer sums a part for the row and a part for the time, so several times cost little
    more than one.
    """

    settings: TemporalMaskSettings
    times: Tensor
    valid: Tensor
    centers: Tensor
    half_sizes: Tensor
    limit: Tensor
    draws: Tensor

    columns = (FEATURES,)

    def __init__(self, settings: TemporalMaskSettings, min_gaussians: int, scope: MaskScope) -> None:
        super().__init__()
        self.settings = settings
        self.min_gaussians = min_gaussians
        self.sparsity_weight = settings.sparsity_weight
        encoded = 1 + 2 * settings.octaves
        self.of_row = nn.Linear(settings.features + 3 * encoded, settings.width)
        self.of_time = nn.Linear(encoded, settings.width, bias=False)
        self.hidden = nn.Linear(settings.width, settings.width)
        self.last = nn.Linear(settings.width, 1)
        nn.init.normal_(self.last.weight, std=1e-3)
        nn.init.constant_(self.last.bias, settings.initial_logit)
        for name in ("times", "valid", "centers", "half_sizes"):
            self.register_buffer(name, getattr(scope, name))
        # The limit that a score must exceed now; ``keep`` lowers it if K_min holds.
        self.register_buffer("limit", torch.tensor(settings.threshold))
        self.register_buffer("draws", torch.zeros((), dtype=torch.float64))

    def at_image(self, number: int) -> None:
        self.draws.fill_(number)

    def initial_columns(self, num_rows: int) -> dict[str, Tensor]:
        """Return random features of standard deviation 0.01, so that rows in one place can learn different masks.

        They start equal at all times.
        """
        generator = torch.Generator().manual_seed(num_rows)
        features = 0.01 * torch.randn(num_rows, self.settings.features, generator=generator)
        return {FEATURES: features.repeat(1, self.settings.feature_times)}

    def scores(self, rows: Rows, times: Float[Tensor, "#n t"]) -> Float[Tensor, "n t"]:
        """Return sigma of every row at its times, float32 under any precision."""
        with torch.autocast(rows.mask_features.device.type, enabled=False):
            features = self._features_at(rows.mask_features, times)
            places = self._encoded(self._places(rows))[:, None].expand(-1, features.shape[1], -1)
            of_row = self.of_row(torch.cat((features, places), dim=-1))
            of_time = self.of_time(self._encoded(times[..., None]))
            hidden = torch.relu(self.hidden(torch.relu(of_row + of_time)))
            return torch.sigmoid(self.last(hidden).squeeze(-1))

    def _features_at(
        self, features: Float[Tensor, "n s"], times: Float[Tensor, "#n t"]
    ) -> Float[Tensor, "n t d"] | Float[Tensor, "n 1 d"]:
        """Return f_k^t, linear between the times at which features stand; one for all times if that is one."""
        count = self.settings.feature_times
        stored = features.reshape(len(features), count, self.settings.features)
        if count == 1:
            return stored
        places = times.clamp(0, 1).expand(len(features), -1) * (count - 1)
        before = places.long().clamp(max=count - 2)
        share = (places - before)[..., None]
        lower, upper = (stored.take_along_dim(place[..., None], 1) for place in (before, before + 1))
        return torch.lerp(lower, upper, share)

    def multipliers(self, rows: Rows, time: float) -> Float[Tensor, " n"]:
        scores = self.scores(rows, self.times.new_full((1, 1), time)).squeeze(1)
        multipliers = straight_through(scores, self.limit)
        if not self.settings.image_closes and multipliers.requires_grad:
            multipliers.register_hook(lambda gradient: gradient.clamp(max=0))
        return multipliers

    def sparsity(self, rows: Rows, time: float, visible: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
        """Return the mean over the current time and T training frames of the row's instance, summed over rows."""
        drawn = self._drawn_frames()[_instances(rows)]
        now = drawn.new_full((len(rows), 1), time)
        scores = self.scores(rows, torch.cat((now, drawn), dim=1)).mean(1)
        return (scores * visible if self.settings.visible_only else scores).sum()

    @torch.no_grad()
    def keep(self, rows: Rows) -> Selection:
        """Selects the rows that are open in any training frame of their instance.

        If these are fewer than K_min, the best of the others stay too. Then the whole node shows at all times until the
        scores have recovered.
        """
        best = self._at_training_frames(rows).masked_fill(~self.valid[_instances(rows)], -1.0).amax(1)
        selection = keep_best(best, best <= self.settings.threshold, self.min_gaussians)
        self.floor_firings += selection.floor_hit
        # At the floor nothing is masked: otherwise the rows that the floor keeps would show at their best times only.
        self.limit.fill_(_ALWAYS if selection.floor_hit else self.settings.threshold)
        return selection

    @torch.no_grad()
    def finish(self, rows: Rows) -> tuple[BakedMask, dict[str, Tensor]]:
        """Return a bit per row and training frame, over the training frames of all instances."""
        times = torch.unique(self.times[self.valid])
        chunks = [self.scores(rows, part[None].expand(1, -1)) > self.limit for part in times.split(_TIMES_AT_ONCE)]
        return BakedMask(times), {BITS: packed(torch.cat(chunks, dim=1))}

    def _at_training_frames(self, rows: Rows) -> Float[Tensor, "n k"]:
        times = self.times[_instances(rows)]
        return torch.cat([self.scores(rows, part) for part in times.split(_TIMES_AT_ONCE, dim=1)], dim=1)

    def _drawn_frames(self) -> Float[Tensor, "i t"]:
        """Return T training frames of every instance, spread evenly over its frames, different ones in every step."""
        self.draws += 1
        spread = torch.arange(self.settings.frames, device=self.times.device) / max(self.settings.frames, 1)
        places = (spread + self.draws * _GOLDEN) % 1.0
        chosen = (places[None] * self.valid.sum(1, keepdim=True)).long()
        return self.times.gather(1, chosen.clamp(max=self.times.shape[1] - 1))

    def _places(self, rows: Rows) -> Float[Tensor, "n 3"]:
        instances = _instances(rows)
        return (rows.means.detach() - self.centers[instances]) / self.half_sizes[instances]

    def _encoded(self, values: Float[Tensor, "*b c"]) -> Float[Tensor, "*b e"]:
        """Return the values, and sine and cosine of pi, 2 pi, 4 pi ... times them."""
        octaves = [math.pi * 2**octave * values for octave in range(self.settings.octaves)]
        return torch.cat([values, *map(torch.sin, octaves), *map(torch.cos, octaves)], dim=-1)


def _instances(rows: Rows) -> Int[Tensor, " n"]:
    named = rows.columns().get("instances")
    return torch.zeros(len(rows), dtype=torch.int64, device=rows.means.device) if named is None else named
