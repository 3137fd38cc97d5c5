"""Nodes that move or change their shape without boxes, trained on the tiny street from their own files in conf/."""

import csv
from pathlib import Path

import pytest
import torch

from sparsestreet import load_scene
from sparsestreet.cli.commands.train import train
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Deformable, Field, Smpl
from tests.typed import as_a


def trained(tiny_street: list[str], out: Path, *overrides: str) -> tuple[SceneGraph, list[dict[str, str]]]:
    """The scene of a run, and its curves."""
    assert train([*tiny_street, "trainer.log_every_n_steps=1", f"out={out}", *overrides]) == 0
    with (out / "curves" / "metrics.csv").open() as file:
        return load_scene(out).scene, list(csv.DictReader(file))


def of_steps(curves: list[dict[str, str]], name: str) -> list[float]:
    return [float(row[name]) for row in curves if row.get(name)]


@pytest.mark.slow
def test_a_vibrating_street(tiny_street, tmp_path):
    """Its loss falls, its times and velocities are learned, and it grows where and when images ask for it."""
    thresholds = ["node.background.density.grad_threshold=1e9", "node.background.density.peak_threshold=1e-4"]
    scene, curves = trained(tiny_street, tmp_path / "run", "method=pvg", *thresholds)
    node = scene.nodes["background"]
    losses = of_steps(curves, "train/photometric")
    assert sum(losses[-12:]) < 0.9 * sum(losses[:12])
    assert of_steps(curves, "train/background/velocity")[-1] > 0
    assert node.rows.velocities.any()
    assert len(node.rows.log_life_spans.unique()) > 100
    with (tmp_path / "run" / "records" / "counts.csv").open() as file:
        grown = [row for row in csv.DictReader(file) if row["reason"] == "densify"]
    assert int(grown[-1]["after"]) > int(grown[0]["before"])  # by the life peaks alone
    assert torch.isfinite(node.rows.life_peaks).all()


@pytest.mark.slow
def test_a_street_deformed_by_a_network(tiny_street, tmp_path):
    """Its loss falls, and what moves is learned from the time on at which it begins."""
    scene, curves = trained(tiny_street, tmp_path / "run", "method=deformgs", "node.background.deform_from=0.5")
    node = as_a(Field, scene.nodes["background"])
    losses = of_steps(curves, "train/photometric")
    assert sum(losses[-12:]) < 0.9 * sum(losses[:12])
    assert node.network.last.weight.any()
    assert torch.isfinite(node.network.last.weight).all()


@pytest.mark.slow
def test_objects_deformed_by_a_network(tiny_street, tmp_path):
    """Its loss falls, the network and the boxes are learned, rows come and go, with a mask over time."""
    scene, curves = trained(
        tiny_street,
        tmp_path / "run",
        "method=3dgs",
        "node=[background,deformable]",
        "sparsify=masks",
        "node.deformable.has_body_pose=null",
        "node.deformable.deform_from=0.5",
        "node.deformable.points_per_instance=100",
        "node.deformable.min_gaussians=60",
        "effects.box_poses.when=on",
    )
    node = as_a(Deformable, scene.nodes["deformable"])
    losses = of_steps(curves, "train/photometric")
    assert sum(losses[-12:]) < 0.9 * sum(losses[:12])
    assert node.network.last.weight.any()
    assert node.translation_deltas.any()
    assert max(of_steps(curves, "train/deformable/out_of_box")) > 0
    assert len(node.instances().names) > 0


@pytest.mark.slow
def test_people_on_skeletons(tiny_street, tmp_path):
    """Its loss falls, poses and joints are learned, a mask over time takes rows, and the file brings all of it back."""
    scene, curves = trained(
        tiny_street,
        tmp_path / "run",
        "node=[background,smpl]",
        "sparsify=masks",
        "node.smpl.body.num_vertices=500",
        "node.smpl.smoothness_weight=0.1",
        "node.smpl.neighbor_weight=1e-3",
        "node.smpl.scale_weight=0.05",
        "node.smpl.min_gaussians=60",
        "effects.box_poses.when=on",
        "schedule.mask_feature_rate=0.25",
        "schedule.lambda_m=3e6",
    )
    node = as_a(Smpl, scene.nodes["smpl"])
    losses = of_steps(curves, "train/photometric")
    assert sum(losses[-12:]) < 0.9 * sum(losses[:12])
    for corrections in (node.rotation_deltas, node.translation_deltas, node.joint_deltas):
        assert corrections.any()
        assert torch.isfinite(corrections).all()
    for term in ("neighbors", "scale", "smoothness"):
        # 0 in a step whose view shows nobody.
        assert max(of_steps(curves, f"train/smpl/{term}")) > 0
    with (tmp_path / "run" / "records" / "counts.csv").open() as file:
        changes = [row for row in csv.DictReader(file) if row["node"] == "smpl"]
    assert {row["reason"] for row in changes} == {"start", "mask"}
    assert 60 <= len(node.rows) < int(changes[0]["after"])
