"""The lidar of the log that a run was trained on."""

from collections.abc import Sequence
from pathlib import Path

from sparsestreet.cli.compose import check_moved
from sparsestreet.cli.named_log import reader_of
from sparsestreet.cli.targets import open_run_config
from sparsestreet.export.layers import LidarReturns
from sparsestreet.records.run import RUN
from sparsestreet.scene.views import RecordedViews


def returns_of(run: Path, views: RecordedViews, parts: Sequence[str] = ()) -> LidarReturns:
    """Returns the sweeps at the times of their frames, in the world of the scene; ``parts`` as for ``open_scene``.

    Raises ValueError in one sentence where the log is not there, is another one, or has no lidar.
    """
    try:
        config = open_run_config(run, parts)
        check_moved(config)
        reader = reader_of(config)
        log, data_hash = reader.read(), reader.data_hash()
    except (OSError, ValueError) as error:
        raise ValueError(f"the layer lidar needs the log that the scene was trained on: {error}") from error
    if RUN.exists(run) and (was := RUN.read(run).data_hash) != data_hash:
        raise ValueError(f"the log is not the one that {run} was trained on (data {data_hash[:9]}, then {was[:9]})")
    times = {view.frame_index: view.time for view in views.all}
    known = {frame: times[frame] for frame in log.sweeps.indices if frame in times}
    if not known:
        raise ValueError("the log has no lidar: leave the layer lidar out")
    return LidarReturns(log.sweeps, known)
