"""The parts of the search, beside brute force and beside dense float64 solutions."""

from functools import partial
from math import factorial

import numpy as np
import pytest

from sparsestreet.tracking.association import Chain, associate
from sparsestreet.tracking.clusters import Cluster, cluster_labels, find_clusters
from sparsestreet.tracking.fit import fit, laid_on_each_other
from sparsestreet.tracking.free_space import count_views, seen_through
from sparsestreet.tracking.ground import find_ground
from sparsestreet.tracking.joining import join_chains
from sparsestreet.tracking.objects import FoundObject, upright_poses
from sparsestreet.tracking.path import BEND, headings, in_frame, smooth, turned
from sparsestreet.tracking.scans import Returns, Scan, instants
from sparsestreet.tracking.settings import TrackingSettings
from sparsestreet.tracking.shape import Shape, find_middles, find_shape, kind_of, outlines

SETTINGS = TrackingSettings(azimuth_bin=7.5, elevation_bin=6.0)
SIZE = np.array((4.0, 2.0, 1.5))


def returns_of(points: np.ndarray, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Returns:
    return Returns(points, np.broadcast_to(np.array(origin), points.shape))


def directions(count: int, seed: int) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(count, 3)) * (1, 1, 0.4)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def block_of_rays(rays: np.ndarray, place: np.ndarray, scale: int) -> np.ndarray:
    """Ranges of the rays in the 2 x 2 bins whose middle is nearest to a place, one ray at a time."""
    bins = round(360 / (scale * SETTINGS.azimuth_bin))

    def cell(vector: np.ndarray) -> tuple[float, float]:
        turn = (np.arctan2(vector[1], vector[0]) + np.pi) / (2 * np.pi) * bins
        up = (np.degrees(np.arcsin(vector[2] / np.linalg.norm(vector))) + 90) / (scale * SETTINGS.elevation_bin)
        return turn, up

    turn, up = cell(place)
    wanted = {(int(np.floor(turn - 0.5) + i) % bins, int(np.floor(up - 0.5)) + j) for i in (0, 1) for j in (0, 1)}
    return np.array([np.linalg.norm(ray) for ray in rays if tuple(int(np.floor(v)) for v in cell(ray)) in wanted])


def sees(rays: np.ndarray, place: np.ndarray) -> bool:
    for scale in (1, 2):
        around = block_of_rays(rays, place, scale)
        if len(around) >= 2:
            distance = np.linalg.norm(place)
            return bool(distance > 1.5 and around.min() > distance + max(0.5, 0.02 * distance))
    return False


def test_a_place_is_seen_through_where_every_ray_around_it_ends_behind():
    random = np.random.default_rng(0)
    rays = directions(900, 1) * random.uniform(4, 40, (900, 1))
    places = directions(300, 2) * random.uniform(1, 12, (300, 1))
    expected = [sees(rays, place) for place in places]
    assert 30 < sum(expected) < 270
    # Within a hair of a bin's border, arcsin and arctan may differ; none of these is.
    assert seen_through(rays, places, SETTINGS).tolist() == expected


def test_views_are_counted_as_by_comparing_all_with_all():
    random = np.random.default_rng(4)
    origins = random.normal(size=(6, 3))
    scans = [
        Scan(k, 0.1 * k, o + directions(500, k) * random.uniform(3, 20, (500, 1)), o) for k, o in enumerate(origins)
    ]
    candidates = [scan.points[: 80 + k] for k, scan in enumerate(scans)]
    occupied, free = count_views(scans, candidates, SETTINGS, lambda done, total: None)
    every = np.concatenate(candidates)
    cells = [tuple(row) for row in np.floor(every / SETTINGS.voxel).astype(int)]
    means = {cell: every[[other == cell for other in cells]].mean(0) for cell in set(cells)}
    number = np.repeat(np.arange(6), [len(points) for points in candidates])
    taken = np.zeros((len(every), 6), bool)
    through = np.zeros((len(every), 6), bool)
    for k, scan in enumerate(scans):
        own = np.array([means[cells[row]] for row in np.flatnonzero(number == k)])
        for row, cell in enumerate(cells):
            taken[row, k] = (np.linalg.norm(own - means[cell], axis=1) <= SETTINGS.reach).any()
        places = np.array([means[cell] for cell in cells])
        through[:, k] = seen_through(scan.points - scan.origin, places - scan.origin, SETTINGS) & ~taken[:, k]
    assert (np.concatenate(occupied) == taken.sum(1)).all()
    assert (np.concatenate(free) == through.sum(1)).all()
    assert taken.sum(1).max() > 1
    assert through.any()


def test_clusters_are_chains_of_near_returns():
    random = np.random.default_rng(5)
    points = np.column_stack((random.uniform(-30, 30, (160, 2)), random.uniform(0, 2, 160)))
    # One return a cell of the plan, so that cells are no coarser than returns.
    _, first = np.unique(np.floor(points[:, :2] / 0.2), axis=0, return_index=True)
    returns = returns_of(points[np.sort(first)], (3.0, -2.0, 1.8))
    settings = TrackingSettings(cluster_gap=1.5, cluster_gap_share=0.05)
    reach = 1.5 + 0.05 * np.linalg.norm(returns.points[:, :2] - (3.0, -2.0), axis=1)
    apart = np.linalg.norm(returns.points[:, None, :2] - returns.points[None, :, :2], axis=2)
    near = apart < np.minimum(reach[:, None], reach[None])
    for _ in range(8):
        near = near @ near
    labels = cluster_labels(returns, settings)
    assert ((labels[:, None] == labels[None]) == near).all()
    assert 5 < labels.max() + 1 < 100


def test_clusters_that_are_small_or_low_are_noise():
    ground = find_ground([np.zeros((1, 3))])
    high = np.array([[5.0, 0, 0.3], [5.1, 0, 0.6], [5.2, 0, 0.3]])
    assert len(find_clusters(returns_of(high), ground, SETTINGS)) == 1
    assert find_clusters(returns_of(high * (1, 1, 0.7)), ground, SETTINGS) == []
    assert find_clusters(returns_of(high[:2]), ground, SETTINGS) == []
    assert find_clusters(returns_of(np.zeros((0, 3))), ground, SETTINGS) == []


def divided(seconds: np.ndarray, order: int) -> np.ndarray:
    """Rows that give the derivative of the polynomial through order + 1 values, by solving for its coefficients."""
    rows = np.zeros((len(seconds) - order, len(seconds)))
    for k in range(len(rows)):
        times = seconds[k : k + order + 1]
        rows[k, k : k + order + 1] = factorial(order) * np.linalg.inv(np.vander(times - times[0]))[0]
    return rows


@pytest.mark.parametrize("count", [2, 3, 4, 17])
def test_paths_solve_the_dense_equations(count):
    random = np.random.default_rng(count)
    seconds = np.cumsum(random.uniform(0.05, 0.4, count + 3)) + 100
    steps = np.unique(np.r_[2, random.integers(2, count + 2, count), count + 1])
    places, weights = random.normal(size=(len(steps), 2)), random.uniform(0.1, 1, len(steps))
    own = seconds[2 : count + 2]
    penalty = np.zeros((count, count))
    for order, stiffness in ((3, 7.0), (2, BEND)):
        if order < count:
            span = (own[order:] - own[:-order]) / order
            rows = divided(own, order) * 0.1**order * np.sqrt(span / 0.1)[:, None]
            penalty += stiffness * rows.T @ rows
    robust = np.ones(len(steps))
    for _ in range(4):
        at = np.eye(count)[steps - 2]
        matrix = penalty + at.T @ np.diag(weights * robust) @ at + 1e-9 * np.eye(count)
        path = np.linalg.solve(matrix, at.T @ ((weights * robust)[:, None] * places))
        robust = 1 / (1 + (np.linalg.norm(path[steps - 2] - places, axis=1) / 0.3) ** 2)
    assert smooth(steps, places, weights, seconds, 7.0) == pytest.approx(path, abs=1e-5)


def test_a_path_of_constant_velocity_stays_as_it_is_across_gaps():
    seconds = np.array([0.0, 0.1, 0.2, 0.7, 0.8, 1.3])
    line = np.outer(seconds, (3.0, -2.0)) + np.array((5, 7))
    steps = np.array([0, 1, 3, 5])
    # What holds unmeasured steps back is 1e-9 of the rest.
    assert smooth(steps, line[steps], np.ones(4), seconds, 60.0) == pytest.approx(line, abs=1e-5)
    assert smooth(np.array([2]), line[[2]], np.ones(1), seconds, 60.0).tolist() == line[[2]].tolist()


def test_headings_follow_the_motion_and_are_held_while_it_stands():
    seconds = np.arange(60) * 0.1
    angle = np.cumsum(np.where((np.arange(60) > 20) & (np.arange(60) < 40), 0.0, 0.02))
    path = 20 * np.column_stack((np.sin(angle), -np.cos(angle)))
    yaw, speed = headings(path, seconds, 1.0)
    assert yaw[5:15] == pytest.approx(angle[5:15], abs=0.01)
    assert yaw[45:55] == pytest.approx(angle[45:55], abs=0.01)
    assert speed[5:15] == pytest.approx(4.0, rel=0.01)
    assert np.abs(np.diff(yaw)).max() < 0.03
    shaken = path[[30] * 20] + np.random.default_rng(0).normal(0, 0.02, (20, 2))
    assert headings(np.vstack((path[:20], shaken)), seconds[:40], 1.0)[0][30:] == pytest.approx(angle[20], abs=0.05)
    assert headings(path[:1], seconds[:1], 1.0)[0].tolist() == [0.0]


def test_what_reverses_keeps_its_heading():
    seconds = np.arange(60) * 0.1
    speed = np.clip(6 - 4 * np.abs(seconds - 1.0), -2, 6)  # on, and back for longer but slower
    path = np.cumsum(speed * 0.1)[:, None] * (np.cos(2.5), np.sin(2.5))
    for places in (path, path[::-1]):
        yaw, _ = headings(places, seconds, 1.0, reverses=True)
        # Read backwards in time it is fast the other way.
        assert np.cos(yaw - 2.5) == pytest.approx(np.full(60, 1.0 if places is path else -1.0), abs=1e-6)
    assert np.ptp(headings(path, seconds, 1.0)[0]) == pytest.approx(np.pi, abs=1e-6)


def test_the_heading_of_what_is_long_is_taken_over_its_length():
    seconds = np.arange(40) * 0.1
    corners = np.array([[x, y] for x in np.linspace(-6, 6, 49) for y in np.linspace(-1.25, 1.25, 11)])
    parts = []
    for step, time in enumerate(seconds):
        # Its right side, and for a while its back too: the middle of what is seen jumps by half of its width.
        whole = 14 <= step < 26
        seen = corners[(corners[:, 1] < -1.2) | ((corners[:, 0] < -5.9) & whole)]
        points = np.column_stack((seen + np.array((4 * time, 0)), np.full(len(seen), 1.5)))
        parts.append(returns_of(points, (-20.0 if whole else 4 * time, -9.0, 1.8)))
    ground = find_ground([np.zeros((1, 3))])
    found = fit(Chain(np.arange(40), tuple(parts)), seconds, ground, refine=False)
    assert found.shape.size[0] == pytest.approx(12.1, abs=0.2)
    assert np.degrees(np.abs(found.yaw)).max() < 5
    assert np.abs(found.path[:, 1]).max() < 0.8  # the middle of what is seen jumps by 1.25 m


@pytest.mark.parametrize(("behind", "beside", "count"), [(6.6, 0.0, 1), (6.6, 2.5, 2), (8.5, 0.0, 2)])
def test_pieces_in_line_are_one_and_those_abreast_or_apart_are_two(behind, beside, count):
    """Boxes of 6 x 2.5 m that keep their places while they drive askew to the axes: a tram between its windows."""
    yaw, seconds = 2.2, np.arange(30) * 0.1
    sides = [[x, y, z] for x in np.linspace(-3, 3, 25) for y in (-1.25, 1.25) for z in (0.5, 2.5)]
    box = np.array([*sides, *([x, y, 1.5] for x in (-3, 3) for y in np.linspace(-1.25, 1.25, 11))])
    chains = []
    for shift in np.array(((0, 0, 0), (-behind, beside, 0))):
        places = [box + shift + np.array((5 * time, 0, 0)) for time in seconds]
        turns = [np.column_stack((turned(points[:, :2], np.full(len(points), yaw)), points[:, 2])) for points in places]
        chains.append(Chain(np.arange(30), tuple(returns_of(points, (0.0, -9.0, 1.8)) for points in turns)))
    fitted = partial(fit, seconds=seconds, ground=find_ground([np.zeros((1, 3))]), refine=False)
    assert len(join_chains(chains, fitted, seconds, TrackingSettings())) == count


def test_the_road_is_found_below_walls_cars_and_reflections():
    random = np.random.default_rng(6)
    scans = []
    for _ in range(10):
        plan = random.uniform(-15, 15, (4000, 2))
        height = 0.12 * plan[:, 0] - 0.05 * plan[:, 1] + random.normal(0, 0.01, 4000)
        inside = (np.abs(plan - (4, 4)) < (2.3, 0.9)).all(1)
        height[inside] += 1.4
        height[plan[:, 1] > 9] += 8  # a row of houses
        scans.append(np.column_stack((plan, height)))
    scans[0][:40, 2] -= 3  # as in a wet road
    puddle = (np.abs(scans[1][:, :2] + 8) < 2).all(1)
    scans[1][puddle, 2] -= 2
    places = random.uniform((-14, -14), (14, 8), (500, 2))
    places[:40] = random.uniform((2.5, 3.4), (5.5, 4.6), (40, 2))
    places[40:60] = random.uniform(-9, -7, (20, 2))
    # Cells are half a meter across, and lows lie up to two deviations deep.
    assert find_ground(scans).below(places) == pytest.approx(0.12 * places[:, 0] - 0.05 * places[:, 1], abs=0.2)
    assert find_ground([np.zeros((0, 3))]).below(places).tolist() == [0.0] * 500


def test_places_in_a_frame_and_back():
    points, middle = np.array([[3.0, 4.0, 9.0], [1.0, 1.0, 9.0]]), np.array([1.0, 1.0])
    assert in_frame(points, middle, np.arctan2(3, 2))[0] == pytest.approx([np.hypot(3, 2), 0])
    yaw = np.array([0.3, -2.0])
    back = np.array([in_frame(turned(points[:, :2], yaw)[[k]], np.zeros(2), yaw[k])[0] for k in range(2)])
    assert back == pytest.approx(points[:, :2])


def test_chains_follow_velocities_where_they_cross():
    seconds = np.arange(12) * 0.1
    frames = []
    for time in seconds:
        middles = np.array([[10 * time, 0.0], [5.5, -6 + 10.9 * time]])
        frames.append([Cluster.of(returns_of(np.column_stack((m + np.eye(2)[[0, 1, 0]], [1, 1, 2])))) for m in middles])
    frames[4] = []  # nobody looks
    chains = associate(frames, seconds, SETTINGS)
    assert [chain.steps.tolist() for chain in chains] == [[0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11]] * 2
    for chain, axis in zip(chains, (1, 0), strict=True):
        assert np.ptp([part.points[0, axis] for part in chain.parts]) < 1e-9
    assert associate(frames[:2], seconds[:2], SETTINGS) == []


def test_chains_merge_step_by_step():
    def chain(steps, value):
        return Chain(np.array(steps), tuple(returns_of(np.full((2, 3), value)) for _ in steps))

    merged = Chain.merged([chain([4, 6], 1.0), chain([2, 6], 2.0)])
    assert merged.steps.tolist() == [2, 4, 6]
    assert [len(part) for part in merged.parts] == [2, 2, 4]


def test_sides_that_face_the_lidar_are_where_they_are_seen():
    back_and_right = np.array([[[-1.8, -1.1], [1.0, 0.4]]])
    shape = Shape("vehicle", SIZE, SIZE)
    part = [returns_of(np.zeros((2, 3)), (-9.0, -7.0, 1.0))]
    middle, weight = find_middles(part, back_and_right, shape, np.zeros((1, 2)), np.zeros(1))
    assert middle.tolist() == [[pytest.approx(-1.8 + 2), pytest.approx(-1.1 + 1)]]
    assert weight.tolist() == [0.3]
    turned_about, _ = find_middles(part, back_and_right, shape, np.zeros((1, 2)), np.array([np.pi]))
    # Of the car that comes the lidar sees front and left: its high ends.
    assert turned_about == pytest.approx(-np.array([[1.0 - 2, 0.4 - 1]]))
    across, _ = find_middles(part, back_and_right, shape, np.zeros((1, 2)), np.array([np.pi / 2]))
    # It is behind, and on the left.
    assert across == pytest.approx(np.array([[1 - 0.4, -1.8 + 2]]))
    person = Shape("pedestrian", SIZE, SIZE)
    assert find_middles(part, back_and_right, person, np.zeros((1, 2)), np.zeros(1))[0] == pytest.approx(
        np.array([[-0.4, -0.35]])
    )


def outline_of(length: float, width: float) -> np.ndarray:
    return np.array([[[-length / 2, -width / 2], [length / 2, width / 2]]] * 5)


def test_lengths_nobody_saw_are_usual_ones_and_say_so():
    counts = np.full(5, 30)
    seen = find_shape(outline_of(4.4, 1.8), counts, 1.5, 8.0)
    assert seen.size == pytest.approx((4.6, 1.85, 1.5))
    assert seen.unsure.max() <= 0.2 + 1e-9
    behind = find_shape(outline_of(1.5, 1.8), counts, 1.5, 8.0)
    assert behind.size[0] == pytest.approx(4.5)
    assert behind.unsure[0] == pytest.approx(3.0)
    tram = find_shape(outline_of(4.5, 2.5), counts, 3.4, 8.0)
    assert tram.size[0] == pytest.approx(10.2)
    assert tram.unsure[0] >= 10
    person = find_shape(outline_of(0.5, 0.4), counts, 1.6, 1.4)
    assert (person.kind, person.size.tolist()) == ("pedestrian", pytest.approx([0.85, 0.65, 1.7]))
    assert [kind_of(1.6, 0.6, 1.0), kind_of(0.6, 0.6, 4.0), kind_of(1.0, 1.6, 4.0)] == ["cyclist", "cyclist", "vehicle"]


def test_outlines_are_those_of_the_frame():
    corners = np.array([[2.0, 1.0], [-2, 1], [-2, -1], [2, -1]])
    points = turned(corners, np.full(4, 0.7)) + np.array((30, -4))
    found = outlines([returns_of(np.column_stack((points, np.zeros(4))))], np.array([[30.0, -4.0]]), np.array([0.7]))
    # The 1 % quantile of four values lies 3 % of a gap inside.
    assert found == pytest.approx(np.array([[[-2, -1], [2, 1]]]), abs=0.13)


def test_returns_are_laid_upon_each_other():
    random = np.random.default_rng(7)
    path = np.column_stack((np.arange(8) * 1.0, np.arange(8) * 0.5))
    yaw = np.full(8, np.arctan(0.5))
    wrong = random.normal(0, 0.08, (8, 2))
    parts = []
    for place, angle in zip(path, yaw, strict=True):
        sides = np.column_stack((random.uniform(-2, 2, 80), np.full(80, 0.9)))
        sides[:40] = np.column_stack((np.full(40, 2.0), random.uniform(-0.9, 0.9, 40)))
        parts.append(returns_of(np.column_stack((turned(sides, np.full(80, angle)) + place, random.random(80)))))
    shift = laid_on_each_other(parts, path + wrong, yaw, np.ones(8))
    before, after = (offset - offset.mean(0) for offset in (wrong, wrong + shift))
    assert np.sqrt((after**2).mean()) < 0.5 * np.sqrt((before**2).mean())
    assert shift.mean(0) == pytest.approx(0, abs=1e-9)


def test_scans_that_cannot_be_are_refused():
    nowhere = np.zeros((0, 3))
    with pytest.raises(ValueError, match="frame 3 has 1 broken of 2 points"):
        Scan(3, 0.0, np.array([[0, 0, np.nan], [1, 1, 1]]), np.zeros(3))
    with pytest.raises(ValueError, match=r"frame 1 is at 0\.5 s and frame 2 at 0\.5 s"):
        instants([Scan(1, 0.5, nowhere, np.zeros(3)), Scan(2, 0.5, nowhere, np.zeros(3))])
    groups = instants([Scan(k // 2, 0.1 * k, nowhere, np.zeros(3)) for k in (3, 1, 2, 0)])
    assert [[scan.seconds for scan in group] for group in groups] == [[0.1, 0.0], [pytest.approx(0.3), 0.2]]
    assert len(returns_of(np.zeros((10, 3))).thinned(4)) == 4
    assert len(Returns.joined([])) == 0


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"voxel": 0.0}, "a positive voxel"),
        ({"min_free_share": 1.5}, "min_free_share of at most 1"),
        ({"highest": 0.2}, "raise highest"),
    ],
)
def test_settings_that_cannot_be_are_refused(given, said):
    with pytest.raises(ValueError, match=said):
        TrackingSettings(**given)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"frames": np.array([1, 1])}, "must increase"),
        ({"size": np.array([1.0, 0, 1])}, "must be positive"),
        ({"confidence": 1.1}, r"confidence in \[0, 1\]"),
    ],
)
def test_objects_that_cannot_be_are_refused(wrong, said):
    poses = upright_poses(np.array([[0.0, 0, 1], [3.0, 4, 1]]), np.array([0.5, 0.5]))
    good = {
        "kind": "vehicle", "frames": np.array([1, 2]), "world_from_object": poses, "size": SIZE, "size_unsure": SIZE,
        "returns": np.array([4, 5]), "confidence": 0.5,
    }  # fmt: skip
    assert FoundObject(**good).path_length == pytest.approx(5)
    assert poses[0, :2, 0] == pytest.approx([np.cos(0.5), np.sin(0.5)])
    assert np.linalg.det(poses[0]) == pytest.approx(1)
    with pytest.raises(ValueError, match=said):
        FoundObject(**good | wrong)


def cluster_at(x: float, extent: float) -> Cluster:
    points = np.array([[x - extent / 2, 3.0, 1.0], [x + extent / 2, 3.0, 1.0]])
    return Cluster(returns_of(points), np.array([x, 3.0]), extent)


def test_a_chain_takes_what_is_as_large_and_may_grow_smaller_step_by_step():
    seconds = 0.1 * np.arange(8)
    sudden = [[cluster_at(0.5 * step, 4.0 if step < 4 else 0.3)] for step in range(8)]
    assert [chain.steps.tolist() for chain in associate(sudden, seconds, SETTINGS)] == [[0, 1, 2, 3], [4, 5, 6, 7]]
    # By a factor 0.8 each time, 0.2 in all, as of a car whose back alone is seen at last: exp(-1.2) is 0.3.
    slow = [[cluster_at(0.5 * step, 5 * 0.8**step)] for step in range(8)]
    assert [len(chain) for chain in associate(slow, seconds, SETTINGS)] == [8]


def test_what_is_seen_now_from_one_end_and_now_from_the_other_is_one():
    """The middles of what is seen jump; the velocity is that of many, and so is the place."""
    seconds, number = 0.1 * np.arange(20), np.arange(20)
    hidden = [[cluster_at(x, 4.0)] for x in 0.5 * number + 0.3 * (-1.0) ** number]
    hidden[10:16] = [[]] * 6
    assert [len(chain) for chain in associate(hidden, seconds, SETTINGS)] == [14]
    late = [[cluster_at(x, 4.0)] for x in 0.5 * number + np.where(number < 8, 0.02, 0.55) * (-1.0) ** number]
    assert [len(chain) for chain in associate(late, seconds, SETTINGS)] == [20]


def test_sizes_decide_where_places_hardly_do():
    seconds = 0.1 * np.arange(5)
    frames = [[cluster_at(0.0, 4.0), cluster_at(1.0, 2.0)] for _ in seconds]
    frames[4] = [cluster_at(0.45, 2.0), cluster_at(0.55, 4.0)]  # nearer to each other's places than to their own
    large, small = associate(frames, seconds, SETTINGS)
    assert np.ptp(large.parts[-1].points[:, 0]) > np.ptp(small.parts[-1].points[:, 0])


def test_what_brakes_while_it_is_hidden_is_expected_at_its_mean_velocity():
    seconds = 0.1 * np.arange(38)
    steps = (np.arange(10), np.arange(28, 38))
    places = (15 * seconds[steps[0]], 15 * 0.9 + 13 * 1.9 + 11 * (seconds[steps[1]] - 2.8))
    side = np.array([[x, y, 1.0] for x in np.linspace(-2, 2, 9) for y in (-0.9, 0.9)])
    chains = [
        Chain(own, tuple(returns_of(side + np.array((x, 0, 0)), (10.0, -20.0, 1.8)) for x in xs))
        for own, xs in zip(steps, places, strict=True)
    ]
    fitted = partial(fit, seconds=seconds, ground=find_ground([np.zeros((1, 3))]), refine=False)
    assert len(join_chains(chains, fitted, seconds, TrackingSettings())) == 1
