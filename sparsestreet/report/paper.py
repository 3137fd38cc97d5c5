"""The numbers that the paper published, for columns next to ours.

Source: "SparseStreet: Sparse Gaussian Splatting for Real-Time Street Scene Simulation", tables 1 to 5, as printed. They
come from another implementation with its own data, views and clock. This project measured none of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.metrics.definitions import Protocol
from sparsestreet.records.run import FailedRun
from sparsestreet.records.summary import HELD_OUT, NOVEL, TRAINING, NovelRecord
from sparsestreet.report.tables import ABSENT, GEOMETRY, THEIRS, Cell, Grid, Quantity, number_cell, without_empty
from sparsestreet.report.variants import Variant, busy_variants, masks_note

Key = tuple[str, str, str]
"""Views ("training", "held_out", "all", "novel", ""), region and quantity of a column."""


@dataclass(frozen=True)
class PublishedRow:
    """A row as printed, and the variant of ours that it is compared with."""

    name: str
    method: str | None
    """None for a method that this project does not have."""
    sparsify: str
    values: tuple[float | None, ...]
    options: tuple[str, ...] = ()
    """Words of a variant's name that distinguish it from others with this method and sparsification."""


@dataclass(frozen=True)
class PublishedTable:
    """A table of the paper."""

    number: int
    caption: str
    columns: tuple[Key, ...]
    """Those as printed."""
    rows: tuple[PublishedRow, ...]
    views: str
    """What the paper says about the views of its numbers."""

    def values(self, row: PublishedRow) -> Mapping[Key, float | None]:
        """Return column -> number."""
        return dict(zip(self.columns, row.values, strict=True))

    @property
    def shown(self) -> tuple[Key, ...]:
        """The columns with ours: where the paper does not say of which views, those of all views follow."""
        if self.views != _UNSAID:
            return self.columns
        held = [key for key in self.columns if key[0] == HELD_OUT]
        rest = [key for key in self.columns if key[0] != HELD_OUT]
        return (*held, *(("all", region, quantity) for _, region, quantity in held), *rest)


_REGIONS = ("full", "human", "vehicle")
_BOTH = (
    *(
        (views, region, quantity)
        for views in ("training", "held_out")
        for region in _REGIONS
        for quantity in ("psnr", "ssim")
    ),
    ("", "", "gaussians"),
    ("", "", "fps"),
)
_ABLATION = (
    ("held_out", "full", "psnr"),
    ("held_out", "full", "ssim"),
    ("held_out", "full", "lpips"),
    ("held_out", "human", "psnr"),
    ("held_out", "vehicle", "psnr"),
    ("", "", "gaussians"),
)
_TWO = "reconstruction: of training views; novel views: every 10th frame"
_UNSAID = "the paper does not say of which views; ours are of the held-out ones, and beside them of all"

_SHIFTED = tuple(("novel", f"{meters} m", "fid") for meters in (1, 2, 3))


def _rows(text: str) -> tuple[PublishedRow, ...]:
    """Parse lines: name | method | sparsification and words of the variant's name | numbers as printed, in order."""
    return tuple(_row_published(*(part.strip() for part in line.split("|"))) for line in text.strip().splitlines())


def _row_published(name: str, method: str, kind: str, numbers: str) -> PublishedRow:
    sparsify, *words = kind.split()
    values = tuple(None if number == "-" else float(number) for number in numbers.split())
    return PublishedRow(name, None if method == "-" else method, sparsify, values, tuple(words))


_WAYMO = PublishedTable(
    1,
    "five methods and Ours on Waymo-NOTR",
    _BOTH,
    _rows("""
EmerNeRF | - | none | 31.93 0.902 22.88 0.578 24.65 0.723 29.67 0.883 20.32 0.454 22.07 0.609 - -
3DGS | 3dgs | none | 26.00 0.912 16.88 0.414 16.18 0.425 25.57 0.906 16.62 0.387 16.00 0.407 - -
HUGS | - | none | 28.26 0.923 16.23 0.404 24.31 0.794 27.65 0.914 15.99 0.378 23.27 0.748 - -
DeformGS | deformgs | none | 27.97 0.923 17.23 0.429 19.14 0.544 26.47 0.884 16.84 0.391 18.21 0.487 0.64e6 37.08
PVG | pvg | none | 32.68 0.941 24.96 0.726 24.36 0.763 28.73 0.881 21.95 0.565 21.43 0.617 1.51e6 9.13
StreetGS | streetgs | none | 28.73 0.932 16.54 0.401 26.46 0.848 27.02 0.887 16.27 0.368 23.99 0.761 0.87e6 21.60
OmniRe | omnire | none | 34.26 0.956 26.99 0.825 27.79 0.886 29.86 0.900 23.16 0.674 24.52 0.786 1.55e6 46.15
StreetGS+Ours | streetgs | paper | 28.42 0.924 16.51 0.392 26.33 0.847 27.04 0.889 16.18 0.362 23.72 0.753 0.29e6 57.66
OmniRe+Ours | omnire | paper | 34.05 0.952 26.88 0.818 27.48 0.878 29.75 0.897 23.15 0.667 24.49 0.782 0.46e6 80.22
"""),
    _TWO,
)
_NUSCENES = PublishedTable(
    2,
    "three methods and Ours on nuScenes",
    _BOTH,
    _rows("""
DeformGS | deformgs | none | 32.31 0.924 31.76 0.900 28.18 0.864 25.01 0.728 24.02 0.570 20.96 0.574 0.43e6 278.80
StreetGS | streetgs | none | 32.06 0.928 31.42 0.901 29.68 0.915 24.29 0.698 23.42 0.546 21.05 0.557 0.72e6 117.80
OmniRe | omnire | none | 32.14 0.929 32.14 0.917 29.72 0.916 24.24 0.696 23.38 0.551 21.01 0.555 0.73e6 132.56
StreetGS+Ours | streetgs | paper | 31.08 0.913 30.08 0.868 28.56 0.897 24.06 0.698 23.21 0.544 20.90 0.558 0.26e6 461.17
OmniRe+Ours | omnire | paper | 31.37 0.918 31.16 0.900 28.80 0.902 24.05 0.696 23.28 0.549 20.96 0.551 0.38e6 435.85
"""),
    _TWO,
)
_PRUNING = PublishedTable(
    3,
    "pruning strategies on Waymo",
    _ABLATION,
    _rows("""
Global Pruning | omnire | importance +global_pruning | 32.18 0.940 0.077 26.07 23.89 0.33e6
Background Pruning | omnire | importance +importance | 33.32 0.945 0.073 26.54 26.66 0.39e6
"""),
    _UNSAID,
)
_NOVEL = PublishedTable(
    4,
    "novel trajectories on Waymo, FID",
    _SHIFTED,
    _rows("""
OmniRe | omnire | none | 43.62 61.56 75.14
OmniRe+Ours | omnire | paper | 46.54 66.28 80.36
"""),
    "mean of both sides",
)
_STAGES = PublishedTable(
    5,
    "ablation on Waymo",
    _ABLATION,
    _rows("""
Full Model | omnire | paper | 33.35 0.945 0.072 26.50 26.88 0.32e6
w/o Node Pruning | omnire | importance | 33.32 0.945 0.073 26.54 26.66 0.39e6
w/o Background Pruning | omnire | masks | 33.71 0.951 0.063 26.61 27.03 0.65e6
"""),
    _UNSAID,
)

TABLES: Mapping[str, PublishedTable] = {
    "table1_waymo": _WAYMO,
    "table2_nuscenes": _NUSCENES,
    "table3_pruning": _PRUNING,
    "table4_novel": _NOVEL,
    "table5_ablation": _STAGES,
}
"""Name of a sweep (conf/sweep) -> the table that it reproduces."""

LAYOUT = _WAYMO
"""The layout of sweeps that reproduce no table of the paper."""


_GROUPS = {TRAINING: "reconstruction", HELD_OUT: "novel views", "all": "all views", "novel": "beside the path", "": ""}
_TEXTS = {"psnr": "{:.2f}", "ssim": "{:.3f}", "lpips": "{:.3f}", "fid": "{:.2f}", "fps": "{:.1f}"}


def paper_table(
    variants: Sequence[Variant], failures: Sequence[tuple[Path, FailedRun]], protocol: Protocol, sweep: str | None
) -> Grid:
    """Return the paper's table that a sweep reproduces; for any other sweep, its variants in the layout of Table 1."""
    table = TABLES.get(sweep or "", LAYOUT)
    lidar = [one for one in GEOMETRY if any(variant.mean(one.column) is not None for variant in variants)]
    left = list(variants)
    rows = []
    for row in table.rows:
        matching = [variant for variant in left if _stands_beside(variant, row)]
        left = [variant for variant in left if variant not in matching]
        if matching:
            rows += [_row(variant.title, variant, table, row, protocol, lidar) for variant in matching]
        elif sweep in TABLES:
            what = "published only" if row.method is None else "not run"
            rows.append(_row(f"{row.name} ({what})", None, table, row, protocol, lidar))
    rows += [_row(variant.title, variant, table, None, protocol, lidar) for variant in left]
    width = 2 + 2 * len(table.shown) + len(lidar)
    rows += [_failed(folder, failure, width) for folder, failure in failures]
    header = [("", "method"), ("", "n")]
    for key in table.shown:
        header += [(_GROUPS[key[0]], _heading(key)), (_GROUPS[key[0]], f"{_heading(key)}{THEIRS}")]
    header += [("lidar", one.heading) for one in lidar]
    header, rows = without_empty(header, rows)
    beside = any(heading.endswith(THEIRS) for _, heading in header)
    of = f"Table {table.number} of the paper" if sweep in TABLES else "All arms, in the layout of the paper's Table 1"
    return Grid(
        "paper",
        f"{of}: {table.caption}" if sweep in TABLES else of,
        tuple(header),
        tuple(rows),
        _notes(variants, table, protocol, sweep in TABLES, beside, bool(failures)),
    )


def _stands_beside(variant: Variant, row: PublishedRow) -> bool:
    told = all(word in variant.name for word in row.options)
    return variant.method == row.method and variant.sparsify == row.sparsify and told


def _heading(key: Key) -> str:
    _, region, quantity = key
    words = {"gaussians": "Gaussians (M)", "fps": "FPS", "psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS"}
    return f"{region} {words.get(quantity, quantity.upper())}".strip()


def _row(
    title: str,
    variant: Variant | None,
    table: PublishedTable,
    row: PublishedRow | None,
    protocol: Protocol,
    lidar: Sequence[Quantity],
) -> tuple[Cell, ...]:
    published = table.values(row) if row else {}
    runs = variant.run_names if variant else ()
    cells = [Cell(title, runs=runs), Cell(str(len(runs)) if variant else ABSENT, runs=runs)]
    for key in table.shown:
        ours = _ours(variant, key, protocol) if variant else None
        theirs = published.get(key)
        exact = "" if ours is None else f"{ours:.8g}"
        busy = f" {variant.busy('frames')}".rstrip() if variant and key[2] == "fps" else ""
        cells += [Cell(_text(ours, key) + busy, runs=runs, exact=exact), Cell(_text(theirs, key), published=True)]
    cells += [number_cell(variant.mean(one.column) if variant else None, one.text, runs) for one in lidar]
    return tuple(cells)


def _ours(variant: Variant, key: Key, protocol: Protocol) -> float | None:
    column = _column(key, protocol)
    if column is None:
        return None
    held, whole = variant.mean(column), variant.mean(column, whole=True)
    if key[0] == TRAINING:  # as in DriveStudio, of the runs that were trained on all views where there are any
        return held if whole is None else whole
    return whole if held is None and key[0] in ("", "all", "novel") else held


def _column(key: Key, protocol: Protocol) -> str | None:
    """Return the column of ``run_frame`` that the paper's column shows; None if no record holds it."""
    views, region, quantity = key
    if views == "novel":
        return f"{quantity} at {region}"
    if quantity in ("gaussians", "fps"):
        return {"gaussians": "Gaussians", "fps": "FPS"}[quantity]
    metric = metric_id(protocol, region, quantity)
    return None if metric is None else f"{views} {metric}"


def metric_id(protocol: Protocol, region: str, quantity: str) -> str | None:
    """Return the id of a metric under a protocol, or None.

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
    variants: Sequence[Variant], table: PublishedTable, protocol: Protocol, same: bool, beside: bool, failed: bool
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
    runs = [record.summary for variant in variants for record in variant.records]
    folders = [record.folder for variant in variants for record in variant.records]
    alone = sum(run.timed is not None for run in runs)
    if alone and any(quantity == "fps" for _, _, quantity in table.columns):
        said.append(f"FPS: {alone} of {len(runs)} runs timed alone, one after the other (evaluate DIR only=speed)")
    if any(region in ("human", "vehicle") for _, region, _ in table.columns):
        said += masks_note(runs)
    if any(quantity == "fid" for _, _, quantity in table.columns):
        said += _of_fid([found for run in folders if (found := NOVEL.find(run)) is not None])
    if table.views == _UNSAID:
        said.append(
            "all views: the mean over the images of training and held-out views together, each image with the region "
            "counting once; none where some of them lack the metric: for LPIPS say evaluate RUN training_lpips=true"
        )
    elif not any(run.run.split == "none" for run in runs):
        said.append(
            "reconstruction: of the training views of the runs that hold views out; no run trained on all views"
        )
    controls = sorted({(variant.sparsify, variant.control) for variant in variants if variant.control})
    said += [f"control {name}: {control}" for name, control in controls]
    if failed:
        said.append("failed runs are in no mean")
    return (*said, *busy_variants(variants))


def _of_fid(records: Sequence[NovelRecord]) -> list[str]:
    """Say of how many images FID is, and why some runs have none."""
    measured = [record for record in records if any("fid" in shift.distances for shift in record.shifts)]
    counts = sorted({record.real_views for record in measured})
    number = " to ".join(dict.fromkeys(str(count) for count in (*counts[:1], *counts[-1:])))
    said = [
        f"FID: Frechet distance of Inception-v3's 2,048 features, of {number} recorded images a run and as many "
        "renders a side; the fewer images, the more of it is bias: it compares rows of one sweep, not counts of images"
    ]
    reasons = sorted({record.missing["fid"] for record in records if "fid" in record.missing})
    return [*(said if counts else []), *(f"FID n/a in some runs: {reason}" for reason in reasons)]
