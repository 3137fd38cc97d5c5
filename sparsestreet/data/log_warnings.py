"""What is probably wrong with a log that can be read: said once, before anything is trained."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.data.hood import used_share
from sparsestreet.data.lazy import Frames, spread
from sparsestreet.data.log import DrivingLog, counted
from sparsestreet.data.photo_consistency import FEWEST, gray_changes
from sparsestreet.geometry.boxes import box_at
from sparsestreet.geometry.cameras import inverse, project, transform_points
from sparsestreet.types import Frame, SparsePoints, Track, View

_MIDDLE = 0.25
"""Of width and height, the least distance of a principal point from a border: 0.27 and 0.28 of the height in Waymo's
cropped side images."""
_EXCHANGED = 0.05
"""Of a side: cx this near to half the height, and cy to half the width, are each other."""
_RATES = 0.1, 1000.0
"""Images of a camera a second. Stamps in us, ms or s for ns are at least a thousand times too fast."""
_SPEED = 100.0
"""Meters per second, three times what cars drive."""
_ACCELERATION = 30.0
"""Meters per second squared; three times what tires hold."""
_OUTLYING = 10.0
"""Times the lower quartile of a camera's accelerations: poses that tremble have no single one that is wrong."""
_COARSEST_EXACT = 2.0**-10
"""Meters: float32's grid 8 to 16 km from the origin. A finer one cannot be seen."""
_OFF_GRID = 0.05
"""Of a step of the grid, at most: views store positions in float32 near their own origin, right to 1e-5 m."""
_MIN_PLACES = 6
"""Of numbers with random digits, all six lie this near to a grid once in a million."""
_TREMBLES = 0.1
"""Meters, acceleration times the square of the step: less is noise of poses at a high rate."""
_STANDS = 0.02
"""Meters that a standing car's pose wanders. In kilometers this is 20 m."""
_APART = 4
"""Images of a camera: over 0.4 s a drive changes more of an image than the traffic that a standing car sees."""
_CHANGED = 6.0, 0.4
"""Gray levels, and the share of pixels that differ by more. Lower quartile over pairs: 0.50 to 0.78 for driven streets
and KITTI's drive 0001 (0.3 in a street by night), 0.12 to 0.25 for standing cameras. Of these, one beside which cars
pass closely has up to 0.88."""
_STRAY = 1.0
"""Meters that a box may lie beside its neighbors' line whatever its stamp: KITTI's have up to 0.11, at 2 Hz 0.18."""
_BIG = 1.5
"""Meters, the length of an object that cannot turn round within a second, and that is larger than its shell."""
_SWEEPS, _POINTS = 12, 20_000
"""Sweeps, and points of each, that are looked at in boxes: half a second."""
_SHELL, _FLOOR = 0.6, 0.15
"""Meters around a box, and about its floor, where returns are the road's."""
_MIN_RETURNS = 60
"""Of an object in all of the sweeps and its shell too; fewer say nothing."""
_INSIDE = 0.75
"""Share of returns inside of a box, of those inside or in the shell. Median over the objects of a class: cars 0.97 in
streets, 0.86 on KITTI's drive 0001; turned, exchanged or sunk ones 0.37 to 0.66, and 0.46 to 0.61."""
_GAIN = 0.15
"""By how much more another box has to hold. In right logs none of ``_OTHER_BOXES`` holds more by over 0.06, of any
object, boxes with errors of 10 cm included; where all boxes are wrong in such a way, it is 0.18 to 0.7."""
_OTHER_BOXES = (
    "",
    "turned by 90 degrees, or with length and width exchanged",
    "half a height higher (a pose is that of the center, not of the floor)",
    "half a height lower (a pose is that of the center, not of the roof)",
)
_SAID = 3
"""Objects that are named of those with one fault."""
_LIKE_ITS_POINTS = 0.2
"""Correlation of the gray levels of points with those of pixels that they fall into."""
_MAX_POINTS = 2_000
_MIN_POINTS = 100
_MAX_VIEWS = 60


def contradictions(log: DrivingLog, frames: Frames, names: Sequence[str]) -> Iterator[str]:
    """Yield a sentence for each contradiction; right logs, recorded and made, have none.

    Args:
        log: whose poses, stamps, boxes, returns and points are held against each other.
        frames: of the log, those that may be looked at.
        names: of the cameras.
    """
    own = [(name, frames.where(lambda view, index=index: view.indices[1] == index)) for index, name in enumerate(names)]
    cameras = [(name, some) for name, some in own if len(some)]
    yield from _principal_points(cameras)
    yield from (clock := list(_clock(cameras)))
    yield from (coarse := list(_coarse(log, cameras)))
    if not clock:
        yield from () if coarse else _jumps(cameras)
        yield from _first([*_box_jumps(log), *_box_turns(log)])
    yield from _frozen(cameras)
    yield from _box_returns(log)
    if log.sparse_points is not None:
        yield from (points := log.sparse_points()).notes
        yield from _unseen(points, frames, cameras)


def _first(sentences: Sequence[str]) -> Iterator[str]:
    yield from sentences[:_SAID]
    if len(sentences) > _SAID:
        yield f"{len(sentences) - _SAID} more objects have boxes as doubtful as those named before"


def _principal_points(cameras: Sequence[tuple[str, Frames]]) -> Iterator[str]:
    for name, own in cameras:
        camera = own.views[0].camera
        (cx, cy), (width, height) = camera.intrinsics[:2, 2].tolist(), (camera.width, camera.height)
        outside = any(not _MIDDLE <= at <= 1 - _MIDDLE for at in (cx / width, cy / height))
        swapped = _near(cx, height) and _near(cy, width) and not (_near(cx, width) or _near(cy, height))
        if outside or swapped:
            yield (
                f"the principal point of camera {name} is at {cx:.1f}, {cy:.1f} of {width}x{height} pixels"
                f"{', as if cx and cy were exchanged' if swapped else ', outside of the middle half'}: check cx and "
                "cy, and that they are of the size that the images have now"
            )


def _near(at: float, side: int) -> bool:
    return abs(at - side / 2) <= _EXCHANGED * side


def _clock(cameras: Sequence[tuple[str, Frames]]) -> Iterator[str]:
    """Rates and speeds that no sensor and no car has: of the first camera that shows them, for all have one clock."""
    for name, own in cameras:
        views = _stamped(own)
        if len(views) < 2 or (span := float(_seconds(views)[-1] - _seconds(views)[0])) <= 0:
            continue
        rate = (len(views) - 1) / span
        speed = float(_velocities(views).norm(dim=1).median())
        if speed > _SPEED or not _RATES[0] <= rate <= _RATES[1]:
            slow = "a finer unit than is wanted: us for ns, or ns for us"
            fast = "us, ms or s where ns are wanted" + (
                ", or lengths in another unit than meters" if rate <= _RATES[1] else ""
            )
            yield (
                f"by poses and stamps camera {name} moves by {_said(speed)} m/s and takes {_said(rate)} images a "
                f"second: the stamps may be in {slow if rate < _RATES[0] else fast}"
            )
            return


def _said(number: float) -> str:
    return f"{number:,.0f}" if number >= 100 else f"{number:.4g}"


def _jumps(cameras: Sequence[tuple[str, Frames]]) -> Iterator[str]:
    """The worst acceleration of each camera."""
    for name, own in cameras:
        views = _stamped(own)
        if len(views) < 4:
            continue
        steps = _seconds(views).diff().clamp(min=1e-3)
        changes = _velocities(views).diff(dim=0).norm(dim=1) / ((steps[1:] + steps[:-1]) / 2)
        worst, usual = float(changes.max()), float(changes.median())
        if usual > _ACCELERATION and usual * float(steps.median()) ** 2 > _TREMBLES:
            yield (
                f"the poses of camera {name} tremble: half of its accelerations exceed {usual:.0f} m/s^2; perhaps they "
                "were stored in float32 at large coordinates: write them in float64, or take an offset off before"
            )
        elif worst > max(_ACCELERATION, _OUTLYING * float(changes.quantile(0.25))):
            # A wrong frame changes the steps on both of its sides, and with them three accelerations.
            three = torch.nn.functional.pad(changes, (1, 1)).unfold(0, 3, 1).sum(1)
            yield (
                f"by its poses and stamps camera {name} is accelerated by {worst:.0f} m/s^2 around frame "
                f"{views[int(three.argmax()) + 1].indices[0]}: check pose and stamp there"
            )


def _coarse(log: DrivingLog, cameras: Sequence[tuple[str, Frames]]) -> Iterator[str]:
    """Positions on the grid that float32 has at their size, which tremble from one of its points to another."""
    paths = [("the vehicle", log.vehicle.poses[:, :3, 3])] if log.vehicle is not None else []
    paths += [(f"camera {name}", _positions(own.views)) for name, own in cameras]
    for what, path in paths:
        at = path + log.dataset_from_world[:3, 3]
        for axis in sorted(at.T, key=lambda axis: -float(axis.abs().min())):
            grid = 2.0 ** (math.floor(math.log2(max(float(axis.abs().min()), 1.0))) - 23)
            trembles = bool((axis.diff().diff().abs() > grid / 2).any())
            beside = (axis / grid - (axis / grid).round()).abs().max()
            if grid >= _COARSEST_EXACT and trembles and len(axis.unique()) >= _MIN_PLACES and beside < _OFF_GRID:
                yield (
                    f"all positions of {what} are multiples of {grid:.4g} m, the grid of float32 at "
                    f"{float(axis.abs().max()):,.0f} m, so poses tremble: write them in float64, or take an offset "
                    "off before they are stored"
                )
                return


def _frozen(cameras: Sequence[tuple[str, Frames]]) -> Iterator[str]:
    """What all cameras that stand by their poses show: traffic may fill the images of one."""
    standing = {name: pairs for name, own in cameras if len(pairs := _standing_pairs(own)) > 1}
    found = {}
    for name, own in cameras:
        pairs = standing.get(name, [])
        shares = [_changed(own[a], own[b]) for a, b in (pairs[at] for at in spread(len(pairs), 8) if pairs)]
        if shares and (share := float(torch.tensor(shares).quantile(0.25))) > _CHANGED[1]:
            found[name] = share
    if found and 4 * len(found) >= 3 * len(standing):
        times = max(len(standing[name]) for name in found)
        yield (
            f"{min(found.values()):.0%} of the pixels of camera {', '.join(found)} change over up to {_APART} images "
            f"({times} times), while poses stay within {1000 * _STANDS:g} mm: lengths are wanted in meters, and each "
            "image needs a pose of its own"
        )


def _standing_pairs(own: Frames) -> list[tuple[int, int]]:
    apart = min(_APART, (len(own) - 1) // 2)
    ends = [(at, at + apart) for at in range(len(own) - apart)] if apart else []
    return [(a, b) for a, b in ends if _same_pose(own.views[a], own.views[b])]


def _same_pose(a: View, b: View) -> bool:
    """Whether a camera has not moved from one view to the other, nor turned by a pixel of ``_small``."""
    turned = a.camera.camera_from_world[:3, :3] - b.camera.camera_from_world[:3, :3]
    pixels = float(turned.norm()) / math.sqrt(2) * float(a.camera.intrinsics[0, 0])
    return (
        pixels < _shrunk(a.camera.width, a.camera.height)
        and float((a.camera.position - b.camera.position).norm()) < _STANDS
    )


def _changed(a: Frame, b: Frame) -> float:
    """Share of pixels, of small images at one brightness."""
    small = [_small(frame) for frame in (a, b)]
    small[1] *= small[0].mean() / small[1].mean().clamp(min=1.0)
    return float(((small[0] - small[1]).abs() > _CHANGED[0]).float().mean())


def _small(frame: Frame) -> Float[Tensor, "h w"]:
    gray = frame.image.float().mean(-1)[None]
    return torch.nn.functional.avg_pool2d(gray, _shrunk(*gray.shape[1:]))[0]


def _shrunk(*sides: int) -> int:
    """Pixels of an image to one of a small one, whose shorter side has 24."""
    return max(1, min(sides) // 24)


def _box_jumps(log: DrivingLog) -> Iterator[str]:
    """Of each object its speed, or the box that is the farthest from the line of its neighbors."""
    for track, steps in _steps(log):
        centers, what = track.world_from_object[:, :3, 3], f"object {track.name} ({track.class_name})"
        speed = float((centers.diff(dim=0).norm(dim=1) / steps).median())
        if speed > _SPEED:
            yield f"{what} moves by {speed:,.0f} m/s: check its boxes, or give another object another name"
        elif len(steps) > 1 and (at := _stray(centers, steps)) is not None:
            yield (
                f"{what} jumps: at frame {int(track.frames[at[0]])} its box is {at[1]:.1f} m beside the line of its "
                "neighbors: check its pose there, or give another object another name"
            )


def _box_turns(log: DrivingLog) -> Iterator[str]:
    for track, steps in _steps(log):
        axes = track.world_from_object[:, :3, :3]
        cosines = ((axes[1:] * axes[:-1]).sum((1, 2)) - 1) / 2
        turns = torch.rad2deg(torch.acos(cosines.clamp(-1, 1))) * (steps <= 1.0)
        worst = int(turns.argmax())
        if float(turns[worst]) > 90 and float(track.size[:2].max()) >= _BIG:
            yield (
                f"object {track.name} ({track.class_name}) turns by {float(turns[worst]):.0f} degrees from frame "
                f"{int(track.frames[worst])} to {int(track.frames[worst + 1])}: check its heading there; the x of a "
                "box points ahead"
            )


def _steps(log: DrivingLog) -> Iterator[tuple[Track, Float64[Tensor, " s"]]]:
    """Objects with several boxes, and the seconds from each to the next; without a clock a tenth a frame."""
    known = sorted((view.time, view.seconds) for view in log.views if view.seconds is not None)
    (first, start), (last, end) = (known[0], known[-1]) if known else ((0.0, 0.0), (0.0, 0.0))
    for track in log.tracks:
        if len(track.frames) > 1:
            times = track.frames.double() * 0.1
            if track.times is not None and last > first:
                times = track.times * ((end - start) / (last - first))
            yield track, times.diff().clamp(min=1e-3)


def _stray(centers: Float64[Tensor, "f 3"], steps: Float64[Tensor, " s"]) -> tuple[int, float] | None:
    """Place of the box that is the farthest beside its neighbors' line, and how far, where no car does so."""
    before, after = steps[:-1], steps[1:]
    part = (before / (before + after))[:, None]
    beside = (centers[1:-1] - torch.lerp(centers[:-2], centers[2:], part)).norm(dim=1)
    # One wrong box is beside its line and so are both neighbors: of few boxes that is half of them.
    usual = float(beside.quantile(0.25)) if len(beside) > 3 else 0.0
    allowed = (_ACCELERATION / 2 * before * after).clamp(min=max(_STRAY, _OUTLYING * usual))
    worst = int((beside - allowed).argmax())
    return (worst + 1, float(beside[worst])) if beside[worst] > allowed[worst] else None


def _box_returns(log: DrivingLog) -> Iterator[str]:
    if not log.tracks or not len(log.sweeps):
        return
    shares = _inside_shares(log)
    for kind in sorted({track.class_name for track, _ in shares}):
        own = [(track, share) for track, share in shares if track.class_name == kind]
        usual = torch.stack([share for _, share in own]).median(0).values
        big = any(float(track.size[:2].max()) >= _BIG for track, _ in own)
        if _other_box(usual) or (big and float(usual[0]) < _INSIDE):
            yield _held(f"boxes of {kind} ({_listed([track.name for track, _ in own])})", usual)
        else:
            wrong = [(track, share) for track, share in own if _other_box(share)]
            yield from _first([_held(f"the boxes of object {track.name} ({kind})", share) for track, share in wrong])


def _other_box(share: Float[Tensor, " boxes"]) -> int:
    """Which of ``_OTHER_BOXES`` holds the returns better; 0: none."""
    best = int(share.argmax())
    return best if float(share[best]) >= max(_INSIDE, float(share[0]) + _GAIN) else 0


def _held(what: str, share: Float[Tensor, " boxes"]) -> str:
    other = _other_box(share)
    return (
        f"{what} hold {float(share[0]):.2f} of the returns in and {_SHELL:g} m around them, right ones hold more than "
        f"{_INSIDE}: "
        + (
            f"{float(share[other]):.2f} if they were {_OTHER_BOXES[other]}"
            if other
            else "check the poses, sizes and stamps of boxes and lidar"
        )
    )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _inside_shares(log: DrivingLog) -> list[tuple[Track, Float[Tensor, " boxes"]]]:
    """Objects with enough returns, and which share of them each of ``_OTHER_BOXES`` holds."""
    counts = torch.zeros(len(log.tracks), len(_OTHER_BOXES), 2)
    for place in spread(len(log.sweeps), _SWEEPS):
        sweep = log.sweeps.load_gray(log.sweeps.indices[place])
        points = sweep.points[:: len(sweep.points) // _POINTS + 1].double()
        owner = torch.full((len(points),), -1)
        near = []
        for number, track in enumerate(log.tracks):
            if (world_from_box := box_at(track, sweep.index, sweep.time)) is None:
                continue
            reach = float(track.size.norm()) / 2 + float(track.size[2]) / 2 + _SHELL
            rows = ((points - world_from_box[:3, 3]).abs() <= reach).all(1).nonzero().squeeze(1)
            in_box = transform_points(inverse(world_from_box), points[rows])
            owner[rows[(in_box.abs() <= track.size / 2).all(1)]] = number
            near.append((number, rows, in_box))
        for number, rows, in_box in near:
            free = (owner[rows] == -1) | (owner[rows] == number)
            counts[number] += _counted(in_box[free], log.tracks[number].size)
    enough = counts[:, 0].sum(1) >= _MIN_RETURNS
    shares = counts[..., 0] / counts.sum(-1).clamp(min=1)
    return [(track, shares[at]) for at, track in enumerate(log.tracks) if enough[at]]


def _counted(points: Float64[Tensor, "n 3"], size: Float[Tensor, "3"]) -> Float[Tensor, "boxes 2"]:
    """Return inside of each of ``_OTHER_BOXES``, and in the shell around it, the road near its floor left out.

    Far below the floor there is nothing: the shell goes on from twice ``_FLOOR`` below it.
    """
    up = torch.tensor([0.0, 0.0, float(size[2]) / 2], dtype=torch.float64)
    found = []
    for moved, sides in ((0, size), (0, size[[1, 0, 2]]), (1, size), (-1, size)):
        at, half = points - moved * up, sides.double() / 2
        height = at[:, 2] + half[2]
        inside, shell = (at.abs() <= half).all(1), (at.abs() <= half + _SHELL).all(1)
        above, below = height > _FLOOR, height < -2 * _FLOOR
        found.append([int((inside & above).sum()), int((shell & ~inside & (above | below)).sum())])
    return torch.tensor(found, dtype=torch.float32)


def _unseen(points: SparsePoints, frames: Frames, cameras: Sequence[tuple[str, Frames]]) -> Iterator[str]:
    step = len(points) // _MAX_POINTS + 1
    positions = points.positions[::step]
    if len(positions) < _MIN_POINTS:
        return
    seen = torch.zeros(len(positions), dtype=torch.bool)
    for name, own in cameras:
        found = [project(own.views[at].camera, positions)[2] for at in spread(len(own), _MAX_VIEWS)]
        seen |= torch.stack(found).any(0)
        blind = sum(not some.any() for some in found)
        if 2 * blind > len(found):
            yield f"camera {name} sees none of the log's own points in {blind} of {len(found)} images: {_CHECK_POSES}"
    share = float(seen.float().mean())
    if share < 0.5:
        yield f"the log's images see {share:.0%} of its {len(points):,} own points: {_CHECK_POSES}"
    yield from _other_colors(positions, points.colors[::step].mean(1), frames)


_CHECK_POSES = (
    "check that poses and points are of one world and unit, that quaternions have w first (COLMAP: world to camera), "
    "and the axes of the cameras"
)


def _other_colors(positions: Float[Tensor, "n 3"], gray: Float[Tensor, " n"], frames: Frames) -> Iterator[str]:
    pairs = []
    for at in spread(len(frames), 12):
        frame = frames[at]
        pixels, _, seen = project(frame.camera, positions)
        column, row = pixels[seen].long().unbind(1)
        pairs.append(torch.stack((gray[seen], frame.image[row, column].float().mean(1) / 255)))
    both = torch.cat(pairs, 1)
    if both.shape[1] < _MIN_POINTS or float(both.std(1).min()) < 0.02:
        return
    alike = float(torch.corrcoef(both)[0, 1])
    if alike < _LIKE_ITS_POINTS:
        yield (
            f"gray levels of the log's own points and of the pixels that they fall into correlate by {alike:.2f}: "
            f"{_CHECK_POSES}"
        )


def _stamped(frames: Frames) -> list[View]:
    return [view for view in frames.views if view.seconds is not None]


def _seconds(views: Sequence[View]) -> Float64[Tensor, " v"]:
    return torch.tensor([view.seconds for view in views], dtype=torch.float64)


def _positions(views: Sequence[View]) -> Float64[Tensor, "v 3"]:
    return torch.stack([view.camera.position for view in views]).double()


def _velocities(views: Sequence[View]) -> Float64[Tensor, "s 3"]:
    """Meters per second from each view to the next; stamps of ns for s are not rounded to a standstill."""
    return _positions(views).diff(dim=0) / _seconds(views).diff().clamp(min=1e-9)[:, None]


MAX_FRAMES = 36
"""Images that are looked at."""
_LITTLE = 0.05
"""Of all pixels: fewer that losses see are more likely a mask that is turned round."""
_FLAT = 3.0
"""Gray levels, standard deviation over an image, below which it shows nothing."""
_UNLIKE = 1.0
"""Of ``followed``: 0.3 to 0.8 where poses are right, 1.03 and more where the axes of a camera are swapped."""
_SAME = 0.25
"""Of the sides of a box: a second center this near is that of the same object, if its volume is half as large."""


def log_warnings(log: DrivingLog, frames: Frames | None = None) -> tuple[str, ...]:
    """One sentence each, with what to do; empty for a log without any. Takes a second or two.

    ``frames`` are those that are looked at; None: all of the log.
    """
    frames = log.frames if frames is None else frames
    names = log.camera_names or tuple(map(str, range(log.num_cameras)))
    return (
        *_covered(frames, names),
        *_swapped(frames, log, names),
        *contradictions(log, frames, names),
        *_shared_boxes(log.tracks),
    )


def _covered(frames: Frames, names: Sequence[str]) -> Iterator[str]:
    seen, flat, blind, used = Counter[int](), Counter[int](), Counter[int](), defaultdict[int, float](float)
    for place in spread(len(frames), MAX_FRAMES):
        frame = frames[place]
        camera = frame.indices[1]
        gray = frame.image.float().mean(-1)
        seen[camera] += 1
        share = used_share(frame)
        used[camera] += share
        blind[camera] += not share
        gray = gray if frame.ego is None else gray[~frame.ego]
        flat[camera] += share > 0 and float(gray.std(correction=0)) < _FLAT
    for camera in (camera for camera in sorted(seen) if used[camera] / seen[camera] < _LITTLE):
        yield (
            f"masks or alpha leave {100 * used[camera] / seen[camera]:.2g} % of the pixels of camera {names[camera]} "
            "to be used: check which color of its masks is left out, or leave the camera out (data.log.cameras)"
        )
        blind[camera] = 0
    for camera in sorted(camera for camera in seen if blind[camera]):
        yield (
            f"masks or alpha leave no pixel in {blind[camera]} of {seen[camera]} images of camera {names[camera]}: "
            "check these masks, nothing is learned from such images"
        )
    for camera in sorted(camera for camera in seen if flat[camera]):
        yield (
            f"camera {names[camera]} shows a single gray level in {flat[camera]} of {seen[camera]} images, as if it "
            "were covered: leave it out (data.log.cameras), or mask what it shows (data.log.masks)"
        )


def _swapped(frames: Frames, log: DrivingLog, names: Sequence[str]) -> Iterator[str]:
    for camera, change in gray_changes(frames, log.sweeps, log.tracks).items() if len(log.sweeps) else ():
        if change is None:
            yield (
                f"camera {names[camera]} sees hardly any return of the lidar (below {FEWEST} an image): check the axes "
                "of camera and poses (OpenCV: x right, y down, z ahead), unless it looks where no lidar reaches"
            )
        elif change >= _UNLIKE:
            yield (
                f"returns of the lidar change their gray level {change:.1f} times as much if camera {names[camera]} is "
                "followed along its poses as if it stood still: check the axes of camera and poses (OpenCV: x right, y "
                "down, z ahead) and the stamps, or mask the recording car where the image shows it (data.log.masks)"
            )


def _shared_boxes(tracks: Sequence[Track]) -> Iterator[str]:
    same, inside = Counter[tuple[int, int]](), Counter[tuple[int, int]]()
    present: dict[int, list[tuple[int, Tensor]]] = {}
    for number, track in enumerate(tracks):
        for frame, pose in zip(track.frames.tolist(), track.world_from_object, strict=True):
            present.setdefault(frame, []).append((number, pose))
    for boxes in present.values():
        for large, small, beside in _within(tracks, boxes):
            alike = float(tracks[small].size.prod()) > 0.5 * float(tracks[large].size.prod())
            (same if alike and beside < _SAME else inside)[large, small] += 1
    for (large, small), count in same.items():
        if 2 * count >= len(tracks[small].frames):
            yield (
                f"objects {tracks[large].name} and {tracks[small].name} ({tracks[small].class_name}) have one box in "
                f"{counted(count, 'frame')}: remove one of them, or both are drawn"
            )
    for (large, small), count in inside.items():
        if 2 * count >= len(tracks[small].frames):
            yield (
                f"object {tracks[small].name} ({tracks[small].class_name}) is inside the box of {tracks[large].name} "
                f"({tracks[large].class_name}) in {counted(count, 'frame')}: both start from what is seen there; "
                "remove the one that needs no motion of its own"
            )


def _within(tracks: Sequence[Track], boxes: Sequence[tuple[int, Tensor]]) -> Iterator[tuple[int, int, float]]:
    """Pairs of one frame of which the smaller box has its center in the larger one, and how far beside the middle: the
    largest part of a side."""
    centers = torch.stack([pose[:3, 3] for _, pose in boxes])
    reach = max(float(tracks[number].size.max()) for number, _ in boxes) / 2
    for one, other in torch.nonzero(torch.cdist(centers, centers) <= reach).tolist():
        (large, pose), (small, _) = boxes[one], boxes[other]
        volumes = [(float(tracks[number].size.prod()), -number) for number in (large, small)]
        if one == other or volumes[0] < volumes[1]:
            continue
        offset = pose[:3, :3].T @ (centers[other] - centers[one])
        beside = float((offset.abs() / tracks[large].size).max())
        if beside <= 0.5:
            yield large, small, beside
