"""Find what moves in the lidar of drives, and compare it with their boxes: ``python -m benchmarks.found_tracks``."""

import os
import resource
import shlex
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float64
from scipy.optimize import linear_sum_assignment

from benchmarks.hard_streets import (
    SMALL,
    SPINNING_32,
    Boxes,
    Seen,
    boxes_of,
    hard_streets,
    points_by_frame,
    true_boxes,
)
from sparsestreet.cli.commands.bench import record_file
from sparsestreet.cli.commands.options import run_command
from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.nuscenes import NuScenesReader
from sparsestreet.data.synthetic import StreetReader, StreetSettings
from sparsestreet.data.synthetic.world import build_world
from sparsestreet.tracking.find import find_objects
from sparsestreet.tracking.scans import Scan
from sparsestreet.tracking.settings import TrackingSettings
from sparsestreet.tracking.street import scans_of

MIN_IOU, MAX_OFF = 0.3, 1.0
"""Least intersection over union in plan, and greatest distance of middles, meters, of boxes that match."""


def streets(seeds: Sequence[int], sparse: Sequence[int], slow: Sequence[int], crowds: Sequence[int]) -> dict[str, Any]:
    """Return settings of streets by name: at 10 Hz with 64 beams, with 32, at 2 Hz, and with people who cross."""
    made = {f"street_{seed}": replace(SMALL, seed=seed) for seed in seeds}
    made |= {f"street_{seed}_32_beams": replace(SMALL, seed=seed, lidar=SPINNING_32) for seed in sparse}
    made |= {f"street_{seed}_2_hz": replace(SMALL, seed=seed, frame_rate=2.0, num_frames=20) for seed in slow}
    return made | {f"street_{seed}_crowd": replace(SMALL, seed=seed, num_crossing=3) for seed in crowds}


STREETS = {
    "tune": streets((3, 4, 5, 6, 7), (4, 5), (5, 6), (3, 7)),
    "test": streets((12, 13, 14, 15, 16), (12, 13), (14,), (15,)),
}
"""Thresholds were chosen on the first; the others were looked at once, when all was chosen."""
HARD = {"hard_tune": (3, 5), "hard": (12,)}
"""Seeds of hard streets, likewise."""
RECORDED: dict[str, Callable[[Path], Any]] = {
    "kitti_0001": lambda data: DriveStudioReader(root=data / "kitti_0001"),
    "kitti_0001_nuscenes": lambda data: NuScenesReader(root=data / "kitti_0001_nuscenes", scene="scene-0001"),
    "kitti_0001_nuscenes_2hz": lambda data: NuScenesReader(root=data / "kitti_0001_nuscenes_2hz", scene="scene-0001"),
}
"""Drives below ``$SPARSESTREET_DATA``."""


def overlap(one: Float64[np.ndarray, "4 2"], other: Float64[np.ndarray, "4 2"]) -> float:
    """Return intersection over union of two convex outlines: one is cut at each side of the other in turn."""
    polygon = one
    for start, end in zip(other, np.roll(other, -1, 0), strict=True):
        along, cut = end - start, []
        inner = along[0] * (polygon[:, 1] - start[1]) - along[1] * (polygon[:, 0] - start[0])
        for k in range(len(polygon)):
            a, b, at_a, at_b = polygon[k - 1], polygon[k], inner[k - 1], inner[k]
            if (at_a >= 0) != (at_b >= 0):
                cut.append(a + (b - a) * at_a / (at_a - at_b))
            if at_b >= 0:
                cut.append(b)
        polygon = np.array(cut).reshape(-1, 2)
    common, total = area(polygon), area(one) + area(other)
    return common / (total - common)


def area(polygon: Float64[np.ndarray, "n 2"]) -> float:
    """Return the area within a counterclockwise outline, square meters."""
    following = np.roll(polygon, -1, 0)
    return float((polygon[:, 0] * following[:, 1] - polygon[:, 1] * following[:, 0]).sum() / 2)


def annotated(log: DrivingLog, scans: Sequence[Scan]) -> list[Boxes]:
    """Return the annotated objects that move."""
    points = points_by_frame(scans)
    made = []
    for track in log.tracks:
        poses = dict(zip(track.frames.tolist(), track.world_from_object.double().numpy(), strict=True))
        made.append(boxes_of(track.name, track.class_name, track.size.double().numpy(), poses, points))
    return [one for one in made if one.moves]


@dataclass
class Matches:
    """Pairs (frame, annotated, found) that match, and what did not."""

    pairs: list[tuple[int, int, int]] = field(default_factory=list)

    @staticmethod
    def of(truth: Sequence[Boxes], found: Sequence[Boxes], frames: Iterable[int]) -> "Matches":
        """Match the boxes of each frame, so that the sum of their overlaps is greatest."""
        pairs = []
        for frame in frames:
            rows = [k for k, one in enumerate(truth) if frame in one.poses]
            columns = [k for k, one in enumerate(found) if frame in one.poses]
            gain = np.array([[gained(truth[r], found[c], frame) for c in columns] for r in rows])
            gain = gain.reshape(len(rows), len(columns))  # either may be none
            for r, c in zip(*linear_sum_assignment(-gain), strict=True):
                if gain[r, c] > 0:
                    pairs.append((frame, rows[r], columns[c]))
        return Matches(pairs)


def gained(one: Boxes, other: Boxes, frame: int) -> float:
    """Return the overlap of two boxes that may match, else 0."""
    if np.linalg.norm(one.poses[frame][:2, 3] - other.poses[frame][:2, 3]) >= MAX_OFF:
        return 0.0
    value = overlap(one.corners(frame), other.corners(frame))
    return value if value >= MIN_IOU else 0.0


@dataclass(frozen=True)
class Score:
    """What was found in one log. Lengths are meters, medians over matched boxes unless said otherwise."""

    log: str
    objects: str
    """Annotated ones of which any box is matched, of all that move."""
    recall: dict[str, float | None]
    """Share of annotated boxes that are matched: all, by returns, by distance from the lidar, by kind."""
    boxes: dict[str, int]
    """Number of annotated boxes behind each."""
    precision: dict[str, float | None]
    """Share of found boxes that match. Judged: without those of a matched object in frames in which it has no box.
    Strict: all. True: all, where objects have a box in every frame, seen or not."""
    switches: int
    """How often an annotated object goes on under another name."""
    center: tuple[float, float] | None
    """Distance of middles in plan: median and 90 %."""
    height: float | None
    """Difference of middles along z."""
    yaw: float | None
    """Degrees."""
    backwards: int
    """Matched boxes of vehicles that head the other way."""
    size: tuple[float, ...] | None
    """Differences of length, width and height, median over objects."""
    iou: float | None
    tremble: tuple[float, float] | None
    """Distance of middles, without the median shift of a track in its own frame: median and 90 %."""
    kinds: str
    """Matched boxes of the right kind, of all."""
    seconds: float
    """Of the processor."""
    memory: float
    """Peak of the process so far, MB."""
    worst: dict[str, list[str]]
    """Annotated objects with most boxes of ten returns and more that are missed, and found ones with most that match
    none."""


@dataclass(frozen=True)
class Street:
    """What lidars saw of a street, and what moves there."""

    scans: Sequence[Scan]
    annotated: Sequence[Boxes]
    full: Sequence[Boxes] | None = None
    """With a box at every frame; None: nobody knows."""


def score(street: Street, name: str, settings: TrackingSettings) -> Score:
    """Find objects and compare them with the boxes of the street."""
    scans, truth = street.scans, street.annotated
    started = time.process_time()
    objects = find_objects(scans, settings, lambda done, total: None)
    seconds = time.process_time() - started
    found = [
        Boxes(
            f"{number} {one.kind} {one.confidence:.2f}",
            one.kind,
            one.size,
            dict(zip(one.frames.tolist(), one.world_from_object, strict=True)),
            dict(zip(one.frames.tolist(), one.returns.tolist(), strict=True)),
        )
        for number, one in enumerate(objects)
    ]
    frames = sorted({scan.frame for scan in scans})
    matches = Matches.of(truth, found, frames)
    full = None if street.full is None else Matches.of(street.full, found, frames)
    recall, boxes = recalls(truth, matches, {scan.frame: scan.origin for scan in scans})
    strict, judged = precisions(truth, found, matches)
    hit = {row for _, row, _ in matches.pairs}
    return Score(
        name,
        f"{len(hit)} of {len(truth)}",
        recall,
        boxes,
        {"judged": judged, "strict": strict, "true": full and precisions(street.full or (), found, full)[0]},
        switches(matches),
        **errors(truth, found, matches),
        seconds=round(seconds, 2),
        memory=round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000),
        worst={"missed": missed(truth, matches), "ghosts": ghosts(found, full or matches)},
    )


def recalls(
    truth: Sequence[Boxes], matches: Matches, origins: Mapping[int, Float64[np.ndarray, "3"]]
) -> tuple[dict[str, float | None], dict[str, int]]:
    """Return the share and the number of annotated boxes, by what they show."""
    matched = {(frame, row) for frame, row, _ in matches.pairs}
    rows = [
        (
            (frame, number) in matched,
            one.returns[frame],
            float(np.linalg.norm(pose[:2, 3] - origins[frame][:2])),
            "vehicle" if one.size[0] > 2.6 else "people",
        )
        for number, one in enumerate(truth)
        for frame, pose in one.poses.items()
    ]
    groups: dict[str, Callable[[Any], bool]] = {
        "all": lambda row: True,
        "0 to 4": lambda row: row[1] < 5,
        "5 to 9": lambda row: 5 <= row[1] < 10,
        "5": lambda row: row[1] >= 5,
        "10": lambda row: row[1] >= 10,
        "10, vehicles": lambda row: row[1] >= 10 and row[3] == "vehicle",
        "10, people": lambda row: row[1] >= 10 and row[3] == "people",
        "10, below 20 m": lambda row: row[1] >= 10 and row[2] < 20,
        "10, 20 to 40 m": lambda row: row[1] >= 10 and 20 <= row[2] < 40,
        "10, above 40 m": lambda row: row[1] >= 10 and row[2] >= 40,
    }
    chosen = {name: [row[0] for row in rows if holds(row)] for name, holds in groups.items()}
    return {name: mean(hits) for name, hits in chosen.items()}, {name: len(hits) for name, hits in chosen.items()}


def mean(values: Sequence[float | bool]) -> float | None:
    """Return the mean, None of nothing."""
    return round(float(np.mean(values)), 3) if len(values) else None


def precisions(truth: Sequence[Boxes], found: Sequence[Boxes], matches: Matches) -> tuple[float | None, float | None]:
    """Return the share of found boxes that match: of all, and of those that can be judged."""
    matched = {(frame, column) for frame, _, column in matches.pairs}
    partner = {
        column: Counter(row for _, row, other in matches.pairs if other == column).most_common(1)[0][0]
        for _, column in matched
    }
    every = [(frame, column) for column, one in enumerate(found) for frame in one.poses]
    judged = [
        (frame, column)
        for frame, column in every
        if (frame, column) in matched or column not in partner or frame in truth[partner[column]].poses
    ]
    return mean([pair in matched for pair in every]), mean([pair in matched for pair in judged])


def switches(matches: Matches) -> int:
    """Return how often an annotated object is matched by another found one than before."""
    last: dict[int, int] = {}
    count = 0
    for _, row, column in sorted(matches.pairs):
        count += last.get(row, column) != column
        last[row] = column
    return count


def errors(truth: Sequence[Boxes], found: Sequence[Boxes], matches: Matches) -> dict[str, Any]:
    """Return how far matched boxes are off."""
    if not matches.pairs:
        return dict.fromkeys(("center", "height", "yaw", "size", "iou", "tremble"), None) | {
            "kinds": "0 of 0",
            "backwards": 0,
        }
    offsets, yaws, overlaps = [], [], []
    for frame, row, column in matches.pairs:
        pose, other = truth[row].poses[frame], found[column].poses[frame]
        offsets.append(pose[:3, :3].T @ (other[:3, 3] - pose[:3, 3]))
        turn = pose[:3, :3].T @ other[:3, :3]
        yaws.append(abs(np.degrees(np.arctan2(turn[1, 0], turn[0, 0]))))
        overlaps.append(overlap(truth[row].corners(frame), found[column].corners(frame)))
    offset = np.array(offsets)
    long = np.array([truth[row].size[0] > 2.6 for _, row, _ in matches.pairs])
    both = sorted({pair[1:] for pair in matches.pairs})
    pairs = [pair[1:] for pair in matches.pairs]
    shaken = np.concatenate([own - np.median(own, 0) for one in both if len(own := offset[[p == one for p in pairs]])])
    sizes = np.array([np.abs(truth[row].size - found[column].size) for row, column in both])
    plan, shake = np.linalg.norm(offset[:, :2], axis=1), np.linalg.norm(shaken[:, :2], axis=1)
    right = [kind_of(truth[row]) == found[column].kind for row, column in pairs]
    return {
        "center": tuple(np.quantile(plan, (0.5, 0.9)).round(3).tolist()),
        "height": round(float(np.median(np.abs(offset[:, 2]))), 3),
        "yaw": round(float(np.median(yaws)), 2),
        "backwards": int(((np.array(yaws) > 90) & long).sum()),
        "size": tuple(np.median(sizes, 0).round(3).tolist()),
        "iou": round(float(np.median(overlaps)), 3),
        "tremble": tuple(np.quantile(shake, (0.5, 0.9)).round(3).tolist()),
        "kinds": f"{sum(right)} of {len(right)}",
    }


def kind_of(one: Boxes) -> Literal["vehicle", "cyclist", "pedestrian"]:
    """Return the kind of an annotated object, by its class."""
    word = one.kind.lower()
    if "pedestrian" in word or "person" in word:
        return "pedestrian"
    return "cyclist" if "cycl" in word else "vehicle"


def missed(truth: Sequence[Boxes], matches: Matches) -> list[str]:
    """Return the three objects with most boxes of ten returns and more that are missed."""
    matched = {(frame, row) for frame, row, _ in matches.pairs}
    lines = []
    for number, one in enumerate(truth):
        lost = [frame for frame, count in one.returns.items() if count >= 5 and (frame, number) not in matched]
        if lost:
            clear = sum(one.returns[frame] >= 10 for frame in lost)
            line = (
                f"{one.name} {one.kind}: {clear} of 10 and more, {len(lost)} of 5 and more, {min(lost)} to {max(lost)}"
            )
            lines.append((clear, len(lost), line))
    return [line for *_, line in sorted(lines, reverse=True)[:3]]


def ghosts(found: Sequence[Boxes], matches: Matches) -> list[str]:
    """Return the three found objects with most boxes that match none."""
    hits = Counter(column for _, _, column in matches.pairs)
    lines = []
    for number, one in enumerate(found):
        frames = list(one.poses)
        if wrong := len(frames) - hits[number]:
            x, y = one.poses[frames[0]][:2, 3]
            size = " x ".join(f"{side:.1f}" for side in one.size)
            lines.append((wrong, f"{one.name}: {wrong} of {len(frames)} from {frames[0]}, {size}, at {x:.1f} {y:.1f}"))
    return [line for _, line in sorted(lines, reverse=True)[:3]]


USAGE = """\
python -m benchmarks.found_tracks [key=value ...]     what moves in lidar, beside the boxes of the log

  logs    tune, test: synthetic streets; hard_tune, hard: those of hard_streets.py; recorded: drives below
          $SPARSESTREET_DATA; large: 200 scans of 150,000 returns (default: tune)
  only    those whose name contains this (default: all)
  out     folder for found_tracks_LOGS.jsonl (default: outputs/bench)
"""


@dataclass(frozen=True)
class FoundRequest:
    """The script's options."""

    logs: Literal["tune", "test", "hard_tune", "hard", "recorded", "large"] = "tune"
    only: str = ""
    out: Path = Path("outputs/bench")


def made(logs: str) -> dict[str, Callable[[], Street]]:
    """Return what makes each street, by name."""
    if logs == "large":
        return {"large": large}
    if logs == "recorded":
        data = Path(os.environ["SPARSESTREET_DATA"])
        return {name: partial(recorded, partial(make, data)) for name, make in RECORDED.items()}
    if logs in HARD:
        return {name: partial(hard, make) for name, make in hard_streets(HARD[logs]).items()}
    return {name: partial(synthetic, settings) for name, settings in STREETS[logs].items()}


def recorded(make: Callable[[], Any]) -> Street:
    """Return a drive and its boxes."""
    log = make().read()
    scans = scans_of(log, frozenset())
    return Street(scans, annotated(log, scans))


def synthetic(settings: StreetSettings) -> Street:
    """Return a street with what a camera or three returns see of its objects, and with all."""
    log = StreetReader(settings=settings).read()
    scans = scans_of(log, frozenset())
    turn = np.linalg.inv(log.dataset_from_world.numpy())
    return Street(scans, annotated(log, scans), true_boxes(build_world(settings), settings, scans, turn))


LARGE_SCANS, LARGE_RETURNS = 200, 150_000


def large() -> Street:
    """Return a drive as long and dense as Waymo's: a street repeated along x, each return four times with noise."""
    log = StreetReader(settings=replace(SMALL, seed=3)).read()
    short, random = scans_of(log, frozenset()), np.random.default_rng(0)
    scans = []
    for frame in range(LARGE_SCANS):
        number, scan = frame // len(short), short[frame % len(short)]
        points = np.repeat(scan.points, 4, axis=0)[:LARGE_RETURNS].astype(np.float64)
        turn = random.normal(0, 0.003, points.shape)
        points += np.cross(turn, points - scan.origin) + random.normal(0, 0.01, points.shape)
        shift = np.array((40.0 * number, 0, 0))
        scans.append(Scan(frame, 0.1 * frame, (points + shift).astype(np.float32), scan.origin + shift))
    return Street(scans, ())


def hard(make: Callable[[], Seen]) -> Street:
    """Return a hard street, all of whose boxes are known."""
    scans, truth = make()
    return Street(scans, truth, truth)


def lines_of(one: Score) -> list[str]:
    """Return what is printed of a log."""
    shares = ", ".join(f"{name}: {value} ({one.boxes[name]})" for name, value in one.recall.items())
    return [
        f"{one.log}: {one.objects} objects, recall {shares}",
        f"  precision {one.precision}, switches {one.switches}, center {one.center}, height {one.height}, "
        f"yaw {one.yaw}, backwards {one.backwards}, size {one.size}, iou {one.iou}, tremble {one.tremble}, "
        f"kinds {one.kinds}, {one.seconds} s, {one.memory:.0f} MB",
        *(f"  {what}: {line}" for what, lines in one.worst.items() for line in lines),
    ]


def main(words: list[str]) -> int:
    """Find and compare as the words say; 2 on wrong usage."""
    command = shlex.join(["python", "-m", "benchmarks.found_tracks", *words])

    def act(request: FoundRequest) -> None:
        torch.set_num_threads(1)
        file = record_file(request.out, f"found_tracks_{request.logs}", command)
        for name, make in made(request.logs).items():
            if request.only in name:
                one = score(make(), name, TrackingSettings())
                file.write("found_tracks", one)
                print(*lines_of(one), sep="\n", flush=True)

    return run_command("found_tracks", USAGE, words or ["logs=tune"], FoundRequest, act)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
