"""Images that belong together, with stamps as a genuine rig's."""

from pathlib import Path

import numpy as np
import pytest

from sparsestreet.data.nuscenes.selection import find_instants
from sparsestreet.data.nuscenes.tables import LIDAR, DataFile, Row, SceneFiles

MS = 1_000_000
OFFSETS = {
    "CAM_FRONT": -35.5,
    "CAM_FRONT_LEFT": -43.1,
    "CAM_FRONT_RIGHT": -27.6,
    "CAM_BACK_LEFT": -0.5,
    "CAM_BACK_RIGHT": -20.1,
    "CAM_BACK": -10.4,
}
"""Milliseconds before the end of the turn of a genuine keyframe (nuscenes_one_keyframe)."""
TURNS = (0, 2, 4, 5, 7, 9)
"""Turns of the lidar in half a second at which all cameras fire: 12 images a second."""


def file(stamp: float, sample: int, keyframe: bool) -> DataFile:
    return DataFile(Row(Path("sample_data.json"), {}), Path(f"{stamp}"), sample, keyframe, round(stamp * MS))


def rig(drop: tuple[str, int] | None = None, jitter: float = 0.0) -> SceneFiles:
    """Two seconds. The lidar turns every 50 ms; a sample is every tenth turn."""
    noise = np.random.default_rng(0)
    turns = [turn + 10 * second for second in range(4) for turn in TURNS]
    files = {
        channel: tuple(
            file(50 * turn + offset + noise.uniform(-jitter, jitter), turn // 10, turn % 10 == 0)
            for place, turn in enumerate(turns)
            if (channel, place) != drop
        )
        for channel, offset in OFFSETS.items()
    }
    files[LIDAR] = tuple(file(50 * turn, min(-(-turn // 10), 3), turn % 10 == 0) for turn in range(40))
    samples = [Row(Path("sample.json"), {"token": f"{n}", "timestamp": 500_000 * n}) for n in range(4)]
    row = Row(Path("scene.json"), {"name": "scene-0061"})
    return SceneFiles(Path(), Path(), row, tuple(samples), files, {}, tuple(OFFSETS))


@pytest.mark.parametrize("jitter", [0.0, 8.0])
def test_the_six_images_of_a_turn_and_its_sweep_are_one_instant(jitter):
    """The next turn's front image may be 7 ms nearer to the image of the left back camera than its own."""
    scene = rig(jitter=jitter)
    instants = find_instants(scene, "all")
    assert (len(instants.stamps), len(instants.images), instants.without_instant) == (24, 144, 0)
    for channel in OFFSETS:
        assert [instants.images[n, channel] for n in range(24)] == list(scene.files[channel])
    turns = [turn + 10 * second for second in range(4) for turn in TURNS]
    assert [instants.sweeps[n].stamp for n in range(24)] == [50 * turn * MS for turn in turns]
    assert instants.of_samples == {0: 0, 1: 6, 2: 12, 3: 18}


def test_an_image_that_was_dropped_leaves_a_hole():
    instants = find_instants(rig(drop=("CAM_BACK", 8)), "all")
    assert (8, "CAM_BACK") not in instants.images
    assert len(instants.images) == 143


def test_without_its_front_image_an_instant_is_gone_and_its_images_are_counted():
    instants = find_instants(rig(drop=("CAM_FRONT", 8)), "all")
    assert (len(instants.stamps), len(instants.images), instants.without_instant) == (23, 138, 5)


def test_keyframes_have_the_files_of_their_samples():
    scene = rig()
    instants = find_instants(scene, "keyframes")
    assert instants.stamps == tuple(500 * MS * n for n in range(4))
    assert len(instants.images) == 24
    assert instants.images[2, "CAM_BACK"].stamp == round((1000 - 10.4) * MS)
    assert [instants.sweeps[n].stamp for n in range(4)] == list(instants.stamps)
