"""Edits: where edited objects are, by hand; everything else stays as it was, bit for bit."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.geometry import quaternions as quat
from sparsestreet.scene.edits import (
    REMOVED,
    Added,
    AsRecorded,
    Change,
    Driven,
    Edits,
    Given,
    Held,
    Moved,
    edited,
    placed,
)
from sparsestreet.scene.edits.edits import off_the_ground
from sparsestreet.scene.edits.nodes import AddedObject
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Tracked
from sparsestreet.types import Shutter
from tests.scene.people import smpl, walker
from tests.scene.stored import NAMES, cars, pixels, stored, view
from tests.scene.street import background, random_rows

TIME = 0.37
TRAM, CAR = NAMES


@pytest.fixture(scope="module")
def scene() -> SceneGraph:
    return stored().scene.eval()


@pytest.fixture(scope="module")
def people() -> SceneGraph:
    node = smpl(walker("anna"), walker("berta", y=2.0, seed=1))
    return SceneGraph({"people": node}).eval()


@torch.no_grad()
def of(scene: SceneGraph, node: str = "cars", time: float = TIME):
    """The node's Gaussians in the world, as numpy."""
    found = scene.gaussians_at(view(time))
    rows = found.spans[node]
    return {name: column[rows].double().numpy() for name, column in found.gaussians.columns().items()}


def box(scene: SceneGraph, instance: int, time: float = TIME) -> np.ndarray:
    node = scene.nodes["cars"]
    assert isinstance(node, Tracked)
    poses = node.pose_at(time)
    frame = np.eye(4)
    frame[:3, :3] = quat.to_matrix(poses.quaternions.detach().double())[instance].numpy()
    frame[:3, 3] = poses.translations.detach()[instance].numpy()
    return frame


def carried(means: np.ndarray, frame: np.ndarray, old: np.ndarray) -> np.ndarray:
    move = frame @ np.linalg.inv(old)
    return means @ move[:3, :3].T + move[:3, 3]


def test_a_removed_object_has_no_opacity_and_nothing_else_changes(scene):
    before, after = of(scene), of(edited(scene, Edits({TRAM: REMOVED})))
    tram = np.arange(8) % 2 == 0
    assert (before["opacities"] > 0).all()
    np.testing.assert_array_equal(after["opacities"], np.where(tram, 0, before["opacities"]))
    for name in ("means", "quaternions", "scales", "sh"):
        np.testing.assert_array_equal(after[name], before[name])


@torch.no_grad()
def test_an_edited_scene_leaves_the_scene_as_it_was():
    whole = stored()
    before = pixels(whole.render(view()))
    other = replace(whole, scene=edited(whole.scene, Edits({TRAM: REMOVED, CAR: Change(Moved(right=1.0))})))
    assert not torch.equal(other.render(view()).rgb, before[0])
    for a, b in zip(pixels(whole.render(view())), before, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    none = replace(whole, scene=edited(whole.scene, Edits()))
    torch.testing.assert_close(none.render(view()).rgb, before[0], rtol=0, atol=0)


def test_moves_are_along_the_objects_own_axes(scene):
    old = box(scene, 1)
    own = placed(2.0, -3.0, 0.5, 0.7)
    after = of(edited(scene, Edits({CAR: Change(Moved(forward=2.0, right=3.0, up=0.5, turn=0.7))})))
    before = of(scene)
    # float32 means of a few meters.
    np.testing.assert_allclose(after["means"][1::2], carried(before["means"][1::2], old @ own, old), atol=2e-6)
    np.testing.assert_array_equal(after["means"][::2], before["means"][::2])
    turned = quat.from_matrix(torch.from_numpy(old[:3, :3] @ own[:3, :3] @ old[:3, :3].T))
    expected = quat.multiply(turned.expand(4, 4), torch.from_numpy(before["quaternions"][1::2]))
    alike = (quat.normalized(expected) * quat.normalized(torch.from_numpy(after["quaternions"][1::2]))).sum(1).abs()
    np.testing.assert_allclose(alike, 1, atol=1e-6)


def test_a_change_of_lane_is_smooth_and_turns_into_its_direction(scene):
    lane = Moved(right=2.0, during=(0.3, 0.6))
    recorded = np.stack([placed(20 * time, 1.0, 0.0, 0.0) for time in (0.0, 0.3, 0.45, 0.6, 0.9)])
    frames = np.stack(
        [lane.frame(time, lambda at: placed(20 * at, 1.0, 0.0, 0.0)) for time in (0.0, 0.3, 0.45, 0.6, 0.9)]
    )
    np.testing.assert_allclose(frames[:, 1, 3] - recorded[:, 1, 3], [0, 0, -1, -2, -2], atol=1e-12)
    # In the middle 2 m in 0.3 go by 1.5 times the mean speed, beside 20 ahead: smoothstep' = 6 s (1 - s).
    yaws = np.arctan2(frames[:, 1, 0], frames[:, 0, 0])
    np.testing.assert_allclose(yaws, [0, 0, -np.arctan2(1.5 * 2 / 0.3, 20), 0, 0], atol=1e-4)


def test_a_held_object_stays_as_it_was(scene):
    after = of(edited(scene, Edits({TRAM: Change(Held(0.5))})), time=0.9)
    np.testing.assert_allclose(after["means"][::2], of(scene, time=0.5)["means"][::2], atol=2e-6)
    np.testing.assert_allclose(after["opacities"][::2], of(scene, time=0.5)["opacities"][::2])


def test_an_object_drives_a_way_of_its_own_and_is_there_at_all_times(scene):
    way = Driven([0.2, 0.6], [(1.0, 2.0), (5.0, 6.0)], heights=[0.5, 0.7])
    there = edited(scene, Edits({CAR: Change(way)}))
    for time, x, z in ((0.0, 1.0, 0.5), (0.4, 3.0, 0.6), (1.0, 5.0, 0.7)):
        old, wanted = box(scene, 1, time), placed(x, x + 1, z, np.pi / 4)
        after, before = of(there, time=time), of(scene, time=time)
        np.testing.assert_allclose(after["means"][1::2], carried(before["means"][1::2], wanted, old), atol=4e-6)
        assert (after["opacities"][1::2] > 0).all()
    assert (of(scene, time=1.0)["opacities"][1::2] == 0).all()  # as recorded the car is gone by then


def test_a_way_turns_at_its_corners_and_yaws_take_the_shorter_arc():
    way = Driven([0.0, 0.2, 0.4, 0.6], [(0.0, 0.0), (1.0, 0.0), (1.0, 2.0), (1.0, 2.0)], heights=[0.0] * 4)
    for time, yaw in ((-1.0, 0.0), (0.1, 0.0), (0.3, np.pi / 2), (0.5, np.pi / 2), (2.0, np.pi / 2)):
        frame = way.frame(time, lambda time: np.eye(4))
        np.testing.assert_allclose(frame[:3, :3], placed(yaw=yaw)[:3, :3], atol=1e-12)
    turning = Driven([0.0, 1.0], [(0.0, 0.0), (1.0, 0.0)], yaws=[3.0, -3.0])
    np.testing.assert_allclose(turning.frame(0.5, lambda time: placed(z=7.0)), placed(0.5, 0.0, 7.0, np.pi), atol=1e-12)


def test_a_moved_object_waits_at_the_ends_of_its_recorded_way(scene):
    there = edited(scene, Edits({CAR: Change(Moved(right=1.0))}))
    end = float(scene.nodes["cars"].get_buffer("spans")[1, 1])
    assert end < 0.9
    np.testing.assert_allclose(of(there, time=1.0)["means"][1::2], of(there, time=end)["means"][1::2], atol=1e-6)


def test_hidden_objects_come_back(scene):
    there = edited(scene, Edits({TRAM: Change(hidden=((0.3, 0.5),))}))
    shown = [bool((of(there, time=time)["opacities"][::2] > 0).all()) for time in (0.29, 0.3, 0.49, 0.5)]
    assert shown == [True, False, False, True]


def test_a_copy_is_the_object_once_more(scene):
    there = edited(scene, Edits(added={"second": Added(CAR, Change(Moved(forward=-8.0)))}))
    old, before, copy = box(scene, 1), of(scene), of(there, "second")
    moved = carried(before["means"][1::2], old @ placed(-8.0), old)
    np.testing.assert_allclose(copy["means"], moved, atol=4e-6)
    for name in ("scales", "opacities", "sh"):
        np.testing.assert_array_equal(copy[name], before[name][1::2])
    for name, values in of(there).items():
        np.testing.assert_array_equal(values, before[name])


def test_an_object_of_another_scene_keeps_its_own_clock_and_stands_on_the_ground(scene, monkeypatch):
    other = SceneGraph({"cars": cars(10, sh_degree=1)}).eval()
    added = Added(TRAM, Change(AsRecorded()), instead_of=CAR, scene=other, speed=0.5)
    there = edited(scene, Edits({CAR: REMOVED}, {"new": added}))
    before = of(other, time=0.2)["means"][::2]
    asked = []
    node = other.nodes["cars"]
    monkeypatch.setattr(
        node, "raw_at", lambda view, state, ask=node.raw_at: (asked.append(view.time), ask(view, state))[1]
    )
    of(there, "new", 0.4)
    of(there, "new", -3.0)
    assert asked == [0.2, 0.0]  # before it was there it has its first shape
    # The tram's box is 1.5 m high, that of the car 2 m.
    wanted = box(scene, 1, 0.4) @ placed(z=(1.5 - 2.0) / 2)
    np.testing.assert_allclose(of(there, "new", 0.4)["means"], carried(before, wanted, box(other, 0, 0.2)), atol=4e-6)
    with pytest.raises(ValueError, match="give it a way of its own"):
        edited(scene, Edits(added={"new": Added(TRAM, scene=other)}))


@torch.no_grad()
def test_edited_objects_move_with_the_shutter_as_their_boxes_do(scene):
    way = Driven([0.0, 1.0], [(0.0, 0.0), (40.0, 10.0)], heights=[0.0, 0.0])
    edits = Edits({CAR: Change(way)}, {"second": Added(TRAM, Change(replace(way, yaws=[0.0, 1.0])))})
    there = edited(scene, edits)
    rolling = replace(view(), camera=replace(view().camera, shutter=Shutter(torch.zeros(3), torch.zeros(3), span=0.02)))
    found = there.gaussians_at(rolling)
    for node, chosen in (("cars", slice(1, None, 2)), ("second", slice(None))):
        late, early = (of(there, node, TIME + side * 0.01)["means"][chosen] for side in (1, -1))
        displacements = found.gaussians.displacements[found.spans[node]][chosen]
        # Differences of float32 means of up to 40 m.
        np.testing.assert_allclose(displacements, late - early, atol=1e-5)
        assert np.linalg.norm(displacements, axis=1).min() > 0.5


def test_people_keep_their_shape_and_stay_upright(people):
    before = of(people, "people", 0.5)
    anna = people.nodes["people"].rows.instances.numpy() == 0
    after = of(edited(people, Edits({"anna": Change(Moved(right=3.0, turn=np.pi))})), "people", 0.5)
    np.testing.assert_array_equal(after["means"][~anna], before["means"][~anna])
    old, new = before["means"][anna], after["means"][anna]
    np.testing.assert_allclose(new[:, 2], old[:, 2], atol=2e-6)
    frame = people.nodes["people"].object_frames(people.nodes["people"].pose_at(0.5))[0]
    # Anna has turned by 0.2 rad in each of two frames.
    np.testing.assert_allclose(frame[:3, :3], placed(yaw=0.4)[:3, :3], atol=1e-6)
    np.testing.assert_allclose(new, carried(old, frame @ placed(y=-3.0, yaw=np.pi), frame), atol=4e-6)


def test_a_person_stands_on_the_ground_that_another_stood_on(people):
    other = SceneGraph({"people": smpl(walker("carl", height=1.2))}).eval()
    there = edited(people, Edits({"anna": REMOVED}, {"carl": Added("carl", instead_of="anna", scene=other)}))
    soles = [of(people, "people", 0.0)["means"], of(there, "carl", 0.0)["means"]]
    # Limbs are bent at random, by up to a radian, and 1.2 m are 0.4 m less than 1.6.
    heights = [float(means[:, 2].max()) for means in soles]
    assert 0.25 < heights[0] - heights[1] < 0.55
    node = people.nodes["people"]
    assert isinstance(node, Tracked)
    # The pelvis of a body of 1.6 m is a little above the middle.
    assert 0.75 < node.frame_height(0) < 1.0


def hillside() -> SceneGraph:
    """A slope far from the world's zero, with a wall, leaves above it, a faint cloud below, and a car that moves."""
    generator = torch.Generator().manual_seed(3)
    rows = random_rows(1000, 0)
    with torch.no_grad():
        rows.means[:, :2] = 30 * torch.rand(1000, 2, generator=generator) + torch.tensor([50.0, -20.0])
        rows.means[:, 2] = slope(*rows.means[:, :2].T)
        rows.means[:300, 2] += 1 + 4 * torch.rand(300, generator=generator)
        rows.opacity_logits.fill_(2.0)
        rows.means[300:400, 2] -= 3
        rows.opacity_logits[300:400] = -3.0
    return SceneGraph({"hill": background(rows), "cars": cars()}).eval()


def slope(x, y):
    return -1.65 + 0.1 * (x - 50) + 0.05 * y


def test_an_inserted_object_without_a_height_stands_on_the_ground_below(people):
    hill, other = hillside(), SceneGraph({"people": smpl(walker("carl", height=1.2))}).eval()
    source = other.nodes["people"]
    assert isinstance(source, Tracked)
    pelvis = source.frame_height(0)
    way = Driven([0.0, 1.0], [(55.0, -10.0), (70.0, 2.0)])
    edits = Edits(added={"carl": Added("carl", Change(way), scene=other)})
    there = edited(hill, edits).nodes["carl"]
    assert isinstance(there, AddedObject)
    for time, place in ((0.0, (55.0, -10.0)), (1.0, (70.0, 2.0)), (0.5, (62.5, -4.0))):
        frame = there.change.path.frame(time, there.recorded)
        assert frame[2, 3] - pelvis == pytest.approx(slope(*place), abs=0.15)  # the ground is told from a circle of 1 m
    assert off_the_ground(hill, edits) == {}
    # As the world's zero is that of the first camera: the height of a pelvis over it is meters over the road.
    high = Edits({CAR: Change(replace(way, heights=[-9.0, 5.0]))}, {
        "carl": Added("carl", Change(replace(way, heights=[0.9, 0.9])), scene=other),
        "sent away": Added(TRAM, Change(Driven([0.0], [(500.0, 0.0)], heights=[0.0]))),
    })  # fmt: skip
    off = off_the_ground(hill, high)
    assert off == {"carl": pytest.approx(0.9 - pelvis - slope(55, -10), abs=0.15), CAR: pytest.approx(-8.35, abs=0.2)}
    with pytest.raises(
        ValueError, match=r"nothing stands still within 8 m of \(500.0, 0.0\), where 'carl' goes: say z"
    ):
        edited(hill, Edits(added={"carl": Added("carl", Change(Driven([0.0], [(500.0, 0.0)])), scene=other)}))


def test_a_held_person_stops_walking_and_a_copied_one_walks_on(people):
    anna = people.nodes["people"].rows.instances.numpy() == 0
    there = edited(people, Edits({"anna": Change(Held(0.25))}, {"twin": Added("anna", Change(Moved(right=1.0)))}))
    for time in (0.25, 0.75):
        np.testing.assert_allclose(
            of(there, "anna", time)["means"], of(people, "people", 0.25)["means"][anna], atol=2e-6
        )
        assert (of(there, "people", time)["opacities"][anna] == 0).all()
    own = of(people, "people", 0.75)["means"][anna]
    twin = of(there, "twin", 0.75)["means"]
    np.testing.assert_allclose(np.diff(twin, axis=0), np.diff(own, axis=0), atol=4e-6)
    np.testing.assert_allclose(np.linalg.norm(twin - own, axis=1), 1.0, atol=1e-5)


def test_frames_of_a_request_are_turned_along_the_shorter_arc():
    end = placed(1.0, 2.0, 3.0, -3.0)
    way = Given(placed(yaw=3.0), end, (0.2, 0.4))
    middle = way.frame(0.3, lambda time: np.eye(4))
    np.testing.assert_allclose(middle, placed(0.5, 1.0, 1.5, np.pi), atol=1e-12)
    np.testing.assert_allclose(way.frame(9.0, lambda time: np.eye(4)), end, atol=1e-12)
    assert Given(placed(1.0)).frame(0.3, lambda time: np.eye(4))[0, 3] == 1


def test_a_name_of_megabytes_is_compared_by_its_beginning(scene, monkeypatch):
    """difflib would take seconds for it, and a request may hold one."""
    compared: list[int] = []
    monkeypatch.setattr("difflib.get_close_matches", lambda name, *_, **__: compared.append(len(name)) or [])
    with pytest.raises(ValueError, match=r"no object 'xxx.*xxx\.\.\.': the nearest names are ") as told:
        edited(scene, Edits({"x" * (16 << 20): REMOVED}))
    assert compared == [100]
    assert len(str(told.value)) < 300


def test_wrong_names_are_named(scene):
    with pytest.raises(ValueError, match=r"no object 'tram 13': the nearest names are tram 12"):
        edited(scene, Edits({"tram 13": REMOVED}))
    with pytest.raises(ValueError, match="'new' is made of another object: the scene has no object 'tram 13'"):
        edited(scene, Edits(added={"new": Added("tram 13")}))
    with pytest.raises(ValueError, match="has an object 'tram 12' already"):
        edited(scene, Edits(added={TRAM: Added(CAR)}))
    with pytest.raises(ValueError, match="node of the scene is named 'road'"):
        edited(scene, Edits(added={"road": Added(CAR)}))
    with pytest.raises(ValueError, match=r"to a later one, got 0\.5 to 0\.5"):
        Moved(during=(0.5, 0.5))
    with pytest.raises(ValueError, match="increasing times"):
        Driven([0.0, 0.0], [(0.0, 0.0), (1.0, 1.0)])
    with pytest.raises(ValueError, match="heights for each of its 2 times, got 1"):
        Driven([0.0, 1.0], [(0.0, 0.0), (1.0, 1.0)], heights=[0.0])
