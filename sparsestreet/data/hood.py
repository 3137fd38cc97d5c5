"""Find pixels that do not show the street: the car's hood, what is masked of it, and dirt on a lens."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation, label, median_filter, uniform_filter
from torch import Tensor

from sparsestreet.data.lazy import Frames, Sweeps, spread
from sparsestreet.data.photo_consistency import ReturnPairs, return_pairs
from sparsestreet.geometry.cameras import project
from sparsestreet.types import Frame, Track

MAX_FRAMES = 40
"""Of a camera; a hundred megabytes at 960x640."""
MIN_DRIVE = 20.0
"""Meters the camera has to move, so that the street has changed in every image."""
MIN_WIDTH = 0.25
"""Share of the image's columns in which a hood is seen. Smooth road over a straight line looks like one in up to 8 % of
the columns of synthetic streets."""
_STILL = 4.0
"""Gray levels of 255: the median change of a pixel that shows the same."""
_EDGE = 8.0
"""Gray levels across the hood's upper edge, in the median image."""
_SAME = 0.7
"""Share of the edges of single images that the median image keeps; a moving edge is blurred."""
_PAIRS = 20
"""Images of a camera that are compared with the next one."""
_MIN_RETURNS = 100
_JUMP = 2
"""Rows from one column to the next by which a hood's edge does not move: the line is a median over many columns."""
_HOOD_CHANGES = 0.65
"""Change of the gray level at a return's old place, over that at its new one: above this it is street. Smooth road has
1.0 to 1.5, and 0.8 with poses that are a pixel off; a hood that mirrors the street 0.5 (streets of 96x64)."""


@dataclass(frozen=True)
class Hood:
    """What one camera sees of the car that carries it."""

    mask: Bool[Tensor, "h w"]
    """With the row of its upper edge, whose pixels show both."""
    error: float
    """Half the difference between the shares of the image that even and odd images give."""

    @property
    def share(self) -> float:
        """Of the image, without the row of the edge."""
        return _share(self.mask)


def _share(mask: Bool[Tensor, "h w"]) -> float:
    return float((mask[1:] & mask[:-1]).sum()) / mask.numel()


def find_hoods(frames: Frames, sweeps: Sweeps) -> dict[int, Hood]:
    """Camera index -> what it sees of its car, of the cameras that moved; an empty mask where it sees nothing of it.

    Smooth road below a straight curb stays the same too. So what stays the same is no hood where the lidar's returns in
    it look like the street that moves by.
    """
    found = {}
    for camera in sorted({view.indices[1] for view in frames.views}):
        own = frames.where(lambda view, camera=camera: view.indices[1] == camera)
        if driven(own) >= MIN_DRIVE:
            gray = torch.stack([own[place].image.float().mean(-1) for place in spread(len(own), MAX_FRAMES)])
            mask = _seen_still(gray)
            mask = _without_street(mask, own, sweeps)
            if not mask.any():
                found[camera] = Hood(mask, 0.0)
                continue
            shares = [_share(_seen_still(part)) for part in (gray[::2], gray[1::2])]
            found[camera] = Hood(mask, abs(shares[0] - shares[1]) / 2)
    return found


def _seen_still(gray: Float[Tensor, "f h w"]) -> Bool[Tensor, "h w"]:
    """What stays the same in the images as they are, or at one brightness, where the camera's exposure changes."""
    levels = gray.mean((1, 2), keepdim=True)
    found = [_below_a_still_edge(images) for images in (gray, gray * levels.mean() / levels.clamp(min=1.0))]
    return max(found, key=_share)


def _without_street(mask: Bool[Tensor, "h w"], frames: Frames, sweeps: Sweeps) -> Bool[Tensor, "h w"]:
    """The mask without the columns in which its edge is one of the street: those get their neighbors' edge.

    An edge is looked at piece by piece, between the columns at which it jumps; pieces with few returns count as one.
    Where the lidar does not reach, nothing speaks against a hood.
    """
    heights = mask.sum(0)
    piece = torch.cat((heights.new_zeros(1), (heights[1:] - heights[:-1]).abs() > _JUMP)).cumsum(0)
    moved, stayed, columns = _followed(mask, frames, sweeps)
    returns = piece[columns].bincount(minlength=len(heights))[piece]
    piece = torch.where(returns < _MIN_RETURNS, -1, piece)
    street = torch.zeros_like(piece, dtype=torch.bool)
    for one in piece.unique():
        own = piece[columns] == one
        if int(own.sum()) >= _MIN_RETURNS:
            street[piece == one] = float(stayed[own].mean()) > _HOOD_CHANGES * float(moved[own].mean())
    if not street.any():
        return mask
    return _below_line(len(mask) - heights, (heights > 0) & ~street, len(mask))


def _followed(
    mask: Bool[Tensor, "h w"], frames: Frames, sweeps: Sweeps
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"], Int[Tensor, " n"]]:
    """Of returns in the mask, how far the gray level of the next image is off, and their columns.

    A street has the level of the first image at the return's new place (first result), a hood at its old (second).
    """
    places = {index: place for place, index in enumerate(sweeps.indices)}
    inner = mask.clone()
    inner[2:] &= mask[:-2]  # away from the edge, where a pixel shows both
    inner[:2] = False
    moved, stayed, columns = [torch.zeros(0)], [torch.zeros(0)], [torch.zeros(0, dtype=torch.int64)]
    for place in spread(len(frames) - 1, _PAIRS):
        first, second = frames[place], frames[place + 1]
        if first.indices[0] not in places:
            continue
        points = sweeps[places[first.indices[0]]].points
        here, _, seen = project(first.camera, points)
        there, _, still_seen = project(second.camera, points)
        both = seen & still_seen
        old, new = (pixels[both].long().clamp(min=0).unbind(1) for pixels in (here, there))
        within = inner[old[1], old[0]]
        old, new = (tuple(axis[within] for axis in pixels) for pixels in (old, new))
        before, after = (frame.image.float().mean(-1) for frame in (first, second))
        level = before[old[1], old[0]]
        moved.append((after[new[1], new[0]] - level).abs())
        stayed.append((after[old[1], old[0]] - level).abs())
        columns.append(old[0])
    return torch.cat(moved), torch.cat(stayed), torch.cat(columns)


def with_ego(frames: Frames, masks: Mapping[int, Bool[Tensor, "h w"]]) -> Frames:
    """Return frames that have each camera's mask among their ``ego`` pixels; nothing is read before it is indexed."""
    seen = {camera: mask for camera, mask in masks.items() if mask.any()}
    if not seen:
        return frames

    def load(view: Frame) -> Frame:
        frame, mask = frames.load(view), seen.get(view.indices[1])
        if mask is None:
            return frame
        return replace(frame, ego=mask if frame.ego is None else mask | frame.ego)

    return Frames(frames.keys, load, frames.forecast)


def driven(frames: Frames) -> float:
    """Meters along the path of a camera."""
    centers = torch.stack([view.camera.position for view in frames.views])
    return float((centers[1:] - centers[:-1]).norm(dim=1).sum())


def _below_a_still_edge(gray: Float[Tensor, "f h w"]) -> Bool[Tensor, "h w"]:
    """Pixels that stay the same down to the lower border, below an edge that stays as well, where it is wide enough.

    Of several such edges in a column (smooth road above the hood stays the same too) the steepest counts.
    """
    middle = gray.median(0).values
    still = (gray - middle).abs().median(0).values < _STILL
    rows = still.flip(0).cumprod(0).flip(0).bool()  # still, and all pixels below
    rows[:-1] |= rows[1:].clone()  # an edge lies between two rows, of which the upper one changes
    slope = (middle[1:] - middle[:-1]).abs()
    stays = (slope > _EDGE) & (slope > _SAME * (gray[:, 1:] - gray[:, :-1]).abs().median(0).values)
    slope = torch.where(stays & rows[:-1], slope, 0.0)
    steepest, tops = slope.max(0)
    return _below_line(tops, steepest > 0, len(rows))


def _below_line(tops: Int[Tensor, " w"], ends: Bool[Tensor, " w"], height: int) -> Bool[Tensor, "h w"]:
    """Pixels below a smooth line through the tops of the columns that have one; none where these are too few."""
    columns = torch.arange(len(tops))
    if float(ends.float().mean()) < MIN_WIDTH:
        return torch.zeros(height, len(tops), dtype=torch.bool)
    # A column whose reflection or road hides the edge is like its neighbors; the row of the edge itself is half street.
    found = columns[ends].numpy()
    line = np.interp(columns.numpy(), found, tops[ends].numpy())
    line = median_filter(line, max(len(tops) // 8, 9), mode="nearest")
    inside = (columns >= int(found[0])) & (columns <= int(found[-1]))
    return (torch.arange(height)[:, None] >= torch.from_numpy(line).floor()) & inside


def bottom_rows(size: tuple[int, int], rows: int, recorded_height: int) -> Bool[Tensor, "h w"]:
    """True in the lowest ``rows`` of images that were recorded ``recorded_height`` rows high, at (width, height).

    A row of a scaled image that holds some of them is among them.
    """
    width, height = size
    mask = torch.zeros(height, width, dtype=torch.bool)
    mask[(recorded_height - rows) * height // recorded_height :] = True
    return mask


def used_share(frame: Frame) -> float:
    """Return the share of an image's pixels that losses see."""
    return 1.0 if frame.ego is None else float((~frame.ego).float().mean())


def check_used(frames: Frames, name: str) -> None:
    """Raise ValueError where no pixel of any image is used; ``name`` is the log's. Images are decoded up to the first
    that has one."""
    if len(frames) and not any(used_share(frame) for frame in frames):
        raise ValueError(
            f"{len(frames)} of {len(frames)} images of {name!r} have no pixel that is used, because masks or alpha "
            "leave all of them out: turn the masks round (mask_path: black is not used; ego masks: white is not used)"
        )


_DIRT_STILL = 6.0
"""Gray levels of 255: the median change of a pixel behind a spot. What passes is dimmed, not hidden."""
_DARKER = 12.0
"""Gray levels by which a spot is darker than what is around it, in the median image."""
_AROUND = 0.25
"""Of the image's width: a spot is compared with the mean of a square of this side, and is smaller than it."""
_FEWEST = 8
"""Pixels of a spot, and returns that are followed out of it."""
_CHANGES = 0.2
"""Change of the gray level at a return's old pixel, over that at its new one, below which it was a spot that was seen:
0.01 to 0.13 of planted ones. Curbs and joints along the road, which stay the same too, have 0.3 and more."""
_SOFT = 0.5
"""Of a spot's radius: so far beyond its dark middle it is masked."""


def find_dirt(frames: Frames, sweeps: Sweeps, tracks: Sequence[Track]) -> dict[int, Hood]:
    """Camera index -> the spots that its images show, of the cameras that moved; an empty mask where there are none.

    Curbs and road below them stay the same too. So a spot counts where returns of the lidar that are followed out of it
    change their gray level, and the pixels that they leave do not. Without lidar nothing is found.
    """
    found = {}
    for camera in sorted({view.indices[1] for view in frames.views}):
        own = frames.where(lambda view, camera=camera: view.indices[1] == camera)
        if driven(own) < MIN_DRIVE:
            continue
        seen = [own[place] for place in spread(len(own), MAX_FRAMES)]
        gray = torch.stack([frame.image.float().mean(-1) for frame in seen])
        told = torch.ones(gray.shape[1:], dtype=torch.bool)
        for frame in seen:
            for mask in (frame.sky, frame.ego):
                told &= torch.ones_like(told) if mask is None else ~mask
        returns = list(return_pairs(own, sweeps, tracks))
        masks = [_spots(part, told, returns) for part in (gray, gray[::2], gray[1::2])]
        even, odd = (float(mask.float().mean()) for mask in masks[1:])
        found[camera] = Hood(masks[0], abs(even - odd) / 2)
    return found


def _spots(
    gray: Float[Tensor, "f h w"], told: Bool[Tensor, "h w"], returns: Sequence[ReturnPairs]
) -> Bool[Tensor, "h w"]:
    levels = gray.mean((1, 2), keepdim=True)
    gray = gray * levels.median() / levels.clamp(min=1.0)  # exposure may change
    middle = gray.median(0).values
    still = (gray - middle).abs().median(0).values < _DIRT_STILL
    side = round(_AROUND * middle.shape[1]) | 1
    around = torch.from_numpy(uniform_filter(middle.numpy(), side, mode="nearest"))
    places = np.empty(middle.shape, np.int32)
    dark = (still & told & (middle < around - _DARKER)).numpy()
    count = int(label(dark, output=places))  # pyright: ignore[reportArgumentType]: with an output it returns the number
    mask = np.zeros(middle.shape, dtype=bool)
    for spot in _whole(places, count, side):
        if _hides(torch.from_numpy(spot), returns):
            mask |= binary_dilation(spot, iterations=max(round(_SOFT * np.sqrt(spot.sum() / np.pi)), 1))
    return torch.from_numpy(mask)


def _hides(spot: Bool[Tensor, "h w"], returns: Sequence[ReturnPairs]) -> bool:
    """Whether what is followed out of the spot looks another way, and the spot does not."""
    leave = [spot[each.old] & ~spot[each.new] for each in returns]
    if sum(int(some.sum()) for some in leave) < _FEWEST:
        return False
    stayed, moved = (
        float(torch.cat([part[some] for part, some in zip(parts, leave, strict=True)]).mean())
        for parts in ([each.stayed for each in returns], [each.moved for each in returns])
    )
    return stayed < _CHANGES * moved


def _whole(places: np.ndarray, count: int, side: int) -> Iterator[Bool[np.ndarray, "h w"]]:
    """Spots of enough pixels that are no line and no larger than what they are compared with."""
    for number in range(1, count + 1):
        spot = places == number
        rows, columns = np.nonzero(spot)
        height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
        if len(rows) >= _FEWEST and max(height, width) <= min(side, 3 * min(height, width)):
            yield spot
