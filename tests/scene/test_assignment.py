"""Who takes which object of a log."""

import pytest
import torch

from sparsestreet.scene.build import Assignment, assign_tracks
from sparsestreet.types import Track
from tests.scene.street import background_settings, pose, rigid_settings, track

CARS = rigid_settings(classes=("Car", "Van"), min_path_length=1.0)
PEOPLE = rigid_settings(classes=("Pedestrian",), min_path_length=0.0)


def moving(name: str, class_name: str, meters: float) -> Track:
    return track(name, [0, 3], [pose(0.0, (0.0, 0.0, 0.0)), pose(0.0, (meters, 0.0, 0.0))], class_name=class_name)


TRACKS = [
    moving("a", "Car", 5.0),
    moving("b", "Pedestrian", 2.0),
    moving("c", "Car", 0.5),
    moving("d", "Van", 9.0),
    moving("e", "Tram", 9.0),
    moving("f", "Pedestrian", 0.0),
]


def names(tracks: tuple[Track, ...]) -> list[str]:
    return [track.name for track in tracks]


def test_each_track_is_in_one_place():
    nodes = {"background": background_settings(), "people": PEOPLE, "cars": CARS}
    assignment = assign_tracks(TRACKS, nodes)
    taken = {name: names(tracks) for name, tracks in assignment.by_node.items()}
    assert taken == {"background": [], "people": ["b"], "cars": ["a", "d"]}
    # Too short a path, a class that no node has, no path at all.
    assert names(assignment.unclaimed) == ["c", "e", "f"]
    assert names(assignment.claimed) == ["b", "a", "d"]
    assert sorted(names(assignment.claimed) + names(assignment.unclaimed)) == names(tuple(TRACKS))


def test_a_path_must_be_longer_than_the_shortest():
    exactly = moving("x", "Car", 1.0)
    assert names(assign_tracks([exactly], {"cars": CARS}).unclaimed) == ["x"]
    assert names(assign_tracks([moving("y", "Car", 1.001)], {"cars": CARS}).claimed) == ["y"]


def test_a_parked_car_trembles_a_mover_gets_somewhere():
    generator = torch.Generator().manual_seed(0)
    noise = 0.01 * torch.randn(2, 150, 3, generator=generator).double()
    x = torch.linspace(0, 2.0, 150)
    parked = track("parked", list(range(150)), [pose(0.0, tuple(error.tolist())) for error in noise[0]])
    slow = track(
        "slow",
        list(range(150)),
        [pose(0.0, (float(at), *error.tolist()[1:])) for at, error in zip(x, noise[1], strict=True)],
    )
    assert parked.path_length > 3.0
    by_path, by_displacement = rigid_settings(), rigid_settings(min_displacement=1.0, min_path_length=0.0)
    assert names(assign_tracks([parked, slow], {"cars": by_path}).claimed) == ["parked", "slow"]
    assert names(assign_tracks([parked, slow], {"cars": by_displacement}).claimed) == ["slow"]
    both = rigid_settings(min_displacement=1.0, min_path_length=100.0)
    assert assign_tracks([parked, slow], {"cars": both}).claimed == ()


def test_two_claimers_are_named_with_their_track():
    vans = rigid_settings(classes=("Van",), min_path_length=0.0)
    with pytest.raises(ValueError) as caught:  # noqa: PT011 (the message is compared below)
        assign_tracks(TRACKS, {"cars": CARS, "background": background_settings(), "vans": vans})
    assert str(caught.value) == (
        "track 'd' (Van) can belong to one node only, but cars and vans claim it: "
        "take 'Van' out of one of node.cars.classes, node.vans.classes"
    )


def test_nodes_may_share_a_class_if_their_paths_part_them():
    """The rule is about tracks, not about classes."""
    far = rigid_settings(classes=("Car",), min_path_length=100.0)
    assert names(assign_tracks(TRACKS, {"cars": CARS, "far": far}).by_node["cars"]) == ["a", "d"]


def test_a_log_without_tracks_and_a_scene_without_nodes():
    assert assign_tracks([], {"cars": CARS}) == Assignment({"cars": ()}, ())
    assert names(assign_tracks(TRACKS, {}).unclaimed) == ["a", "b", "c", "d", "e", "f"]
