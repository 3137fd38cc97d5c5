import logging

import torch

from sparsestreet.scene.build import build_scene, find_points
from sparsestreet.scene.effects import EffectPlan, SkySettings, plan_effects
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.triangulation import ImagePointSettings, StreetPoints
from tests.scene.street import background_settings, rigid_settings, street_log, training_data, triangulated, view_at

BACKGROUND = background_settings(lidar=30, near=10, far=10)
CARS = rigid_settings()


def build(nodes: dict, effects: dict | None = None, seed: int = 0) -> SceneGraph:
    log = street_log()
    plan = plan_effects(effects or {}, training_data(log, frozenset({3})))
    return build_scene(log, log.frames, frozenset({3}), nodes, plan, seed)


def test_all_parts():
    scene = build({"background": BACKGROUND, "rigid": CARS}, {"sky": SkySettings(resolution=4)})
    assert scene.counts() == {"background": 50, "rigid": 1000}
    assert scene.effects["sky"].texels.shape == (6, 4, 4, 3)
    assert len(scene.gaussians_at(view_at(0.3)).gaussians) == 1050


def test_a_class_without_instance_is_left_out_and_reported(caplog):
    with caplog.at_level(logging.WARNING):
        scene = build({"background": BACKGROUND, "trams": rigid_settings(classes=("Tram",))})
    assert list(scene.nodes) == ["background"]
    assert len(scene.effects) == 0
    assert "node 'trams' has no instance in hand-made" in caplog.text


def test_a_node_does_not_depend_on_its_neighbors():
    first = build({"background": BACKGROUND, "cars": CARS})
    second = build({"trees": BACKGROUND, "cars": CARS, "background": BACKGROUND})
    for name in ("background", "cars"):
        assert torch.equal(first.nodes[name].rows.means, second.nodes[name].rows.means)
    assert not torch.equal(second.nodes["trees"].rows.means, second.nodes["background"].rows.means)
    other = build({"background": BACKGROUND, "cars": CARS}, seed=1)
    assert not torch.equal(first.nodes["background"].rows.means, other.nodes["background"].rows.means)


def test_a_start_draws_by_its_own_seed_only():
    before = torch.get_rng_state()
    build({"background": BACKGROUND, "cars": CARS})
    assert torch.equal(torch.get_rng_state(), before)


def test_what_no_node_takes_stays_in_the_background():
    lidar = background_settings(lidar=10_000)
    with_cars, without = build({"background": lidar}), build({"background": lidar, "cars": CARS})
    # 60 returns of the moving car in each of the four sweeps that are not held out; its box takes a little road, too.
    assert len(with_cars.nodes["background"].rows) - len(without.nodes["background"].rows) >= 4 * 60
    assert with_cars.counts()["background"] == 4 * (50 + 60)


def test_the_log_says_who_takes_what(caplog):
    with caplog.at_level(logging.INFO):
        build({"background": BACKGROUND, "cars": CARS})
    assert "node 'cars' takes 1 Car" in caplog.text
    assert "no node takes 1 Car, 1 Cyclist: they are part of the background" in caplog.text
    assert "node 'background' starts with 50 Gaussians" in caplog.text


def test_points_from_images_are_made_once_of_what_training_sees(monkeypatch):
    asked = []

    def made(kept, frames, moving, settings) -> StreetPoints:
        asked.append(([view.frame_index for view in frames.views], [track.name for track in moving], settings))
        in_box = triangulated([[0.0, 0.0, 0.0]] * 5000)
        return StreetPoints(triangulated([[9.0, 0.0, 1.0]] * 7), {"driving": in_box})

    monkeypatch.setattr("sparsestreet.scene.build.kept_street_points", made)
    log = street_log()
    frames = log.frames.where(lambda view: view.frame_index != 3)
    nodes = {"background": background_settings(images=7), "cars": CARS}
    settings = ImagePointSettings()
    points = find_points(log, frames, frozenset({3}), nodes, settings)
    scene = build_scene(log, frames, frozenset({3}), nodes, EffectPlan(()), 0, points)
    assert asked == [([0, 1, 2, 4], ["driving"], settings)]
    assert scene.counts() == {"background": 7, "cars": 5000}
    assert find_points(log, frames, frozenset({3}), nodes, None) is None
    assert len(asked) == 1
