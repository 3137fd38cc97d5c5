"""Where objects come from: the log, its lidar, or nowhere; and the command that finds them."""

import json
import math
import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image

from sparsestreet.cli.commands.data import data
from sparsestreet.cli.commands.evaluate import evaluate
from sparsestreet.cli.commands.train import train
from sparsestreet.cli.config.compose import composed, load_run_config, option_tree
from sparsestreet.cli.config.log_from_options import reader_of
from sparsestreet.cli.config.targets import made
from sparsestreet.cli.runs.folder import TRACKS_FILE
from sparsestreet.cli.runs.run import data_of, recipe_of
from sparsestreet.cli.runs.tracks import found_classes, read_tracks
from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.drivestudio.annotations import role_of
from sparsestreet.pictures import from_above
from sparsestreet.records.run import RUN
from sparsestreet.scene.build import assign_tracks
from sparsestreet.scene.storage import load_scene
from sparsestreet.tracking import street
from sparsestreet.tracking.objects import FoundObject, Kind
from sparsestreet.tracking.scans import Scan
from sparsestreet.tracking.settings import TrackingSettings
from sparsestreet.tracking.street import tracks_of
from sparsestreet.training.moved_views import MovedViews, moved_view_term
from sparsestreet.training.run import build
from sparsestreet.types import Track
from tests.cli.conftest import TINY_BACKGROUND, TINY_RIGID, street_at
from tests.cli.test_resume import stopped_at
from tests.typed import as_a, there

KINDS: dict[str, Kind] = {"Vehicle": "vehicle", "Cyclist": "cyclist", "Pedestrian": "pedestrian"}


def as_found(track: Track) -> FoundObject:
    count, size = len(track.frames), track.size.double().numpy()
    poses, returns = track.world_from_object.numpy(), np.full(count, 9)
    return FoundObject(KINDS[track.class_name], track.frames.numpy(), poses, size, np.full(3, 0.1), returns, 0.8)


class Finder:
    """Finds the annotated objects of a street that move, and remembers which frames it was shown."""

    def __init__(self, tracks: Sequence[Track]) -> None:
        self.objects = tuple(as_found(track) for track in tracks if track.path_length > 1.0)
        self.shown: list[list[int]] = []

    def __call__(self, scans: Sequence[Scan], settings: TrackingSettings, report) -> tuple[FoundObject, ...]:
        self.shown.append([scan.frame for scan in scans if len(scan.points)])
        return self.objects


@pytest.fixture
def finder(tiny_street, monkeypatch) -> Finder:
    made = Finder(reader_of(composed(tiny_street)).read().tracks)
    monkeypatch.setattr(street, "find_objects", made)
    return made


@pytest.fixture
def bare(tiny_street, tmp_path) -> list[str]:
    """The tiny street in a folder without boxes."""
    root = Path(tiny_street[0].partition("=")[2])
    for path in root.iterdir():
        if path.name not in ("instances", "humanpose"):
            os.symlink(path, tmp_path / path.name)
    return ["data=drivestudio", f"data.root={tmp_path}", "cache=null"]


def names(words: Sequence[str]) -> list[str]:
    return [track.name for track in data_of(composed(words)).driving_log.tracks]


def test_annotated_logs_are_as_they_were(tiny_street, finder):
    """Bit by bit, whatever may be found in them."""
    usual, plain = data_of(composed(tiny_street)), StreetData(reader_of(composed(tiny_street)).read())
    assert finder.shown == []
    for one, other in zip(usual.driving_log.tracks, plain.driving_log.tracks, strict=True):
        assert torch.equal(one.world_from_object, other.world_from_object)
        assert (one.name, one.found) == (other.name, False)
    for one, other in zip(usual.split.train, plain.split.train, strict=True):
        assert torch.equal(there(one.depth), there(other.depth))
        assert torch.equal(one.image, other.image)


def test_found_objects_take_the_place_of_boxes_or_join_them(tiny_street, finder):
    words = [*tiny_street, "cache=null"]
    known = names(words)
    assert names([*words, "tracks=none"]) == []
    found = [f"found_{number}" for number in range(1, len(finder.objects) + 1)]
    assert names([*words, "tracks=found"]) == found
    assert finder.shown == [[frame for frame in range(12) if frame != 5]]
    assert names([*words, "tracks=found", "tracks.join=true"]) == known  # each of them is annotated
    track = data_of(composed([*words, "tracks=found"])).driving_log.tracks[0]
    assert (track.found, track.class_name) == (True, "Vehicle")
    assert 5 in track.frames


def test_a_log_without_boxes_has_its_objects_found_where_a_node_wants_any(bare, finder, caplog):
    with caplog.at_level("INFO"):
        assert names(bare)[0] == "found_1"
    assert "has no boxes: objects are found in its lidar" in caplog.text
    count = len(finder.shown)
    for words in (["tracks=none"], ["method=3dgs"], ["method=pvg"], ["data.log.lidar=false"]):
        assert names([*bare, *words]) == []
    assert len(finder.shown) == count


def test_a_method_says_what_becomes_of_found_objects(tiny_street, finder, caplog):
    """People have no body poses, so that OmniRe bends their boxes' content; PVG has no objects."""
    finder.objects = (*finder.objects, replace(finder.objects[-1], kind="pedestrian"))
    words = [*tiny_street, "cache=null", "tracks=found"]
    with caplog.at_level("INFO"):
        for method in ("3dgs", "deformgs", "pvg"):
            assert names([*words, f"method={method}"])[0] == "found_1"
            assert f"method={method} has no objects: found ones only carry returns" in caplog.text
        caplog.clear()
        cfg = composed([*words, "method=omnire"])
        tracks = data_of(cfg).driving_log.tracks
    assert caplog.text == ""
    for options, rigid, deformable in (
        ([], {"Vehicle"}, {"Cyclist", "Pedestrian"}),
        (["assignment=cyclists_rigid"], {"Vehicle", "Cyclist"}, {"Pedestrian"}),
        (["assignment=all_rigid"], {"Vehicle", "Cyclist", "Pedestrian"}, set()),
    ):
        taken = assign_tracks(tracks, recipe_of(composed([*words, "method=omnire", *options])).nodes).by_node
        classes = {node: {track.class_name for track in some} for node, some in taken.items()}
        assert classes == {"background": set(), "rigid": rigid, "smpl": set(), "deformable": deformable}


def test_what_cannot_be_found_is_one_line(bare, finder):
    with pytest.raises(ValueError, match=r"tracks are found in lidar, and .* has none: read its lidar"):
        names([*bare, "tracks=found", "data.log.lidar=false"])
    with pytest.raises(ValueError, match=r"tracks\.join is true or false, got 'maybe'"):
        names([*bare, "tracks=found", "tracks.join=maybe"])
    cfg = composed([*bare, "data.classes.cyclist=[]"])
    with pytest.raises(ValueError, match=r"a found cyclist needs a class: name one, data.classes.cyclist=\[cyclist\]"):
        found_classes(cfg)


def test_thresholds_in_conf_are_those_of_the_class():
    said = option_tree("tracks", "found")["settings"]
    assert made(OmegaConf.create(said)) == TrackingSettings()
    assert said.keys() - {"_target_"} == set(TrackingSettings.__dataclass_fields__)


def test_the_command_writes_boxes_that_our_reader_finds_and_keeps_its_answer(
    bare, finder, tmp_path, capsys, monkeypatch
):
    shown: list[np.ndarray] = []
    whole = from_above.box_in_image
    monkeypatch.setattr(from_above, "box_in_image", lambda image, *rest: shown.append(image) or whole(image, *rest))
    root, to = Path(bare[1].partition("=")[2]), tmp_path / "out"
    words = ["tracks", str(root), f"to={to}", f"cache={tmp_path / 'kept'}"]
    assert data(words) == 0
    said = capsys.readouterr().out.splitlines()
    assert len([line for line in said if line.startswith("found_")]) == len(finder.objects)
    assert any(line.split()[:2] == ["found_1", "vehicle"] and line.endswith("0.80") for line in said)
    for picture in ("from_above.png", "objects.png"):
        with Image.open(to / picture) as image:
            assert min(image.size) > 200
    assert finder.shown == [list(range(12))]
    assert data(words) == 0
    assert "taken from" in capsys.readouterr().out
    assert len(finder.shown) == 1
    os.symlink(to / "instances", root / "instances")
    log = DriveStudioReader(root).read()
    images = [frame.image.numpy() for frame in log.frames]
    assert all(any(np.array_equal(one, image) for image in images) for one in shown)
    assert len(shown) > len(finder.objects) / 2
    for track, each in zip(log.tracks, finder.objects, strict=True):
        assert role_of(track.class_name) == each.kind
        assert track.frames.tolist() == each.frames.tolist()
        assert np.allclose(track.world_from_object.numpy(), each.world_from_object, atol=1e-9)


def test_the_command_of_a_log_in_which_nothing_moves(bare, finder, tmp_path, capsys):
    finder.objects = ()
    assert data(["tracks", bare[1].partition("=")[2], f"to={tmp_path / 'out'}", "cache=null"]) == 0
    assert ": nothing found in 12 sweeps" in capsys.readouterr().out
    assert (tmp_path / "out" / "from_above.png").is_file()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "say sparsestreet data tracks DIR"),
        (["{log}", "{log}"], "name one folder"),
        (["{log}", "to="], "to=DIR names one folder"),
        (["{log}", "out=boxes"], "out= is of trainings: say to=boxes"),
        (["{log}", "tracks=none"], "tracks=none does not: leave it out"),
        (["{log}", "tracks.settings.min_moved=far"], "tracks.settings.min_moved must be float"),
        (["{log}", "data.log.lidar=false"], "tracks are found in lidar"),
    ],
)
def test_a_wrong_command_is_one_line(words, said, bare, finder, capsys):
    root = bare[1].partition("=")[2]
    assert data(["tracks", *(word.replace("{log}", root) for word in words)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.startswith("sparsestreet data tracks: ")
    assert error.count("\n") == 1


def test_found_boxes_are_seen_as_annotated_ones(tiny_street, finder):
    """Points, effects, moved views and depth are the same to the last bit, whoever drew the boxes."""
    words = [*tiny_street, *TINY_RIGID, "assignment=all_rigid", "cache=null", "effects.box_poses.when=off"]
    recipe, log = recipe_of(composed(words)), reader_of(composed(words)).read()
    boxes = [track for track in log.tracks if track.path_length > 1.0]
    found = tracks_of(log, finder.objects, found_classes(composed(words)))
    one, other = (StreetData(log.with_tracks(tracks)) for tracks in (boxes, found))
    plans = [recipe.plan(data) for data in (one, other)]
    assert [planned.on for planned in plans[0].effects] == [planned.on for planned in plans[1].effects]
    numbers = [[planned.finding.value for planned in plan.effects] for plan in plans]
    assert numbers[0] == numbers[1]
    systems = [build(recipe, data, plan) for data, plan in zip((one, other), plans, strict=True)]
    states = [system.state_dict() for system in systems]
    assert states[0].keys() == states[1].keys()
    for name, value in states[0].items():
        assert torch.equal(value, states[1][name]), name
    for frame, twin in zip(one.split.train, other.split.train, strict=True):
        assert torch.equal(there(frame.depth), there(twin.depth))
    for mine, theirs in zip(one.driving_log.sweeps, other.driving_log.sweeps, strict=True):
        assert torch.equal(mine.colors, theirs.colors)
    terms = [
        there(moved_view_term(MovedViews(), data, system.scene, recipe.nodes, seed=0)).returns
        for data, system in zip((one, other), systems, strict=True)
    ]
    assert len(terms[0].objects) > 0
    for frame, mine in terms[0].objects.items():
        assert torch.equal(mine.points, terms[1].objects[frame].points)
        assert torch.equal(mine.colors.values, terms[1].objects[frame].colors.values)
    assert torch.equal(terms[0].street.points, terms[1].street.points)


@pytest.mark.slow
def test_held_out_sweeps_lend_nothing(tmp_path):
    """The search itself, in a street whose held-out sweep is another street's: boxes and objects are the same."""
    words = [word for word in street_at(tmp_path / "street") if not word.startswith("data.lidar")]
    words += ["data.lidar.beams=32", "data.lidar.azimuth_steps=600"]
    assert data(["make", *words]) == 0
    poisoned = tmp_path / "poisoned"
    poisoned.mkdir()
    for path in (tmp_path / "street").iterdir():
        if path.name == "lidar":
            shutil.copytree(path, poisoned / "lidar")
        elif path.name not in ("instances", "humanpose"):
            os.symlink(path, poisoned / path.name)
    options = ["tracks=found", "assignment=all_rigid", "cache=null", *TINY_BACKGROUND, *TINY_RIGID]
    roots = ["data=drivestudio", f"data.root={poisoned}", *options]
    found = []
    for stain in (False, True):
        if stain:
            rows = np.fromfile(poisoned / "lidar" / "005.bin", np.float32).reshape(-1, 4)
            rows[:, :3] += np.random.default_rng(0).normal(0, 2, (len(rows), 3)).astype(np.float32)
            rows.tofile(poisoned / "lidar" / "005.bin")
        cfg = composed(roots)
        street_data, recipe = data_of(cfg), recipe_of(cfg)
        system = build(recipe, street_data, recipe.plan(street_data))
        found.append((street_data.driving_log.tracks, system.state_dict()))
    (tracks, state), (others, other_state) = found
    assert len(tracks) > 3
    for track, other in zip(tracks, others, strict=True):
        assert torch.equal(track.world_from_object, other.world_from_object)
        assert torch.equal(track.size, other.size)
    rigid = [name for name in state if ".rigid." in name]
    assert rigid
    assert all(torch.equal(state[name], other_state[name]) for name in rigid)


def test_a_run_keeps_what_it_found(tiny_street, finder, tmp_path, capsys):
    """Stopped, gone on with and measured, it sees the same objects, whatever would be found by then."""
    options = ["tracks=found", "assignment=all_rigid", "cache=null", "schedule.max_steps=12", "checkpoint_every=5"]
    run = stopped_at(11, tiny_street, tmp_path / "run", [*TINY_RIGID, *options])
    cfg, found = load_run_config(run), read_tracks(run, reader_of(composed(tiny_street)).read())
    for track, each in zip(found, finder.objects, strict=True):
        assert np.array_equal(track.world_from_object.numpy(), each.world_from_object)  # to the last bit
    finder.objects, count = (), len(finder.shown)
    assert train([f"resume={run}"]) == 0
    assert evaluate([str(run)]) == 0
    assert len(finder.shown) == count
    for track, other in zip(data_of(cfg, run).driving_log.tracks, found, strict=True):
        assert torch.equal(there(track.times), there(other.times))
        assert (track.name, track.class_name, track.span, track.found) == (
            other.name, other.class_name, other.span, True,
        )  # fmt: skip
    path = run / TRACKS_FILE
    whole = json.loads(path.read_text())
    capsys.readouterr()
    for damage, said in (
        (lambda first: first["frames"].append(99), "found_1 has frames beyond the 12 of tiny"),
        (lambda first: first["poses"].pop(), "found_1 lacks a size, a pose of 16 numbers for each frame"),
        (lambda first: first["poses"][0].__setitem__(0, 2.0), "each pose of object found_1"),
        (lambda first: first.update(times=None), "found_1 lacks a size, a pose of 16 numbers for each frame, their"),
        (lambda first: first.update(span=[0.0, math.inf]), "is not strict JSON"),
        (lambda first: first.update(name="found_2"), "'found_2' stands twice"),
        (lambda first: first.update(name="found_99"), "the scene has an object found_1 that was not found in tiny"),
    ):
        tree = json.loads(json.dumps(whole))
        damage(tree["tracks"][0])
        path.write_text(json.dumps(tree))
        assert evaluate([str(run)]) == 1
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1
    path.unlink()
    assert evaluate([str(run)]) == 1
    assert "put back the .hydra/tracks.json of its run, or train it again" in capsys.readouterr().err
    path.write_text(json.dumps(whole))
    assert train([*tiny_street, *TINY_RIGID, *options, "tracks=log", "overwrite=true", f"out={run}"]) == 0
    assert not path.exists()


@pytest.mark.slow
def test_a_street_is_trained_on_what_its_lidar_shows(tmp_path):
    """With the search itself; the lidar has enough rays that nothing is missed."""
    words = [word for word in street_at(tmp_path / "street") if not word.startswith("data.lidar")]
    words += ["data.lidar.beams=32", "data.lidar.azimuth_steps=600", *TINY_BACKGROUND, *TINY_RIGID]
    words += ["tracks=found", "assignment=all_rigid", "schedule.max_steps=40", f"out={tmp_path / 'run'}"]
    words += ["evaluation.timing.warmup=1", "evaluation.timing.repeats=2", "evaluation.timing.rounds=1"]
    assert train([*words, "effects.sky.resolution=8", "schedule.refine_in.every=10"]) == 0
    decisions = {decision.name: decision for decision in there(RUN.find(tmp_path / "run")).effects}
    assert decisions["box_poses"].on
    assert "7 moving objects are found, not annotated" in decisions["box_poses"].reason
    nodes = load_scene(tmp_path / "run").scene.nodes
    assert len(as_a(torch.Tensor, nodes["rigid"].state_dict()["sizes"])) == 7
