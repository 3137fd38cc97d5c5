"""Which effects a scene has, where they act, and what it is without one of them."""

import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from sparsestreet.data.lazy import as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.phases import PhaseRecorder, clock_of
from sparsestreet.scene.build import build_scene
from sparsestreet.scene.effects import (
    AffineSettings,
    BoxPosesSettings,
    CameraPosesSettings,
    Effect,
    EffectSettings,
    ExposureSettings,
    LensSettings,
    MotionBlurSettings,
    ShutterSettings,
    Sky,
    SkySettings,
    plan_effects,
)
from sparsestreet.scene.effects.optics import Pinhole
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions, render
from sparsestreet.scene.state import FINISHED, SceneState
from sparsestreet.scene.storage import StoredScene, load_scene, save_scene
from sparsestreet.types import Shutter, View
from tests.cli.toy.gain import Gain, GainSettings
from tests.scene.street import (
    background,
    background_settings,
    camera_at,
    keyframes,
    pose,
    random_rows,
    rigid,
    street_log,
    track,
    training_data,
)
from tests.typed import there

CAMERA = camera_at(-6.0, width=17, height=11)
BENT = replace(CAMERA, distortion=torch.tensor([-0.2, 0.05, 0.0, 0.0, 0.0]))
ROLLING = replace(CAMERA, shutter=Shutter(torch.tensor([0.3, 0.0, 0.0]), torch.zeros(3)))
ALL = {"sky": SkySettings(resolution=2), "lens": LensSettings(), "shutter": ShutterSettings()}
GAIN = GainSettings(evenness=0.5)


def log_through(lens: bool = False, shutter: bool = False) -> DrivingLog:
    """The street, seen by a camera with a lens or a rolling shutter."""

    def seen(frame):
        camera = replace(frame.camera, distortion=BENT.distortion if lens else None)
        return replace(frame, camera=replace(camera, shutter=ROLLING.shutter if shutter else None))

    log = street_log()
    return replace(log, frames=as_frames(tuple(seen(frame) for frame in log.frames)))


def built(effects: dict[str, EffectSettings], log: DrivingLog) -> dict[str, Effect]:
    nodes = {"road": background_settings(lidar=5)}
    return dict(
        build_scene(log, log.frames, frozenset(), nodes, plan_effects(effects, training_data(log)), 0).effects.items()
    )


def scene_of(**effects: Effect) -> SceneGraph:
    return SceneGraph({"road": background(random_rows(9, 0))}, effects)


def sky() -> Sky:
    """Of many colors."""
    made = Sky(SkySettings(resolution=4))
    with torch.no_grad():
        made.texels.uniform_(0, 1, generator=torch.Generator().manual_seed(2))
    return made


def gain(*factors: float) -> Gain:
    made = Gain(GAIN, len(factors))
    with torch.no_grad():
        made.log_gains.copy_(torch.tensor(factors).log())
    return made


@torch.no_grad()
def picture(scene: SceneGraph, camera=CAMERA, camera_index: int | None = 0, time: float = 0.5) -> torch.Tensor:
    view = View(camera, time, None, camera_index)
    return render(scene, view, options=RenderOptions(backend="reference")).rgb


@pytest.mark.parametrize(("lens", "shutter"), [(False, False), (True, False), (False, True), (True, True)])
def test_a_scene_has_what_its_log_calls_for(lens: bool, shutter: bool, caplog):
    wanted = {"sky": True, "lens": lens, "shutter": shutter}
    with caplog.at_level(logging.INFO):
        assert list(built(ALL, log_through(lens, shutter))) == [name for name, has in wanted.items() if has]
    # One line for each that is on, and one for all others.
    assert ("effect 'lens' is on: 1 of 1 cameras of hand-made have a lens" in caplog.text) is lens
    rest = [message for message in caplog.messages if message.startswith("effects that are not on: ")]
    assert all(message.endswith(" (sparsestreet effects says why)") for message in rest)
    assert [message.count("lens") for message in rest] == ([] if lens and not rest else [int(not lens)])


def test_a_lens_is_simulated_where_it_moves_pixels_far_enough():
    """By the same formula along the diagonal of the image: r (1 - 0.2 r^2 + 0.05 r^4) at its corner, undone."""
    log = log_through(lens=True)
    (fx, _, cx), (_, fy, cy), _ = log.views[0].camera.intrinsics.tolist()
    found = LensSettings().detect(training_data(log))
    assert (found.called_for, found.unit, found.threshold, found.declared) == (True, "px", 0.5, True)
    corner = math.hypot(cx / fx, cy / fy)
    ray = corner
    for _ in range(100):
        ray += corner - ray * (1 - 0.2 * ray**2 + 0.05 * ray**4)
    # Pixels are square, so a distance along the diagonal is one of pixels.
    assert fx == fy
    assert there(found.value) == pytest.approx((ray - corner) * fx, rel=1e-5)
    for least, called_for in ((0.0, True), (0.999 * there(found.value), True), (1.001 * there(found.value), False)):
        effects = built({"lens": LensSettings(min_shift=least)}, log)
        # A lens that is left out is in the cameras of the log, and is taken from them.
        assert isinstance(effects["lens"], Pinhole) != called_for
    assert log.views[0].camera.distortion is not None


def test_of_several_lenses_the_strongest_decides():
    log = log_through(lens=True)
    weak = [
        replace(frame, camera_index=1, camera=replace(frame.camera, distortion=0.1 * there(frame.camera.distortion)))
        for frame in log.frames
    ]
    both = replace(log, frames=as_frames((*log.frames, *weak)), num_cameras=2)
    alone, found = (LensSettings().detect(training_data(one)) for one in (log, both))
    assert found.value == alone.value
    assert found.reason.startswith("2 of 2 cameras")


def test_effects_act_in_the_order_of_the_configuration():
    gains = replace(GAIN, when="on")
    assert list(built({"gain": gains, "sky": SkySettings(resolution=2)}, street_log())) == ["gain", "sky"]
    # Behind the gain the sky is as it was; before it, it is as much brighter as the street.
    first, last = scene_of(sky=sky(), gain=gain(1.3)), scene_of(gain=gain(1.3), sky=sky())
    plain, street = picture(scene_of(sky=sky())), picture(scene_of())
    torch.testing.assert_close(picture(first), 1.3 * plain)
    torch.testing.assert_close(picture(last), plain + 0.3 * street)


@pytest.mark.parametrize(
    ("name", "lacks"), [("lens", "0 of 1 cameras of hand-made have a lens"), ("shutter", "readout")]
)
def test_what_the_log_cannot_support_is_an_error_that_says_what_is_missing(name: str, lacks: str):
    with pytest.raises(ValueError, match=rf"effects.{name} is on, but .*{lacks}.*or say auto"):
        built({name: replace(ALL[name], when="on")}, street_log())


def test_what_is_off_is_absent():
    off = {"sky": SkySettings(when="off"), "affine": AffineSettings(), "exposure": ExposureSettings(when="off")}
    assert built(off, log_through(lens=True)) == {}


def test_a_lens_and_a_shutter_that_are_off_are_taken_from_the_camera():
    off = {"lens": LensSettings(when="off"), "shutter": ShutterSettings(when="off")}
    effects = built(off, log_through(lens=True, shutter=True))
    assert not any(effect.is_on for effect in effects.values())
    scene = scene_of(sky=sky(), **effects)
    plain = picture(scene_of(sky=sky()))
    for camera in (CAMERA, BENT, ROLLING):
        assert torch.equal(picture(scene, camera), plain)


@pytest.mark.parametrize(("name", "camera"), [("lens", BENT), ("shutter", ROLLING)])
def test_without_lens_or_shutter_the_image_is_that_of_a_camera_without(name: str, camera):
    effect = ALL[name].restore({}, {})
    scene = scene_of(sky=sky(), **{name: effect})
    assert not torch.equal(picture(scene, camera), picture(scene))
    bare = scene.without(name)
    # The sky's rays, too.
    assert torch.equal(picture(bare, camera), picture(scene))
    assert list(bare.effects) == ["sky", name]
    assert torch.equal(picture(bare.without(name), camera), picture(scene))
    assert scene.effects[name] is effect


def test_what_is_left_out_is_gone_and_the_rest_is_the_same():
    scene = scene_of(sky=sky(), gain=gain(1.3))
    bare = scene.without("sky")
    assert list(bare.effects) == ["gain"]
    assert bare.nodes["road"] is scene.nodes["road"]
    torch.testing.assert_close(picture(bare), 1.3 * picture(scene_of()))
    assert list(scene.effects) == ["sky", "gain"]
    with pytest.raises(ValueError, match="no node or effect 'fog' to leave out: choose one of road, sky, gain"):
        scene.without("fog")


class Late(Effect):
    """Shows what is there at the progress of the training."""

    def view(self, view: View, state: SceneState) -> View:
        return replace(view, time=state.progress)


def test_nodes_see_the_view_that_the_effects_make_in_the_state_of_the_training():
    path = keyframes([track("car", [0, 1], [pose(0, (5.0, 0, 0)), pose(1, (9.0, 0, 0))])], 2)
    cars = {"cars": rigid(random_rows(3, 1, instances=torch.zeros(3, dtype=torch.int64)), path, max_gap=1.0)}
    placed = SceneGraph(cars, {"late": Late(GAIN)}).gaussians_at(View(CAMERA, 0.0), SceneState(progress=0.75))
    assert placed.view.time == 0.75
    assert torch.equal(placed.gaussians.means, SceneGraph(cars).gaussians_at(View(CAMERA, 0.75)).gaussians.means)


def test_a_node_and_an_effect_of_one_name_are_an_error():
    with pytest.raises(ValueError, match="a node and an effect are both named sky: rename one of them"):
        SceneGraph({"sky": background(random_rows(1, 0))}, {"sky": sky()})


def test_an_effect_is_a_phase_of_a_frame_where_it_acts_on_the_image():
    recorder = PhaseRecorder(clock_of(torch.device("cpu")))
    recorder.start()
    picture(scene_of(sky=sky(), lens=LensSettings().restore({}, {}), gain=gain(1.3)))
    assert recorder.stop().keys() == {"rest", "scene", "splat", "sky", "gain"}


def test_a_novel_view_has_no_camera_of_the_log():
    scene, plain = scene_of(gain=gain(1.2, 0.9)), picture(scene_of())
    torch.testing.assert_close(picture(scene, camera_index=1), 0.9 * plain)
    torch.testing.assert_close(picture(scene, camera_index=None), (1.2 * 0.9) ** 0.5 * plain)


def test_terms_rates_and_bytes_of_effects_stand_beside_those_of_nodes():
    rated = Gain(replace(GAIN, learning_rates={"log_gains": SkySettings().learning_rates["texels"]}), 3)
    scene = scene_of(gain=rated)
    with torch.no_grad():
        rated.log_gains.fill_(0.2)
    view = View(CAMERA, 0.5)
    parts = scene.gaussians_at(view).parts
    terms = scene.regularizers(view, parts, {"road": torch.ones(9, dtype=torch.bool)}, FINISHED)
    assert terms.keys() == {"gain/evenness"}
    torch.testing.assert_close(terms["gain/evenness"], torch.tensor(0.5 * 0.2**2))
    assert scene.learning_rates()["effects.gain.log_gains"].initial == 0.01
    assert scene.bytes_by_part()["gain"] == 3 * 4
    with pytest.raises(ValueError, match=r"'log_gains' has no learning rate: add one to effects.gain.learning_rates"):
        scene_of(gain=gain(1.0)).learning_rates()


def test_effects_come_back_from_a_file_in_their_order(tmp_path: Path):
    scene = scene_of(gain=gain(1.2, 0.9), sky=sky(), lens=Pinhole(LensSettings(when="off")))
    lens = scene_of(lens=LensSettings().restore({}, {}))
    # Left out of a scene that is then stored, a lens stays left out.
    for saved in (scene, lens, lens.without("lens")):
        save_scene(tmp_path / "scene.safetensors", StoredScene(saved, RenderOptions(), "x", 5))
        again = load_scene(tmp_path).scene
        assert list(again.effects) == list(saved.effects)
        assert torch.equal(picture(again, BENT, 1), picture(saved, BENT, 1))
    assert torch.equal(picture(again, BENT), picture(scene_of()))


@pytest.mark.parametrize(
    ("kind", "changes", "said"),
    [
        (GainSettings, {"evenness": 0.5, "when": "maybe"}, r"when must be auto, on or off, got 'maybe'"),
        (SkySettings, {"resolution": 0}, "at least one texel"),
        (LensSettings, {"min_shift": -1.0}, "min_shift must be pixels >= 0, got .*: to leave out lenses say when=off"),
        (LensSettings, {"min_shift": math.nan}, "min_shift must be pixels >= 0"),
        (MotionBlurSettings, {"min_blur": 0.0}, r"min_blur must be pixels > 0, got .*when=on"),
        (MotionBlurSettings, {"min_blur": math.nan}, "min_blur must be pixels > 0"),
        (ExposureSettings, {"smooth": -1.0}, "smooth must be >= 0, got -1"),
        (AffineSettings, {"weight": -1.0}, r"weight must be >= 0, got -1\.0"),
        (CameraPosesSettings, {"weight": -1.0}, r"must be >= 0, got -1\.0 and 0\.5"),
        (CameraPosesSettings, {"threshold": -1.0}, r"must be >= 0, got 0\.0005 and -1\.0"),
        (BoxPosesSettings, {"threshold": -1.0}, "threshold must be >= 0 cm, got -1"),
    ],
)
def test_settings_that_cannot_be(kind: type[EffectSettings], changes: dict[str, Any], said: str):
    with pytest.raises(ValueError, match=said):
        kind(**changes)
