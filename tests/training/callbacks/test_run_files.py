"""What a training leaves for everybody else, when, and what run.json says of it."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog, VehiclePath
from sparsestreet.ops import SplatSettings
from sparsestreet.records.run import RIG, RUN
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.storage import load_scene
from sparsestreet.scene.views import read_views
from sparsestreet.training.callbacks import Clock, RunFiles
from sparsestreet.training.callbacks.density_control import resize_rows
from sparsestreet.training.callbacks.files import TornStop
from sparsestreet.types import Sweep
from tests.evaluation.frames import make_run
from tests.training.stubs import StubTrainer, background, frame_at, make_system, rigid
from tests.typed import there

OPTIONS = RenderOptions(SplatSettings(near_plane=0.25), "reference")


def grown(rows: int, by: int) -> RowPlan:
    source = torch.cat((torch.arange(rows), torch.zeros(by, dtype=torch.int64)))
    return RowPlan(rows, source, torch.arange(rows + by) >= rows)


@pytest.fixture
def trainer(tmp_path) -> StubTrainer:
    """At step 3 of 10; seven instants, of which 1 and 4 are held out; the files are written by its only callback."""
    nodes = {"background": background(4, max_gaussians=10), "rigid": rigid(3)}
    clock = Clock()
    clock.load_state_dict({"seconds": 12.5})
    trainer = StubTrainer(make_system(nodes, options=OPTIONS), [RunFiles(tmp_path, make_run(), clock)], max_steps=10)
    frames = tuple(replace(frame_at(index), seconds=0.25 * index, stamp=250_000_000 * index) for index in range(7))
    shift, vehicle = torch.eye(4).double(), torch.eye(4).double().repeat(2, 1, 1)
    shift[0, 3], vehicle[1, 2, 3] = 0.1 + 0.2, 0.125
    path = VehiclePath(vehicle, (0, 250_000_000))
    points = torch.full((1, 3), 0.5)
    sweeps = tuple(
        Sweep(frame, frame / 6, points, points, torch.ones(1).bool(), origin=torch.tensor([0.1, 0.2, frame]).double())
        for frame in (1, 2, 4)
    )
    log = DrivingLog(
        "seven", as_frames(frames), Sweeps.of(sweeps), (), 7, 1, shift, camera_names=("wide",), vehicle=path
    )
    trainer.datamodule = StreetData(log, stride=3, offset=1)
    trainer.callbacks[0].on_train_start(trainer, trainer.system)
    trainer.walk(3)
    return trainer


def test_intensities_are_learned_of_no_sweep_that_is_held_out(trainer):
    """Of sweeps 1, 2 and 4; an interrupted training learns none."""
    log, asked = trainer.datamodule.driving_log, []

    def intensities(index: int) -> torch.Tensor:
        asked.append(index)
        return torch.ones(1)

    sweeps = Sweeps(log.sweeps.indices, log.sweeps.load, load_intensities=intensities)
    trainer.datamodule = StreetData(replace(log, sweeps=sweeps), stride=3, offset=1)
    for trainer.interrupted in (True, False):
        assert asked == []
        trainer.callbacks[0].on_train_end(trainer, trainer.system)
    assert asked == [2]


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize("end", [("on_train_end",), ("on_exception", KeyboardInterrupt())], ids=lambda end: end[0])
def test_the_end_of_training_and_an_interruption_between_two_steps_leave_all(trainer, tmp_path, end):
    hook, *exception = end
    getattr(trainer.callbacks[0], hook)(trainer, trainer.system, *exception)
    assert files(tmp_path) == {"scene.safetensors", "views.json", "rig.json", "run.json"}
    stored = load_scene(tmp_path)
    assert stored.scene.counts() == trainer.system.scene.counts()
    assert (stored.name, stored.num_frames, stored.options) == ("seven", 7, OPTIONS)
    views = read_views(tmp_path / "views.json")
    assert [view.frame_index for view in views.training] == [0, 2, 3, 5, 6]
    assert [view.frame_index for view in views.held_out] == [1, 4]
    assert (views.frame_rate, [view.seconds for view in views.held_out]) == (4.0, [0.25, 1.0])
    rig = RIG.read(tmp_path)
    assert (rig.camera_names, rig.vehicle_stamps) == (("wide",), (0, 250_000_000))
    assert rig.dataset_from_world[0] == (1.0, 0.0, 0.0, 0.1 + 0.2)  # as they are, not rounded
    assert there(rig.world_from_vehicle)[1][2] == (0.0, 0.0, 1.0, 0.125)
    assert there(rig.lidar) == pytest.approx((0.1, 0.2, 2.0, 2 / 6))
    run = RUN.read(tmp_path)
    assert (run.steps, run.training_seconds) == (trainer.global_step, 12.5)
    assert (run.label, run.caps) == (make_run().label, {})


@pytest.mark.parametrize("exception", [TornStop(), OSError("no space left on device")])
def test_half_a_step_and_a_full_disk_leave_nothing(trainer, tmp_path, exception):
    trainer.callbacks[0].on_exception(trainer, trainer.system, exception)
    assert files(tmp_path) == set()


def test_no_step_and_an_interrupted_end_leave_nothing(trainer, tmp_path):
    trainer.interrupted = True
    trainer.callbacks[0].on_train_end(trainer, trainer.system)
    trainer.global_step = 0
    trainer.callbacks[0].on_exception(trainer, trainer.system, RuntimeError("no data"))
    assert files(tmp_path) == set()


def test_what_fails_while_a_state_is_restored_leaves_nothing(trainer, tmp_path):
    callback = RunFiles(tmp_path, make_run(), Clock())
    callback.on_exception(trainer, trainer.system, ValueError("another optimizer"))
    assert files(tmp_path) == set()


def test_run_json_names_the_nodes_that_their_limit_held_down(trainer, tmp_path):
    """A split adds two rows: at nine of ten there is no room for another one."""
    callback, system = trainer.callbacks[0], trainer.system
    resize_rows(trainer, system, "background", grown(4, 4), "densify")
    resize_rows(trainer, system, "rigid", grown(3, 50), "densify")  # has no limit
    assert callback.caps == {}
    resize_rows(trainer, system, "background", grown(8, 1), "densify")
    assert callback.caps == {"background": 10}
    resize_rows(trainer, system, "background", RowPlan.keep(torch.arange(9) < 2), "cull")
    callback.on_train_end(trainer, system)
    assert RUN.read(tmp_path).caps == {"background": 10}
    torch.save(callback.state_dict(), tmp_path / "state.pt")
    resumed = RunFiles(tmp_path, make_run(), Clock())
    resumed.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert resumed.caps == {"background": 10}


def test_a_cull_to_the_limit_is_no_limit_that_held(tmp_path):
    system = make_system({"background": background(8, max_gaussians=6)})
    callback = RunFiles(tmp_path, make_run(), Clock())
    trainer = StubTrainer(system, [callback])
    resize_rows(trainer, system, "background", RowPlan.keep(torch.arange(8) < 6), "cull")
    assert callback.caps == {}
