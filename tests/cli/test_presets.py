"""The presets that are DriveStudio's, key by key, against its configurations at e59bda4, taken down as they are."""

import itertools
from typing import Any

import pytest

from sparsestreet.cli.assemble import recipe_of
from sparsestreet.cli.checks import config_problem
from sparsestreet.cli.compose import CONF, resolved
from sparsestreet.cli.preset import preset_notes
from sparsestreet.records.configuration import flat_config
from sparsestreet.training.callbacks import DensityControl
from sparsestreet.training.schedule import Course, Interval
from tests.cli.configurations import composed
from tests.typed import as_a

FULL = ("schedule=paper", "capacity=paper")
METHODS = {
    "drivestudio": ("3dgs", "deformgs", "omnire", "pvg", "streetgs"),
    "drivestudio_legacy": ("omnire", "streetgs"),
}
PAIRS = [(preset, method) for preset, methods in METHODS.items() for method in methods]


def flat(preset: str, method: str, *more: str) -> dict[str, Any]:
    return flat_config(resolved(composed(f"preset={preset}", f"method={method}", *(more or FULL))))


def at(step: float) -> Any:
    """A step of 30,000 as a fraction of the run."""
    return pytest.approx(step / 30_000, rel=1e-9)


def rates(node: str, name: str, initial: float, final: float | None = None, *, by_radius: bool = False) -> dict:
    key = f"node.{node}.learning_rates.{name}"
    found = {f"{key}.initial": pytest.approx(initial), f"{key}.scale_by_scene_radius": by_radius or None}
    return found | {f"{key}.final": None if final is None else pytest.approx(final)}


def needles(node: str) -> dict:
    """reg.sharp_shape_reg: w 1.0, step_interval 10, max_gauss_ratio 10.0."""
    found = {"sharp_shape": 1.0, "sharp_shape_every": 10, "max_axis_ratio": 10.0, "sharp_shape_form": "ratio"}
    return {f"node.{node}.{key}": value for key, value in found.items()}


def general(node: str, *, sh_dc: float = 2.5e-3, sh_rest: float = 1.25e-4, rotation: float = 1e-3) -> dict:
    """trainer.gaussian_optim_general_cfg, without xyz and opacity."""
    return (
        rates(node, "sh_dc", sh_dc)
        | rates(node, "sh_rest", sh_rest)
        | rates(node, "log_scales", 5e-3)
        | rates(node, "quaternions", rotation)
    )


def control(node: str, **differs: Any) -> dict:
    """trainer.gaussian_ctrl_general_cfg."""
    found = {
        "split_children": 2,
        "reset_opacity_to": 0.01,
        "split_scale": 0.003,
        "cull_opacity": 0.005,
        "cull_scale": 0.5,
        "cull_screen": 0.15,
        "split_screen": 0.05,
        "screen_size_until": at(3_999),  # stop_screen_size_at 4000, exclusive
        "cull_scale_from": at(3_000),
        "split_shrink": 1.6,
        "keep_parent": True,
        "clone_shrunk": True,
    }
    return {f"node.{node}.density.{key}": value for key, value in (found | differs).items()}


def start(lidar: int, near: int, far: int) -> dict:
    """model.Background.init: from_lidar.num_samples, near_randoms, far_randoms."""
    found = {
        "images.number": 0,
        "lidar.number": lidar,
        "lidar.box_enlargement": None,
        "lidar.voxel": None,
        "lidar.initial_opacity": 0.1,
    }
    for name, number in (("near", near), ("far", far)):
        guesses = {"number": number, "blind": True, "largest_scale": None, "initial_opacity": 0.1}
        found |= {f"{name}.{key}": value for key, value in guesses.items()}
    return {f"node.background.sources.{key}": value for key, value in found.items()}


ALL = {
    "seed": 0,
    "image_points": None,
    "data.log.undistort": True,
    "data.log.lidar_ahead": [-2, 80],  # truncated_min_range, truncated_max_range
    "data.log.extent": "first_pose",
    "optimizer.eps": 1e-15,
    "split.with_replacement": True,
    "render.settings.near_plane": 0.1,
    "render.settings.antialias": False,
    "render.settings.eps2d": 0.3,
    "render.settings.alpha_max": 0.999,  # of gsplat 1.3.0, as the next four
    "render.settings.stop": "exclusive",
    "render.settings.clamp_colors": True,
    "render.settings.detach_directions": True,
    "render.settings.half_colors": False,
    "render.settings.plain_gradients": False,  # absgrad: True
    "schedule.max_steps": 30_000,
    "schedule.refine_in.every": 100,
    "schedule.refine_in.start": at(501),  # warmup_steps 500, exclusive
    "schedule.refine_in.stop": 1.0,
    "schedule.densify_until": at(14_999),  # stop_split_at 15000, exclusive
    "schedule.reset_in.every": 3_000,
    "schedule.reset_in.shift": 100,
    "schedule.reset_in.stop": 1.0,
    "schedule.pause_after_reset": None,
    "callback.density_control.pause_after_reset": None,
    "callback.density_control.first_counts_all": True,
    "schedule.sh_interval": at(1_000),
    "schedule.resolution.halvings": 2,
    "schedule.resolution.double_in": at(250),
    "loss.photometric.weight": 1.0,
    "loss.photometric.lambda_dssim": 0.2,
    "loss.sky.weight": 0.05,
    "loss.sky.floor": None,
    "loss.depth.nearest": 0.01,
    "loss.depth.nearest_rendered": 1e-4,
    "loss.depth.farthest": 80.0,
    "effects.sky.when": "on",
    "effects.shutter.when": "off",
    "effects.sky.resolution": 1024,
    "effects.sky.learning_rates.texels.initial": 0.01,
    **needles("background"),
    **general("background"),
    **rates("background", "means", 1.6e-4, 1.6e-6, by_radius=True),
    **rates("background", "opacity_logits", 5e-2),
    **control("background"),
    "node.background.sh_degree": 3,
    "node.background.max_gaussians": None,
}
CURRENT = {
    "loss.depth.weight": 0.01,
    "loss.depth.inverse": False,
    "effects.affine.when": "on",
    "effects.affine.weight": 1e-5,
    "effects.affine.decay": 1e-6,
    "effects.affine.learning_rates.deltas.initial": 1e-5,
    **start(800_000, 100_000, 100_000),
}
LEGACY = {
    "effects.affine.when": "off",
    **start(600_000, 200_000, 200_000),
    "loss.depth.weight": 0.1,
    "loss.depth.inverse": True,
    "loss.opacity_entropy.weight": 0.05,
    "loss.inverse_depth_smoothness.weight": 0.001,
    "loss.dynamic_region.weight": 1.0,  # its factor 5 is ignored
    "loss.dynamic_region.threshold": 0.2,
    "loss.dynamic_region.from_progress": at(20_001),  # start_from 20000, exclusive
}
OBJECTS = {"screen_size_until": at(30_000), "cull_scale": 0.1}
RIGID = {
    "node.background.clear_swept_boxes": True,
    "node.rigid.min_path_length": 1.0,
    "node.rigid.box_points": 0,
    **needles("rigid"),
    **general("rigid"),
    **rates("rigid", "means", 1.6e-4, 1.6e-6, by_radius=True),
    **rates("rigid", "opacity_logits", 5e-2),
    **rates("rigid", "rotation_deltas", 2 * 1e-5, 2 * 5e-6),  # of rotation vectors, not of quaternions
    **rates("rigid", "translation_deltas", 5e-4, 1e-4),
    **control("rigid", **OBJECTS),
    "node.rigid.densify_until": at(19_999),
    "node.rigid.box_margin": 0.0,
    "node.rigid.temporal_smooth": 0.01,
    "node.rigid.temporal_smooth_of": "frame",
    "node.rigid.points_per_instance": 5_000,
    "node.rigid.sh_degree": 3,
}
PEOPLE = {
    **needles("smpl"),
    **general("smpl", sh_dc=5e-3, sh_rest=2.5e-4, rotation=5e-3),
    **rates("smpl", "means", 3 * 1.6e-4, 3 * 1.6e-6),
    **rates("smpl", "opacity_logits", 5e-2),
    **rates("smpl", "rotation_deltas", 2 * 1e-5, 2 * 5e-6),
    **rates("smpl", "translation_deltas", 5e-4, 1e-4),
    **rates("smpl", "joint_deltas", 2 * 5e-5, 2 * 1e-5),
    "node.smpl.density": None,
    "node.smpl.min_path_length": 0.5,
    "node.smpl.random_colors": True,
    "node.smpl.temporal_smooth": 0.01,
    "node.smpl.temporal_smooth_of": "frame",
    "node.smpl.neighbors": 3,
    "node.smpl.neighbor_weight": 1e-3,
    "node.smpl.scale_weight": 0.05,
    "node.smpl.smoothness_weight": 0.0,
    "node.smpl.sh_degree": 1,
    "node.smpl.initial_opacity": 0.99,
}
DEFORMABLE = {
    **needles("deformable"),
    **general("deformable"),
    **rates("deformable", "means", 2 * 1.6e-4, 2 * 1.6e-6),
    **rates("deformable", "opacity_logits", 5e-2),
    **rates("deformable", "embeddings", 1e-3, 1e-4),
    **rates("deformable", "network", 5 * 1.6e-3, 5 * 1.6e-4),
    **control("deformable", **OBJECTS, reset_opacity_to=0.1),
    "node.deformable.min_path_length": 0.5,
    "node.deformable.box_points": 0,
    "node.deformable.refine_boxes": False,
    "node.deformable.densify_until": at(19_999),
    "node.deformable.deform_from": at(3_001),  # use_deformgs_after 3000, exclusive
    "node.deformable.detach_means": True,
    "node.deformable.outside_weight": 1.0,
    "node.deformable.features": 16,
    "node.deformable.network.depth": 8,
    "node.deformable.network.width": 256,
    "node.deformable.network.skip": 5,
    "node.deformable.network.position_octaves": 10,
    "node.deformable.network.time_octaves": 10,
    "node.deformable.network.scales": False,
    "node.deformable.points_per_instance": 5_000,
    "node.deformable.sh_degree": 3,
}
FIELD = {
    **rates("background", "network", 5 * 1.6e-4, 2.53e-5),  # 8e-6 would come at step 40,000
    "node.background.density.grad_threshold": 1e-3,
    "node.background.deform_from": at(3_000),
    "node.background.time_noise": 0.1,
    "node.background.time_noise_until": at(20_000),
    "node.background.reach": None,
    "node.background.network.depth": 8,
    "node.background.network.width": 256,
    "node.background.network.skip": 5,
    "node.background.network.position_octaves": 10,
    "node.background.network.time_octaves": 10,
    "node.background.network.scales": True,
}
SINGLE = {"node.background.clear_swept_boxes": False}
VIBRATING = {
    "effects.affine.weight": 0.0,  # trainer.losses has no affine
    "node.background.random_life_peaks": False,
    **rates("background", "opacity_logits", 5e-3),
    **rates("background", "velocities", 1e-3, by_radius=True),
    **rates("background", "log_life_spans", 2e-3),
    **rates("background", "life_peaks", 8e-4, 8e-6),
    **control("background", split_scale=0.01, peak_threshold=0.002, cycle=0.2, grad_threshold=2e-4, split_span=0.01),
    "render.settings.plain_gradients": True,
    "schedule.densify_until": at(19_999),
    "schedule.sh_interval": at(2_000),
    "schedule.resolution.halvings": 3,
    "schedule.resolution.double_in": at(5_000),
    "loss.sky.weight": 1.0,
    "loss.sky.floor": 0.1,
    "loss.depth.weight": 0.1,
    "loss.depth.inverse": True,
    "loss.opacity_entropy.weight": 0.05,
    "loss.inverse_depth_smoothness.weight": 0.001,
    "node.background.frame_time": 0.02,
    "node.background.cycle": 0.2,
    "node.background.initial_life_span": pytest.approx(0.1**0.5),
    "node.background.min_factor": 0.05,
    "node.background.velocity_weight": 0.001,
    "node.background.smoothing_probability": 0.5,
    "node.background.smoothing_frames": 1.5,
    "node.background.max_gaussians": 3_000_000,
}


def threshold(value: float, *nodes: str) -> dict:
    return {f"node.{node}.density.grad_threshold": value for node in nodes}


UPSTREAM = {
    ("drivestudio", "3dgs"): ALL | CURRENT | SINGLE | threshold(5e-4, "background"),
    ("drivestudio", "streetgs"): ALL | CURRENT | RIGID | threshold(5e-4, "background", "rigid"),
    ("drivestudio", "omnire"): ALL
    | CURRENT
    | RIGID
    | PEOPLE
    | DEFORMABLE
    | {"node.smpl.volume_weight": 0.0}
    | threshold(5e-4, "background", "rigid", "deformable"),
    ("drivestudio", "deformgs"): ALL | CURRENT | SINGLE | FIELD,
    ("drivestudio", "pvg"): ALL | CURRENT | SINGLE | VIBRATING,
    ("drivestudio_legacy", "streetgs"): ALL | LEGACY | RIGID | threshold(3e-4, "background", "rigid"),
    ("drivestudio_legacy", "omnire"): ALL
    | LEGACY
    | RIGID
    | PEOPLE
    | DEFORMABLE
    | {
        "node.smpl.volume_weight": 1.0,
        "node.smpl.volume_quantile": 0.99,
        "node.smpl.volume_from": at(6_001),  # start_after 6000, exclusive
    }
    | threshold(3e-4, "background", "rigid", "deformable"),
}
LOSSES = {
    "drivestudio": ["photometric", "sky", "depth"],
    "drivestudio_legacy": [
        "photometric",
        "sky",
        "depth",
        "opacity_entropy",
        "inverse_depth_smoothness",
        "dynamic_region",
    ],
    "pvg": ["photometric", "sky", "depth", "opacity_entropy", "inverse_depth_smoothness"],
}


@pytest.mark.parametrize(("preset", "method"), PAIRS)
def test_every_value_is_upstreams(preset: str, method: str):
    found, expected = flat(preset, method), UPSTREAM[preset, method]
    # None: there is none, or it is off.
    there = {key: (found.get(key) or None) if value is None else found[key] for key, value in expected.items()}
    assert there == expected


@pytest.mark.parametrize(("preset", "method"), PAIRS)
def test_its_parts_fit_together_and_are_no_others(preset: str, method: str):
    cfg = composed(f"preset={preset}", f"method={method}", *FULL)
    assert config_problem(cfg) is None
    assert list(recipe_of(cfg).losses) == LOSSES["pvg" if method == "pvg" else preset]
    assert cfg.name == f"{method}-{preset}"
    # A preset sets keys of the method's nodes and parts; a slip would make new ones.
    plain = composed(f"method={method}", *FULL)
    assert list(cfg.node) == list(plain.node)
    assert list(cfg.callback) == list(plain.callback)
    new = set(flat(preset, method)) - set(flat_config(resolved(plain)))
    assert all(key.startswith(("preset.", "loss.")) for key in new)


def test_a_method_without_a_configuration_is_refused_in_one_line():
    for method in ("3dgs", "deformgs", "pvg"):
        assert config_problem(composed("preset=drivestudio_legacy", f"method={method}")) == (
            f"preset=drivestudio_legacy has no configuration of method={method}: choose method=omnire or streetgs, or "
            "another preset"
        )


def test_the_files_are_those_of_the_table():
    folder = CONF / "preset" / "method"
    there = {name: tuple(sorted(path.stem for path in (folder / name).glob("*.yaml"))) for name in METHODS}
    assert there == METHODS


@pytest.mark.parametrize(("capacity", "schedule"), [*itertools.product(["small", "paper"], ["short", "paper"])])
def test_only_the_full_size_has_the_name_of_upstream(capacity: str, schedule: str):
    cfg = composed("preset=drivestudio", "method=pvg", f"schedule={schedule}", f"capacity={capacity}")
    whole = (capacity, schedule) == ("paper", "paper")
    assert cfg.preset.label == ("-drivestudio" if whole else "-drivestudio_scaled")
    assert any("is scaled" in note for note in preset_notes(cfg)) == (not whole)


def test_a_short_run_has_the_same_shape():
    """Milestones are fractions of the run; rates, weights and thresholds stay."""
    full, short = flat("drivestudio", "omnire"), flat("drivestudio", "omnire", "schedule=short", "capacity=paper")
    differ = {key for key in full if full[key] != short[key] and not key.startswith(("schedule.", "preset.", "node."))}
    assert differ <= {"name", "out", "trainer.max_steps"}
    assert all("mask" in key for key in full if key.startswith("node.") and full[key] != short[key])
    assert short["schedule.max_steps"] == 2_000
    kept = ("refine_in", "densify_until", "reset_in", "pause_after_reset", "sh_interval", "resolution", "rates")
    for key in full:
        if key.startswith(tuple(f"schedule.{name}" for name in kept)):
            assert short[key] == full[key], key


def test_resets_come_at_the_steps_of_upstream():
    callbacks = recipe_of(composed("preset=drivestudio", "method=streetgs", *FULL)).callbacks
    interval = as_a(DensityControl, callbacks["density_control"]).reset_in
    assert isinstance(interval, Interval)
    resets = [step for step in range(30_001) if interval.due(step, Course(30_000))]
    assert resets == [3_100, 6_100, 9_100, 12_100, 15_100, 18_100, 21_100, 24_100, 27_100]
    assert not any(interval.due(step, Course(2_000)) for step in range(2_001))


def test_what_is_lacking_is_said_in_plain_words():
    cfg = composed("preset=drivestudio_legacy", "method=omnire", *FULL)
    (note,) = preset_notes(cfg)
    assert note.startswith("preset drivestudio_legacy lacks of DriveStudio: ")
    assert "skinned" in note
    assert "camera poses" not in note  # upstream's legacy has none
    assert "camera poses are not refined" in next(preset_notes(composed("preset=drivestudio", "method=pvg", *FULL)))
    assert list(preset_notes(composed())) == []
    # The configuration of a run has it.
    assert any(key.startswith("preset.absent.") for key in flat("drivestudio", "pvg"))


@pytest.mark.lengthy
@pytest.mark.parametrize(("preset", "method"), [("drivestudio_legacy", "omnire"), ("drivestudio", "pvg")])
def test_a_preset_trains_and_says_what_it_is(preset: str, method: str, run_train, tmp_path, capsys):
    """Every part of it: smaller images first, density control, all terms."""
    few = [f"node.background.sources.{name}.number={number}" for name, number in (("lidar", 600), ("near", 100))]
    run_train(
        tmp_path,
        f"preset={preset}",
        f"method={method}",
        "image_points=none",  # as the preset has it; said for the street of the tests
        "trainer.fast_dev_run=12",
        "schedule.refine_in.every=5",
        "schedule.pause_after_reset=0",
        *few,
        "node.background.sources.far.number=100",
    )
    said = capsys.readouterr().out
    assert said.count(f"preset {preset} is scaled: ") == 1
    assert said.count(f"preset {preset} lacks of DriveStudio: ") == 1
