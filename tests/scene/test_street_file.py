"""A .street shows nearly the same, keeps what is no row bit for bit, and refuses whatever was done to it."""

import io
import json
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import zstandard

import sparsestreet
from sparsestreet.codec import container
from sparsestreet.codec.container import FrameReader, FrameWriter
from sparsestreet.scene import street_file
from sparsestreet.scene.effects import CameraPoses, Effect
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.masks import StaticMaskSettings, TemporalMaskSettings
from sparsestreet.scene.nodes import Background, Smpl
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.storage import StoredScene, load_scene, rig_record, save_scene, views_of
from sparsestreet.scene.street_file import attached_file, save_street
from sparsestreet.scene.views import write_views
from sparsestreet.types import View
from tests.export.street import street_views
from tests.scene.effects import test_affine, test_camera_poses, test_exposure, test_motion_blur
from tests.scene.nodes import test_deformable, test_field, test_vibrating
from tests.scene.people import smpl, walker
from tests.scene.stored import background, pixels, stored, view
from tests.scene.street import random_rows


def people(**changes) -> Smpl:
    node = smpl(walker(), walker("other", y=2.0, seed=4), **changes)
    with torch.no_grad():
        node.joint_deltas.add_(0.1 * torch.randn(node.joint_deltas.shape, generator=torch.Generator().manual_seed(2)))
        node.rotation_deltas.add_(0.1)
    return node


def corrected() -> CameraPoses:
    return test_camera_poses.effect(view().camera, indices=((0, 0), (2, 0)), times=(0.0, 1.0), dtype=torch.float32)


def road(**effects: Effect) -> SceneGraph:
    return SceneGraph({"road": background(9, 0, sh_degree=1)}, effects)


PARTS = {
    "people": lambda: SceneGraph({"one": people(mask=StaticMaskSettings(1e-4))}),
    "masked people": lambda: SceneGraph({"one": people(mask=TemporalMaskSettings(1e-4), masked=True)}),
    "deformable": lambda: SceneGraph({"one": test_deformable.objects(outside_weight=0.7, refine_boxes=False)}),
    "field": lambda: SceneGraph({"one": test_field.street()}),
    "vibrating": lambda: SceneGraph({"one": test_vibrating.vibrating(60, velocity_weight=0.25)}),
    "affine": lambda: road(one=test_affine.affine(test_affine.MIXING)),
    "exposure": lambda: road(one=test_exposure.exposure()),
    "poses": lambda: road(one=corrected()),
    "blur": lambda: test_motion_blur.street(one=test_motion_blur.blur(3)),
}


def scene_of(**nodes) -> StoredScene:
    return StoredScene(SceneGraph(nodes), RenderOptions(), "x", 5)


def rms(one: StoredScene, other: StoredScene, time: float) -> float:
    return float((one.render(view(time)).rgb - other.render(view(time)).rgb).square().mean().sqrt())


def rewritten(path: Path, change: Callable[[dict], object]) -> None:
    """The same file with another header, and checksums that are right."""
    content = io.BytesIO(path.read_bytes())
    reader = FrameReader(content)
    header = json.loads(reader.read("HEAD"))
    rest = content.read()
    change(header)
    file = io.BytesIO()
    FrameWriter(file).write("HEAD", [json.dumps(header).encode()])
    path.write_bytes(file.getvalue() + rest)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    save_street(tmp_path / "a.street", stored(), {"views.json": b"[1]", "rig.json": b""})
    return tmp_path / "a.street"


@pytest.mark.parametrize("sh_degree", [0, 1, 3])
@pytest.mark.parametrize("masked", [False, True])
def test_the_picture_is_nearly_the_same_and_all_else_is_the_same(tmp_path: Path, sh_degree: int, masked: bool):
    scene = stored(sh_degree, masked=masked)
    save_scene(tmp_path / "scene.safetensors", scene)
    exact = load_scene(tmp_path)
    save_street(tmp_path / "a.street", scene)
    found = sparsestreet.load_scene(tmp_path / "a.street")
    # 48 dB: far above what a step wrong by a factor of ten would leave.
    assert all(rms(found, exact, time) < 0.004 for time in (0.0, 0.37, 1.0))
    assert (found.name, found.num_frames, found.options) == (exact.name, exact.num_frames, exact.options)
    assert found.scene.counts() == exact.scene.counts()
    wanted = exact.scene.state_dict()
    assert found.scene.state_dict().keys() == wanted.keys()
    for name, value in found.scene.state_dict().items():
        assert value.dtype == wanted[name].dtype
        if ".rows." not in name and "texels" not in name:
            assert torch.equal(value, wanted[name]), name
    assert torch.allclose(
        found.scene.state_dict()["effects.sky.texels"], wanted["effects.sky.texels"], rtol=0, atol=1 / 2048 + 1e-6
    )
    assert not any(module.training for module in found.scene.modules())


@pytest.mark.parametrize("made", PARTS.values(), ids=PARTS.keys())
def test_every_part_comes_back_bit_for_bit_from_a_scene_file_and_nearly_from_a_street(tmp_path: Path, made: Callable):
    scene = StoredScene(made(), RenderOptions(), "x", 5)
    save_scene(tmp_path / "scene.safetensors", scene)
    save_street(tmp_path / "a.street", scene)
    exact, found = load_scene(tmp_path), load_scene(tmp_path / "a.street")
    for frame in (0, 1, 2, None):
        seen = View(replace(view().camera, exposure=0.02), 0.5 if frame is None else frame / 2, frame, 0)
        assert all(map(torch.equal, pixels(exact.render(seen)), pixels(scene.render(seen))))
        assert exact.render(seen).rgb.any()
        assert float((found.render(seen).rgb - exact.render(seen).rgb).square().mean().sqrt()) < 0.008  # 42 dB
    for name in ("nodes", "effects"):
        for part, *others in zip(*(getattr(one.scene, name).values() for one in (scene, exact, found)), strict=True):
            for other in others:
                assert (type(other), other.header()) == (type(part), part.header())
                classes = {"classes": tuple(other.settings.classes)} if name == "nodes" else {}
                assert replace(other.settings, **classes) == part.settings
    assert exact.scene.bytes_by_part()["poses"] == scene.scene.bytes_by_part()["poses"]
    for one, other in zip(exact.scene.nodes.values(), found.scene.nodes.values(), strict=True):
        if one.mask is not None:
            assert torch.equal(one.rows.mask_bits.long().sum(0), other.rows.mask_bits.long().sum(0))


@pytest.mark.parametrize("rows", [0, 1, 255, 256, 257, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_tables_of_all_sizes(tmp_path: Path, rows: int):
    node = background(0, 0, sh_degree=0)
    whole = scene_of(
        road=Background(node.settings, random_rows(rows, 0, sh_degree=0)), other=background(3, 1, sh_degree=1)
    )
    save_street(tmp_path / "a.street", whole)
    found = load_scene(tmp_path / "a.street")
    assert found.scene.counts() == {"road": rows, "other": 3}
    before, after = (one.scene.nodes["road"].rows.means.detach() for one in (whole, found))
    # Sorted along each axis, points that moved by no more than a step are no farther apart.
    assert torch.allclose(before.sort(0).values, after.sort(0).values, rtol=0, atol=0.01)


def test_memory_is_that_of_a_block_beside_the_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(street_file, "BLOCK", 500)
    node = background(5_000, 0, sh_degree=3)
    scene = scene_of(road=node)
    one = node.row_bytes() // len(node.rows)
    tracemalloc.start()
    save_street(tmp_path / "a.street", scene)
    written = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # The order of all rows needs 8 bytes a row several times; values are copied block by block.
    assert written < 5_000 * (one + 200)
    assert load_scene(tmp_path / "a.street").scene.counts() == {"road": 5_000}


def test_rows_far_apart_are_cut_until_they_fit_a_grid(tmp_path: Path):
    node = background(64, 0, sh_degree=0)
    with torch.no_grad():
        node.rows.log_scales.fill_(-9.0)
        node.rows.means[:32] *= 1e6
    save_street(tmp_path / "a.street", scene_of(road=node))
    found = load_scene(tmp_path / "a.street").scene.nodes["road"].rows.means.detach()
    before = node.rows.means.detach()
    nearest = torch.cdist(before.double(), found.double(), compute_mode="donot_use_mm_for_euclid_dist").min(1).values
    # Half a step is a 96th of the size, or half of float32's own rounding.
    bound = torch.maximum(torch.tensor(np.exp(-9.0) / 96), before.abs().amax(1).double() * 2.0**-23)
    assert (nearest <= 2 * bound).all()


def test_attached_files_and_the_views_within(tmp_path: Path, path: Path):
    assert attached_file(path, "views.json") == b"[1]"
    assert attached_file(path, "rig.json") == b""
    assert attached_file(path, "run.json") is None
    with pytest.raises(ValueError, match=r"a.street: views.json"):
        views_of(path)
    write_views(tmp_path / "run" / "views.json", street_views(), [], frame_rate=10.0)
    save_street(tmp_path / "b.street", stored(), {"views.json": (tmp_path / "run" / "views.json").read_bytes()})
    assert views_of(tmp_path / "b.street").frame_rate == 10.0
    assert len(views_of(tmp_path / "b.street").all) == len(views_of(tmp_path / "run").all) == 20
    assert rig_record(tmp_path / "b.street") is None
    # In a run's folder it stands in for the scene file.
    (tmp_path / "b.street").rename(tmp_path / "run" / "scene.street")
    assert load_scene(tmp_path / "run").scene.counts() == stored().scene.counts()


def test_a_file_that_is_not_there_and_one_of_another_kind(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match="there is no scene at"):
        load_scene(tmp_path / "a.street")
    (tmp_path / "a.street").write_bytes(b"\x01\x02\x03\x04" * 100)
    with pytest.raises(ValueError, match=r"a.street is no .street or is damaged: it does not start as a .street does"):
        load_scene(tmp_path / "a.street")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
def test_a_file_that_was_cut(path: Path, share: float):
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=r"^[^\n]*a.street is no .street or is damaged: it ends \d+ bytes early"):
        load_scene(path)


def test_a_changed_byte_anywhere(path: Path):
    content = path.read_bytes()
    for place in range(3, len(content), len(content) // 40):
        path.write_bytes(content[:place] + bytes([content[place] ^ 64]) + content[place + 1 :])
        with pytest.raises(ValueError, match=r"^[^\n]*a.street is no .street or is damaged[^\n]*$"):
            load_scene(path)


def table(header: dict) -> dict:
    return header["tables"]["road"]


HOSTILE = {
    "rows beyond all memory": lambda header: table(header).update(rows=2**47),
    "rows below 0": lambda header: table(header).update(rows=-1),
    "rows in words": lambda header: table(header).update(rows="many"),
    "fewer rows than there are": lambda header: table(header).update(rows=5),
    "harmonics beyond all memory": lambda header: header.update(axes=[2**40]),
    "a tensor beyond all memory": lambda header: header["tensors"].update(x=["float32", [2**20, 2**20], None]),
    "a tensor of objects": lambda header: header["tensors"].update({"effects.sky.texels": ["O", [6, 5, 5, 3], None]}),
    "an attached file beyond all memory": lambda header: header["files"].append(["big", 2**45]),
    "a sky beyond all memory": lambda header: header["scene"]["effects"]["sky"]["settings"].update(resolution=2**20),
    "a column beyond all memory": lambda header: table(header)["others"].update(x=["int64", [2**30], None]),
    "no tables": lambda header: header.pop("tables"),
    "no scene": lambda header: header.update(scene=None),
    "another version": lambda header: header["scene"].update(version=99),
}


@pytest.mark.parametrize("change", HOSTILE.values(), ids=HOSTILE.keys())
def test_a_hostile_header_is_refused_in_one_line_with_bounded_memory(path: Path, change: Callable[[dict], object]):
    rewritten(path, change)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"^[^\n]*a.street is no .street or is damaged[^\n]*$"):
            load_scene(path)
        assert tracemalloc.get_traced_memory()[1] < 2**27
    finally:
        tracemalloc.stop()


def test_a_sky_is_not_made_larger_than_its_texels(path: Path):
    rewritten(path, lambda header: header["scene"]["effects"]["sky"]["settings"].update(resolution=300))
    with pytest.raises(ValueError, match=r"texels of shape \(6, 5, 5, 3\), its settings say \(6, 300, 300, 3\)"):
        load_scene(path)


def test_a_header_of_nested_lists(path: Path):
    content = path.read_bytes()
    deep = b"[" * 200_000
    stored_bytes = zstandard.compress(deep)
    sizes = struct.pack("<4sII", b"HEAD", len(stored_bytes), len(deep))
    path.write_bytes(content[:10] + sizes + struct.pack("<I", zlib.crc32(sizes + stored_bytes)) + stored_bytes)
    with pytest.raises(ValueError, match=r"^[^\n]*a.street is no .street or is damaged[^\n]*$"):
        load_scene(path)


def test_rows_that_unpack_to_more_than_the_file_may(path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(container, "FREE", 2000)
    monkeypatch.setattr(container, "PER_BYTE", 1)
    with pytest.raises(ValueError, match=r"claims .* unpacked, above its limit"):
        load_scene(path)


def test_a_scene_with_numbers_that_are_none_is_not_written(tmp_path: Path):
    scene = stored()
    with torch.no_grad():
        scene.scene.nodes["road"].rows.log_scales[3, 1] = torch.nan
    with pytest.raises(ValueError, match=r"log_scales must be finite, but row \d+ has nan: the scene is damaged"):
        save_street(tmp_path / "a.street", scene)
    assert list(tmp_path.iterdir()) == []
