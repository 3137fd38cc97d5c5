"""The paper's tables made from our records. They keep its rows and columns, and its numbers have their own columns."""

from collections.abc import Sequence
from pathlib import Path

from sparsestreet.metrics.definitions import Protocol
from sparsestreet.records.failures import FailedRun
from sparsestreet.records.quality import HELD_OUT, TRAINING
from sparsestreet.report.arms import Arm, Value, busy_arms
from sparsestreet.report.beside import mean_beside
from sparsestreet.report.grid import ABSENT, Cell, Grid
from sparsestreet.report.published import LAYOUT, TABLES, Key, PublishedRow, PublishedTable

_GROUPS = {TRAINING: "reconstruction", HELD_OUT: "novel views", "novel": "beside the path", "": ""}
_TEXTS = {"psnr": "{:.2f}", "ssim": "{:.3f}", "lpips": "{:.3f}", "fid": "{:.2f}", "fps": "{:.1f}"}


def paper_table(
    arms: Sequence[Arm], failures: Sequence[tuple[Path, FailedRun]], protocol: Protocol, sweep: str | None
) -> Grid:
    """Returns the paper's table that a sweep reproduces; for any other sweep, its arms in the layout of Table 1."""
    table = TABLES.get(sweep or "", LAYOUT)
    left = list(arms)
    rows = []
    for row in table.rows:
        matching = [arm for arm in left if _stands_beside(arm, row)]
        left = [arm for arm in left if arm not in matching]
        if matching:
            rows += [_row(arm.title, arm, table, row, protocol) for arm in matching]
        elif sweep in TABLES:
            rows.append(_row(f"{row.name} (not run)", None, table, row, protocol))
    rows += [_row(arm.title, arm, table, None, protocol) for arm in left]
    rows += [
        _failed(folder, failure, len(rows[0]) if rows else 2 + 2 * len(table.columns)) for folder, failure in failures
    ]
    header = [("", "method"), ("", "n")]
    for key in table.columns:
        header += [(_GROUPS[key[0]], _heading(key)), (_GROUPS[key[0]], f"{_heading(key)}, paper")]
    # The paper's columns stand where it has a number for one of our rows.
    kept = [
        index
        for index, (_, heading) in enumerate(header)
        if sweep in TABLES or not heading.endswith(", paper") or any(row[index].text != ABSENT for row in rows)
    ]
    header, rows = [header[index] for index in kept], [tuple(row[index] for index in kept) for row in rows]
    beside = any(heading.endswith(", paper") for _, heading in header)
    of = f"Table {table.number} of the paper" if sweep in TABLES else "All arms, in the layout of the paper's Table 1"
    return Grid(
        "paper",
        f"{of}: {table.caption}" if sweep in TABLES else of,
        tuple(header),
        tuple(rows),
        _notes(arms, table, protocol, sweep in TABLES, beside, bool(failures)),
    )


def _stands_beside(arm: Arm, row: PublishedRow) -> bool:
    told = all(word in arm.name for word in row.options)
    return arm.method == row.method and arm.sparsify == row.sparsify and told


def _heading(key: Key) -> str:
    _, region, quantity = key
    words = {"gaussians": "Gaussians (M)", "fps": "FPS", "psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS"}
    return f"{region} {words.get(quantity, quantity.upper())}".strip()


def _row(
    title: str, arm: Arm | None, table: PublishedTable, row: PublishedRow | None, protocol: Protocol
) -> tuple[Cell, ...]:
    published = table.values(row) if row else {}
    runs = tuple(record.folder.name for record in arm.records) if arm else ()
    cells = [Cell(title, runs=runs), Cell(str(len(runs)) if arm else ABSENT, runs=runs)]
    for key in table.columns:
        ours = _ours(arm, key, protocol) if arm else None
        theirs = published.get(key)
        exact = "" if ours is None else f"{ours:.8g}"
        busy = f" {arm.busy('frames')}".rstrip() if arm and key[2] == "fps" else ""
        cells += [Cell(_text(ours, key) + busy, runs=runs, exact=exact), Cell(_text(theirs, key), published=True)]
    return tuple(cells)


def _ours(arm: Arm, key: Key, protocol: Protocol) -> float | None:
    views = key[0]
    if views == "novel":
        return mean_beside(arm, float(key[1].split()[0]), key[2])
    value = _value(key, protocol)
    if value is None:
        return None
    if views == TRAINING:
        # As in DriveStudio, prefer runs that were trained on all views.
        whole = arm.mean(value, whole=True)
        return arm.mean(value) if whole is None else whole
    mean = arm.mean(value)
    return arm.mean(value, whole=True) if mean is None and views == "" else mean


def _value(key: Key, protocol: Protocol) -> Value | None:
    """Returns the function that reads a column's number from a record; None if no record holds it."""
    views, region, quantity = key
    if quantity == "gaussians":
        return lambda run: float(run.gaussians_total)
    if quantity == "fps":
        return lambda run: 1000 / run.latency.p50
    metric = metric_id(protocol, region, quantity)
    return None if metric is None else lambda run: run.mean(metric, views)


def metric_id(protocol: Protocol, region: str, quantity: str) -> str | None:
    """Returns the id of a metric under a protocol, or None.

    >>> from sparsestreet.metrics.definitions import DRIVESTUDIO
    >>> metric_id(DRIVESTUDIO, "full", "psnr") == DRIVESTUDIO.psnr
    True
    """
    pairs = {"human": protocol.human, "vehicle": protocol.vehicle, "full": (protocol.psnr, protocol.ssim)}
    if quantity == "lpips":
        return protocol.lpips[0] if region == "full" else None
    return pairs[region][("psnr", "ssim").index(quantity)] if quantity in ("psnr", "ssim") else None


def _text(value: float | None, key: Key) -> str:
    if value is None:
        return ABSENT
    return f"{value / 1e6:.3g}" if key[2] == "gaussians" else _TEXTS[key[2]].format(value)


def _failed(folder: Path, failure: FailedRun, width: int) -> tuple[Cell, ...]:
    name = Cell(f"{failure.label}, seed {failure.seed}: failed, {failure.error}", runs=(folder.name,))
    return (name, *[Cell()] * (width - 1))


def _notes(
    arms: Sequence[Arm], table: PublishedTable, protocol: Protocol, same: bool, beside: bool, failed: bool
) -> tuple[str, ...]:
    published = [
        f"paper: published in Table {table.number}, of another implementation, clock and machine, "
        + ("on its drives" if same else "and of other data: to be read beside ours, not against it"),
        f"published: {table.views}",
    ]
    said = [
        *(published if beside else ()),
        f"protocol {protocol.name}: {', '.join(protocol.metrics)}",
        "n: runs; a number is the mean over scenes of the mean over each one's seeds; "
        "FPS is 1000 / median milliseconds of a frame",
    ]
    if not any(record.summary.run.split == "none" for arm in arms for record in arm.records):
        said.append(
            "reconstruction: of the training views of the runs that hold views out; no run trained on all views"
        )
    controls = sorted({(arm.sparsify, arm.control) for arm in arms if arm.control})
    said += [f"control {name}: {control}" for name, control in controls]
    if failed:
        said.append("failed runs are in no mean")
    return (*said, *busy_arms(arms))
