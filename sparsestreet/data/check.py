"""What `sparsestreet data check` prints: every problem of a log, or what a sound one holds."""

from collections.abc import Callable

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sparsestreet.data.hood import check_used, find_hoods, with_ego
from sparsestreet.data.log import DrivingLog, Split, counted, split
from sparsestreet.data.log_warnings import log_warnings
from sparsestreet.data.reader import LogReader
from sparsestreet.geometry.boxes import displacement


def report_check(
    reader: LogReader, console: Console | None = None, split_of: Callable[[DrivingLog], Split] = split
) -> int:
    """Print the problems of what the reader would read, a line each, or a summary; 1 where there are problems, else 0.

    ``split_of``: what a training would hold out; raises ValueError where it cannot.
    """
    console = Console() if console is None else console
    problems = reader.check()
    if problems:
        for problem in problems:
            inside = problem.path.is_relative_to(reader.folder)
            path = problem.path.relative_to(reader.folder) if inside else problem.path
            _line(console, "bold", f"{path}:", f"{problem.message}; {problem.remedy}")
        _line(
            console,
            "bold red",
            f"{len(problems)} to repair",
            f"in {reader.folder}; repair these first: more may be found then",
        )
        return 1
    return _report_log(reader.read(), reader, console, split_of)


def _report_log(log: DrivingLog, reader: LogReader, console: Console, split_of: Callable[[DrivingLog], Split]) -> int:
    try:
        check_used(log.frames, log.name)
    except ValueError as error:
        _line(console, "bold red", "nothing to train on:", str(error))
        return 1
    console.print(_summary(log))
    console.print(_camera_table(log))
    if log.tracks:
        console.print(_track_table(log))
    for note in log.notes:
        _line(console, "yellow", "note", note)
    masks = {camera: hood.mask for camera, hood in find_hoods(log.frames, log.sweeps).items()}
    for doubt in log_warnings(log, with_ego(log.frames, masks)):
        _line(console, "bold yellow", "doubt", doubt)
    try:
        split_of(log)
    except ValueError as error:
        _line(console, "bold red", "not ready to train:", str(error))
        return 1
    _line(console, "bold green", "ready to train:", str(reader.folder))
    return 0


def _line(console: Console, style: str, word: str, text: str) -> None:
    """One line, however narrow the console: whoever reads it may be a program."""
    console.print(f"[{style}]{escape(word)}[/] {escape(text)}", soft_wrap=True)


def _table(*headers: str, title: str) -> Table:
    """Whose columns break names rather than cut them."""
    table = Table(*headers, title=title)
    for column in table.columns:
        column.overflow = "fold"
    return table


def _summary(log: DrivingLog) -> Table:
    table = _table("log", escape(log.name), title="What the log holds")
    counts = [(len(sweep.points), int(sweep.colored.sum())) for sweep in log.sweeps.gray()]
    points, colored = (sum(column) for column in zip(*counts, strict=True)) if counts else (0, 0)
    table.add_row("frames x cameras", f"{log.num_frames} x {log.num_cameras}")
    table.add_row("frames a second", "not known" if log.frame_rate is None else f"{log.frame_rate:.4g}")
    if log.stamps:
        table.add_row("stamps", _stamps(log))
    table.add_row(
        "lidar",
        f"{points:,} points in {counted(len(counts), 'sweep')} ({colored:,} seen by a camera)" if counts else "none",
    )
    if log.sparse_points is not None:
        table.add_row("sparse points", f"{len(log.sparse_points()):,}")
    table.add_row("objects", str(len(log.tracks)))
    table.add_row("scene radius", f"{log.radius:.1f} m")
    return table


def _stamps(log: DrivingLog) -> str:
    """The first stamp, how long the log is, and how far apart the images of a frame are."""
    found: dict[int, list[int]] = {}
    for view in log.views:
        if view.stamp is not None:
            found.setdefault(view.indices[0], []).append(view.stamp)
    apart = max(max(stamps) - min(stamps) for stamps in found.values())
    first, last = min(log.stamps.values()), max(log.stamps.values())
    return f"from {first} ns, {(last - first) / 1e9:.1f} s; images of a frame are at most {apart / 1e6:.1f} ms apart"


def _camera_table(log: DrivingLog) -> Table:
    """Sizes, lenses, shutters, and the masks of each camera's first image."""
    table = _table("camera", "images", "size", "lens", "shutter", "masks", title="Cameras")
    for index in range(log.num_cameras):
        frames = log.frames.where(lambda view, index=index: view.camera_index == index)
        if not frames:
            continue
        frame, camera = frames[0], frames.views[0].camera
        lens = "none" if camera.distortion is None else "simulated"
        shutter = "none" if camera.shutter is None else "rolling"
        masks = [kind for kind in ("sky", "human", "vehicle", "ego") if getattr(frame, kind) is not None]
        size = f"{camera.width}x{camera.height}"
        name = log.camera_names[index] if log.camera_names else str(index)
        table.add_row(escape(name), str(len(frames)), size, lens, shutter, ", ".join(masks) or "none")
    return table


def _track_table(log: DrivingLog) -> Table:
    table = _table("class", "objects", "boxes", "largest displacement (m)", title="Objects")
    for name in sorted({track.class_name for track in log.tracks}):
        tracks = [track for track in log.tracks if track.class_name == name]
        boxes = sum(len(track.frames) for track in tracks)
        table.add_row(escape(name), str(len(tracks)), str(boxes), f"{max(map(displacement, tracks)):.1f}")
    return table
