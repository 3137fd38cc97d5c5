import logging

import torch

from sparsestreet.scene.build import build_scene
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.seeds import BackgroundSettings, RigidSettings
from sparsestreet.scene.sky import SkySettings
from tests.scene.street import street_log

BACKGROUND = BackgroundSettings(lidar_points=30, near_points=10, far_points=10)


def build(nodes: dict, sky: SkySettings | None = None, seed: int = 0) -> SceneGraph:
    log = street_log()
    return build_scene(log, log.frames, frozenset({3}), nodes, sky, seed)


def test_all_parts():
    scene = build({"background": BACKGROUND, "rigid": RigidSettings(("Car",))}, SkySettings(4))
    assert scene.counts() == {"background": 50, "rigid": 1000}
    assert scene.sky.texels.shape == (6, 4, 4, 3)
    assert len(scene.gaussians_at(0.3).gaussians) == 1050


def test_a_class_without_instance_is_left_out_and_reported(caplog):
    with caplog.at_level(logging.WARNING):
        scene = build({"background": BACKGROUND, "trams": RigidSettings(("Tram",))})
    assert list(scene.nodes) == ["background"]
    assert scene.sky is None
    assert "node 'trams' has no instance in hand-made" in caplog.text


def test_a_node_does_not_depend_on_its_neighbors():
    alone = build({"background": BACKGROUND})
    both = build({"rigid": RigidSettings(("Car",)), "background": BACKGROUND})
    assert torch.equal(alone.nodes["background"].rows.means, both.nodes["background"].rows.means)
    other = build({"background": BACKGROUND}, seed=1)
    assert not torch.equal(alone.nodes["background"].rows.means, other.nodes["background"].rows.means)
