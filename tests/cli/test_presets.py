"""The presets that are DriveStudio's (at e59bda4): how they compose, and the table beside its settings."""

import ast
import itertools
from typing import Any

import pytest

from sparsestreet.cli.commands.presets import SAID, WIDTH, lines, overview, pairs, presets, rows_of
from sparsestreet.cli.config.compose import CONF, resolved
from sparsestreet.cli.config.validate import config_problem, preset_notes
from sparsestreet.cli.runs.run import recipe_of
from sparsestreet.records.configuration import flat_config
from sparsestreet.training.callbacks import DensityControl
from sparsestreet.training.schedule import Course, Interval
from tests.cli.configurations import composed
from tests.typed import as_a

FULL = ("schedule=paper", "capacity=paper")
PAIRS = pairs()


def flat(preset: str, method: str, *more: str) -> dict[str, Any]:
    return flat_config(resolved(composed(f"preset={preset}", f"method={method}", *(more or FULL))))


def at(step: float) -> Any:
    """A step of 30,000 as a fraction of the run."""
    return pytest.approx(step / 30_000, rel=1e-9)


def per_node(*nodes: str, **values: Any) -> dict[str, Any]:
    """Of each node; ``density__keep_parent`` is its ``density.keep_parent``."""
    return {f"node.{node}.{key.replace('__', '.')}": value for node in nodes for key, value in values.items()}


def random_points(name: str) -> dict[str, Any]:
    values = {"blind": True, "largest_scale": None, "initial_opacity": 0.1}
    return {f"node.background.sources.{name}.{key}": value for key, value in values.items()}


REFINED = {
    "sharp_shape_form": "ratio",
    "density__cull_scale_from": at(3_000),
    "density__split_shrink": 1.6,
    "density__keep_parent": True,
    "density__clone_shrunk": True,
    "density__steady_means": False,  # dup_in_optim: zeros for exp_avg and exp_avg_sq
}
"""What its code does with every node that it refines, and no key says."""
OBJECTS = REFINED | {"box_points": 0}
ALL = {
    "image_points": None,
    "data.log.lidar_ahead": [-2, 80],  # truncated_min_range, truncated_max_range
    "optimizer.eps": 1e-15,
    "optimizer.largest_radius": None,
    "optimizer.relative_length": 1.0,
    "render.settings.eps2d": 0.3,
    "render.settings.alpha_max": 0.999,  # of gsplat 1.3.0, as the next four
    "render.settings.stop": "exclusive",
    "render.settings.clamp_colors": True,
    "render.settings.detach_directions": True,
    "render.settings.half_colors": False,
    "schedule.refine_in.start": at(501),  # warmup_steps 500, exclusive
    "schedule.refine_in.stop": 1.0,
    "schedule.densify_until": at(14_999),  # stop_split_at 15000, exclusive
    "schedule.reset_in.start": at(501),  # the same
    "schedule.reset_in.shift": 100,
    "schedule.reset_in.stop": 1.0,
    "schedule.pause_after_reset": None,
    "callback.density_control.pause_after_reset": None,
    "callback.density_control.first_counts_all": True,
    "loss.photometric.weight": 1.0,
    "loss.depth.nearest": 0.01,
    "loss.depth.nearest_rendered": 1e-4,
    "loss.depth.farthest": 80.0,
    "effects.shutter.when": "off",
    "effects.exposure.when": "off",  # its module for every image is the affine map
    "node.background.sources.images.number": 0,
    "node.background.sources.lidar.box_enlargement": None,
    "node.background.sources.lidar.voxel": None,
    "node.background.sources.lidar.initial_opacity": 0.1,
    **random_points("near"),
    **random_points("far"),
    **per_node("background", **REFINED),
    "node.background.max_gaussians": None,
}
LEGACY = {"effects.affine.when": "off", "loss.dynamic_region.threshold": 0.2}
RIGID = per_node("rigid", **OBJECTS)
PEOPLE = {
    "node.smpl.sharp_shape_form": "ratio",
    "node.smpl.density": None,
    "node.smpl.random_colors": True,
    "node.smpl.smoothness_weight": 0.0,
}
DEFORMABLE = {
    **per_node("deformable", **OBJECTS),
    "node.deformable.refine_boxes": False,
    "node.deformable.network.skip": 5,
}
FIELD = {
    "node.background.time_noise": 0.1,
    "node.background.time_noise_until": at(20_000),
    "node.background.reach": None,
    "node.background.network.skip": 5,
    "node.background.network.scales": True,
}
VIBRATING = {
    "effects.affine.weight": 0.0,  # trainer.losses has no affine
    "schedule.densify_until": at(19_999),
    "node.background.density.cycle": 0.2,
    "node.background.min_factor": 0.05,
    "node.background.max_gaussians": 3_000_000,
}
BY_HAND = {
    ("drivestudio", "3dgs"): ALL,
    ("drivestudio", "streetgs"): ALL | RIGID,
    ("drivestudio", "omnire"): ALL | RIGID | PEOPLE | DEFORMABLE | {"node.smpl.volume_weight": 0.0},
    ("drivestudio", "deformgs"): ALL | FIELD,
    ("drivestudio", "pvg"): ALL | VIBRATING,
    ("drivestudio_legacy", "streetgs"): ALL | LEGACY | RIGID,
    ("drivestudio_legacy", "omnire"): ALL | LEGACY | RIGID | PEOPLE | DEFORMABLE,
}
"""Values of upstream's code that no key says, or that the table of keys lacks."""
USUAL, FURTHER = ["photometric", "sky", "depth"], ["opacity_entropy", "inverse_depth_smoothness"]
LOSSES = {
    "drivestudio": USUAL,
    "drivestudio_legacy": [*USUAL, *FURTHER, "dynamic_region"],
    "pvg": [*USUAL, *FURTHER],
}


@pytest.mark.parametrize(("preset", "method"), PAIRS)
def test_what_no_key_says_is_upstreams(preset: str, method: str):
    found, expected = flat(preset, method), BY_HAND[preset, method]
    # None: there is none, or it is off.
    there = {key: (found.get(key) or None) if value is None else found[key] for key, value in expected.items()}
    assert there == expected


@pytest.mark.parametrize(("preset", "method"), PAIRS)
def test_rates_fall_and_scale_where_upstreams_do(preset: str, method: str):
    """No key of upstream's says that a rate is constant, or none of the scene's radius."""
    rows = {row.key: row for row in rows_of(preset, method) if row.ours != "-"}
    found = flat(preset, method)
    for key, row in rows.items():
        if key.endswith(".lr"):
            for rate in (ours.removesuffix(".initial") for ours in alternatives(row.ours)):
                assert (f"{rate}.final" in found) == (f"{key}_final" in rows), rate
                scale = rows.get(f"{key.removesuffix('lr')}scale_factor")
                by_radius = scale is not None and scale.upstream == "scene_radius"
                assert bool(found.get(f"{rate}.scale_by_scene_radius")) == by_radius, rate


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
    assert cfg.moved_views is None
    new = set(flat(preset, method)) - set(flat_config(resolved(plain))) - {"moved_views"}
    assert all(key.startswith(("preset.", "loss.")) for key in new)


@pytest.mark.parametrize(("preset", "method"), PAIRS)
@pytest.mark.parametrize("size", [FULL, ()], ids=["full", "short"])
def test_masks_do_not_change_how_long_a_preset_grows(preset: str, method: str, size: tuple[str, ...]):
    plain, masked = (
        composed(f"preset={preset}", f"method={method}", f"sparsify={name}", *size) for name in ("none", "paper")
    )
    growth = masked.callback.density_control
    assert (growth.densify_until, growth.refine_in) == (plain.schedule.densify_until, plain.schedule.refine_in)


def test_a_method_without_a_configuration_is_refused_in_one_line():
    for method in ("3dgs", "deformgs", "pvg"):
        assert config_problem(composed("preset=drivestudio_legacy", f"method={method}")) == (
            f"preset=drivestudio_legacy has no configuration of method={method}: choose method=omnire or streetgs, or "
            "another preset"
        )


def test_only_the_full_size_has_the_name_of_upstream():
    whole, short = (composed("preset=drivestudio", "method=pvg", *size) for size in (FULL, ()))
    assert (whole.preset.label, short.preset.label) == ("-drivestudio", "-drivestudio_scaled")
    assert [any("is scaled" in note for note in preset_notes(cfg)) for cfg in (whole, short)] == [False, True]


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

    def resets(steps: int) -> list[int]:
        return [step for step in range(1, steps + 1) if interval.due(step, Course(steps))]

    assert resets(30_000) == [3_100, 6_100, 9_100, 12_100, 15_100, 18_100, 21_100, 24_100, 27_100]
    # Its code: step > warm-up and step % 3,000 == 100. The scaled warm-up is 33.3 steps of 2,000 and 100 of 6,000.
    assert resets(2_000) == [100]
    assert resets(5_900) == [100, 3_100]
    assert resets(6_000) == [3_100]


@pytest.mark.slow
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


def alternatives(ours: str) -> list[str]:
    """``node.a|b.rate`` as the keys that it stands for."""
    return [".".join(parts) for parts in itertools.product(*(part.split("|") for part in ours.split(".")))]


def literal(cell: str) -> Any:
    try:
        return ast.literal_eval(cell)
    except (ValueError, SyntaxError):
        return cell


@pytest.mark.parametrize(("preset", "method"), PAIRS)
def test_our_values_are_those_that_the_preset_composes(preset: str, method: str):
    cfg = composed(f"preset={preset}", f"method={method}", *FULL)
    flat: dict[str, Any] = dict(flat_config(resolved(cfg)))
    lists = {key: value for key, value in flat.items() if isinstance(value, list)}
    flat |= {f"{key}.{index}": item for key, items in lists.items() for index, item in enumerate(items)}
    rows = rows_of(preset, method)
    ours = [row for row in rows if row.ours != "-"]
    assert len(ours) > 60
    for row in ours:
        found = [flat[key] for key in alternatives(row.ours)]
        assert found == [literal(row.value)] * len(found), row.key
    notes = [row.reason.removesuffix(SAID).strip() for row in rows if row.verdict == "said" or SAID in row.reason]
    said = set(cfg.preset.absent.values())
    assert said == {note for note in said if any(note in one for one in notes)}
    assert all(any(note in one for note in said) for one in notes)


@pytest.mark.parametrize(("preset", "method"), PAIRS)
def test_every_key_has_one_row_and_every_difference_its_reason(preset: str, method: str):
    rows = [row for row in rows_of(preset, method) if row.verdict != "said"]
    assert len({row.key for row in rows}) == len(rows) > 100
    assert all((row.verdict == "equal") == (row.reason == "") for row in rows)
    assert all((row.verdict == "absent") == (row.ours == "-") for row in rows)
    text = list(lines(rows_of(preset, method)))
    assert max(map(len, "\n".join(text).splitlines())) <= WIDTH
    assert sum(line.startswith(("equal ", "differs ", "absent ")) for line in text) == len(rows)


def test_the_columns_stand_under_their_titles(capsys):
    assert presets(["streetgs", "preset=drivestudio", "only=differs"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "preset=drivestudio method=streetgs beside configs/streetgs.yaml of DriveStudio (e59bda4)"
    title, row, reason = printed[printed.index("") + 1 :][:3]
    assert title.split() == ["logging", "upstream", "here"]
    assert row.split() == ["differs", "saveckpt_freq", "15000", "1000", "checkpoint_every"]
    assert (title.index("upstream"), title.index("here")) == (row.index("15000"), row.index("1000 "))
    assert reason.strip() == "how often a run says or keeps something"


def test_the_page_has_the_counts_that_the_command_prints():
    page = (CONF.parent / "docs" / "baselines.md").read_text()
    assert "\n".join(overview()).partition("\n\n")[0] in page
