"""The quantities of a table: heading, value in the record, and format."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from sparsestreet.metrics.definitions import DRIVESTUDIO, Protocol
from sparsestreet.records.quality import HELD_OUT, TRAINING
from sparsestreet.records.summary import RunSummary
from sparsestreet.report.notes import frames_steady, training_steady


@dataclass(frozen=True)
class Quantity:
    """One quantity of the table."""

    heading: str
    value: Callable[[RunSummary], float | None]
    text: Callable[[float], str]
    relative: bool
    """True: a comparison with the baseline reads as per cent of it (what remains). False: as a signed difference."""
    count: bool = False
    """Whether it counts Gaussians, which a cap can limit."""
    steady: Callable[[RunSummary], bool] = lambda run: True
    """Whether a run's value compares with others: a time of a machine that was not quiet does not."""


def protocol_metrics(protocol: Protocol) -> tuple[tuple[str, str, str], ...]:
    """Returns heading, id and format of each metric of a protocol, and of the metrics by lidar.

    >>> [heading for heading, _, _ in protocol_metrics(DRIVESTUDIO)][:2]
    ['PSNR', 'SSIM']
    """
    return (
        ("PSNR", protocol.psnr, "{:.2f}"),
        ("SSIM", protocol.ssim, "{:.4f}"),
        *((f"LPIPS {name.split('_')[1]}", name, "{:.4f}") for name in protocol.lpips),
        ("vehicle PSNR", protocol.vehicle[0], "{:.2f}"),
        ("vehicle SSIM", protocol.vehicle[1], "{:.4f}"),
        ("human PSNR", protocol.human[0], "{:.2f}"),
        ("human SSIM", protocol.human[1], "{:.4f}"),
        ("near PSNR", "psnr_near_lidar", "{:.2f}"),
        ("beyond PSNR", "psnr_beyond_lidar", "{:.2f}"),
    )


_CAMERA_METRICS = (("", "psnr_full"), (" near", "psnr_near_lidar"), (" beyond", "psnr_beyond_lidar"))


def quantities(runs: Sequence[RunSummary], protocol: Protocol = DRIVESTUDIO) -> tuple[Quantity, ...]:
    """Returns the quantities that at least one of the runs has, with the metrics of a protocol."""
    metrics = protocol_metrics(protocol)
    nodes = dict.fromkeys(name for run in runs for name in run.gaussians)
    known = (
        *(Quantity(heading, _metric(name, HELD_OUT), text.format, False) for heading, name, text in metrics),
        *_training_metrics(runs, metrics),
        Quantity("Gaussians", lambda run: float(run.gaussians_total), "{:,.0f}".format, True, count=True),
        *(Quantity(name, _node_count(name), "{:,.0f}".format, True, count=True) for name in nodes),
        Quantity("MB", lambda run: run.bytes_total / 1e6, "{:.2f}".format, True),
        Quantity("ms/frame", lambda run: run.latency.p50, "{:.1f}".format, True, steady=frames_steady),
        Quantity("train s", lambda run: run.run.training_seconds, "{:.0f}".format, True, steady=training_steady),
    )
    return _measured(known, runs)


def camera_quantities(runs: Sequence[RunSummary]) -> tuple[Quantity, ...]:
    """Returns PSNR of each camera, in full and by lidar, if at least one run has it; nothing for a single camera."""
    cameras = dict.fromkeys(camera for run in runs for camera in run.by_camera[run.main_split])
    known = [
        Quantity(f"camera {camera}{region}", _camera_metric(name, camera), "{:.2f}".format, False)
        for camera in cameras
        for region, name in _CAMERA_METRICS
    ]
    return _measured(known, runs) if len(cameras) > 1 else ()


def _measured(known: Iterable[Quantity], runs: Sequence[RunSummary]) -> tuple[Quantity, ...]:
    return tuple(quantity for quantity in known if any(quantity.value(run) is not None for run in runs))


def _training_metrics(runs: Sequence[RunSummary], metrics: Sequence[tuple[str, str, str]]) -> list[Quantity]:
    """Returns PSNR of the training views, which shows overfitting; all metrics if no run holds out a view."""
    shown = metrics if all(run.main_split == TRAINING for run in runs) else metrics[:1]
    return [
        Quantity(f"train-view {heading}", _metric(name, TRAINING), text.format, False) for heading, name, text in shown
    ]


def _metric(name: str, split: str) -> Callable[[RunSummary], float | None]:
    return lambda run: run.mean(name, split)


def _camera_metric(name: str, camera: str) -> Callable[[RunSummary], float | None]:
    return lambda run: run.camera_mean(name, camera)


def _node_count(name: str) -> Callable[[RunSummary], float | None]:
    return lambda run: float(run.gaussians[name]) if name in run.gaussians else None
