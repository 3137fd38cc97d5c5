"""The render server: latency by size, clients and workers, what placed objects add, memory, requests that are wrong."""

import statistics
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import grpc
import numpy as np

from sparsestreet.bench.records import RecordFile
from sparsestreet.bench.serve_client import JPEG, PNG, Client, place, resident_mb, server
from sparsestreet.bench.serve_fuzz import spoiled
from sparsestreet.scene.edits import objects_of

Say = Callable[[str], None]


@dataclass(frozen=True)
class ServePlan:
    """How much is asked for."""

    sizes: tuple[tuple[int, int], ...]
    clients: tuple[int, ...]
    workers: tuple[int, ...]
    """The first serves all sizes, the others the one in the middle for the most clients."""
    pictures: int
    """Of each latency."""
    pairs: int
    """With and without placed objects."""
    requests: int
    """Between the first and the last look at the memory."""
    wrong: int
    """Requests with wrong values."""


FULL = ServePlan(((320, 192), (960, 576), (1920, 1080)), (1, 8), (4, 1, 8), 40, 60, 10_000, 10_000)
QUICK = ServePlan(((48, 32),), (1, 2), (2,), 4, 3, 20, 40)
SMALL = (64, 40)
"""Pixels of the requests that are many."""
LOOKS = 5
OBJECTS = 5


@dataclass(frozen=True)
class LatencyRecord:
    """Milliseconds of whole requests for JPEGs along the recorded drive."""

    size: tuple[int, int]
    clients: int
    workers: int
    p50: float
    p99: float
    own: float
    """Rendering and encoding, median."""
    rest: float
    """All else that a request takes, median: the network, and the wait for others."""
    pictures_per_second: float


@dataclass(frozen=True)
class ObjectsRecord:
    """What placing objects where they are adds to a request, median over pairs in turns, milliseconds."""

    objects: int
    without: float
    added: float


@dataclass(frozen=True)
class MemoryRecord:
    """Memory of the server after so many requests."""

    requests: int
    mb: float


@dataclass(frozen=True)
class WrongRecord:
    """Requests with wrong values, by the status that they got."""

    requests: int
    statuses: dict[str, int]


def run_serve(run: Path, plan: ServePlan, file: RecordFile, say: Say = print) -> bool:
    """Measures all of it; whether no wrong request was INTERNAL, and the server answers after all of them."""
    for workers in plan.workers:
        with server(run, workers) as (client, process):
            usual = workers == plan.workers[0]
            sizes = plan.sizes if usual else plan.sizes[len(plan.sizes) // 2 :][:1]
            for clients in plan.clients if usual else plan.clients[-1:]:
                for size in sizes:
                    record = latency(client, size, clients, workers, plan.pictures)
                    file.write("latency", record)
                    say(
                        f"{size[0]}x{size[1]}, {clients} clients, {workers} workers: p50 {record.p50:.1f} ms, p99 "
                        f"{record.p99:.1f} ms, own {record.own:.1f} ms, the rest {record.rest:.1f} ms, "
                        f"{record.pictures_per_second:.1f} pictures/s"
                    )
            if usual:
                good = _long(client, process, plan, file, say)
    return good


def _long(client: Client, process: int, plan: ServePlan, file: RecordFile, say: Say) -> bool:
    placed = placed_objects(client, plan.sizes[0], plan.pairs)
    if placed is not None:
        file.write("objects", placed)
        say(f"{placed.objects} placed objects add {placed.added:.1f} ms to {placed.without:.1f} ms")
    for number in range(LOOKS + 1):
        if number:
            for one in range(plan.requests // LOOKS):
                client.ask(client.request(client.views[one % len(client.views)], SMALL, PNG))
        record = MemoryRecord(number * (plan.requests // LOOKS), resident_mb(process))
        file.write("memory", record)
        say(f"{record.requests} requests of {SMALL[0]}x{SMALL[1]}: {record.mb:.0f} MB")
    wrong = wrong_requests(client, plan.wrong)
    file.write("wrong", wrong)
    say(f"{wrong.requests} requests with wrong values: {wrong.statuses}")
    return "INTERNAL" not in wrong.statuses and "UNAVAILABLE" not in wrong.statuses


def latency(client: Client, size: tuple[int, int], clients: int, workers: int, count: int) -> LatencyRecord:
    """``clients`` at once ask for pictures along the drive."""
    requests = [client.request(client.views[number % len(client.views)], size, JPEG) for number in range(count)]
    client.ask(requests[0])
    with ThreadPoolExecutor(clients) as pool:
        started = time.perf_counter()
        answers = list(pool.map(client.ask, requests))
        rate = count / (time.perf_counter() - started)
    p50, p99 = np.percentile([one.whole for one in answers], (50, 99))
    own = statistics.median(one.own for one in answers)
    rest = statistics.median(one.whole - one.own for one in answers)
    return LatencyRecord(size, clients, workers, float(p50), float(p99), own, rest, rate)


def placed_objects(client: Client, size: tuple[int, int], pairs: int) -> ObjectsRecord | None:
    """None where the scene has no objects. Those that are there are placed where they are, up to ``OBJECTS``."""
    names = list(objects_of(client.served.stored.scene))
    times: list[list[float]] = [[], []]
    most = 0
    for number in range(pairs):
        view = client.views[number % len(client.views)]
        boxes = {name: box for name in names if (box := client.box(name, view.time)) is not None}
        chosen = list(boxes.items())[:OBJECTS]
        most = max(most, len(chosen))
        for some, into in zip(([], chosen), times, strict=True):
            request = client.request(view, size, JPEG)
            for name, box in some:
                place(request, name, box)
            into.append(client.ask(request).whole)
    if not most:
        return None
    added = statistics.median(after - before for before, after in zip(*times, strict=True))
    return ObjectsRecord(most, statistics.median(times[0]), added)


def wrong_requests(client: Client, count: int, seed: int = 0) -> WrongRecord:
    """Requests of which one to four fields have values that nobody would send."""
    rng = np.random.default_rng(seed)
    found: Counter[str] = Counter()
    names: Sequence[str] = list(objects_of(client.served.stored.scene))
    for number in range(count):
        request = client.request(client.views[number % len(client.views)], SMALL, PNG)
        if names and number % 2:
            place(request, names[number % len(names)], np.eye(4))
        try:
            client.ask(spoiled(request, rng))
            found["OK"] += 1
        except grpc.RpcError as error:
            found[error.code().name] += 1  # pyright: ignore[reportAttributeAccessIssue]
    return WrongRecord(count, dict(sorted(found.items())))
