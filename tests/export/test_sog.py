"""A .sog by its description: rounding, pixels, and archives that are no such thing."""

import io
import json
import math
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.codec import limits
from sparsestreet.export.sog import read_sog, write_sog
from sparsestreet.types import Gaussians
from tests.export.test_viewer_formats import gaussians

MIB = 2**20


def parts(path: Path) -> tuple[dict, dict[str, bytes]]:
    """What meta.json says, and the other files."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    return json.loads(files.pop("meta.json")), files


def image(content: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(content)) as opened:
        return np.asarray(opened)


def nearest(values: torch.Tensor, book: list[float]) -> torch.Tensor:
    entries = torch.tensor(book, dtype=torch.float64)
    return entries[(values.double().unsqueeze(-1) - entries).abs().argmin(-1)].float()


def in_order(found: Gaussians, one: Gaussians) -> Gaussians:
    order = torch.cdist(one.means.double(), found.means.double()).argmin(1)
    return Gaussians(*(getattr(found, name)[order] for name in ("means", "quaternions", "scales", "opacities", "sh")))


@pytest.mark.parametrize("rows", [0, 1, 63, 255, 256, 257])
@pytest.mark.parametrize("terms", [1, 4, 16])
def test_it_comes_back_within_its_rounding(tmp_path: Path, rows: int, terms: int):
    one = gaussians(rows, terms)
    assert write_sog(tmp_path / "a.sog", one) == rows
    meta, _ = parts(tmp_path / "a.sog")
    found = read_sog(tmp_path / "a.sog")
    assert len(found) == meta["count"] == rows
    if not rows:
        return
    found = in_order(found, one)
    # Half a step of the logarithm, and its slope 1 + |x|.
    steps = (torch.tensor(meta["means"]["maxs"]) - torch.tensor(meta["means"]["mins"])) / 65535
    assert ((found.means - one.means).abs() <= 0.51 * steps * (1 + one.means.abs()) + 2e-6).all()
    assert torch.allclose(found.scales.log(), nearest(one.scales.log(), meta["scales"]["codebook"]), atol=1e-5)
    assert torch.allclose(found.opacities, one.opacities, rtol=0, atol=1 / 510 + 1e-6)
    assert torch.allclose(found.sh[:, 0], nearest(one.sh[:, 0], meta["sh0"]["codebook"]), atol=1e-6)
    unit = torch.nn.functional.normalize(one.quaternions, dim=1)
    # Three parts off by half of 0.0055, and the largest by what makes the whole a unit: at most twice that.
    assert float((1 - (found.quaternions * unit).sum(1).abs()).max()) < (2 * math.sqrt(3) * 0.0028) ** 2
    assert found.sh.shape == one.sh.shape
    if rows <= 64:  # each row has an entry of its own in the palette
        assert torch.allclose(found.sh[:, 1:], nearest(one.sh[:, 1:], meta["shN"]["codebook"] if terms > 1 else [0.0]))


def test_pixels_by_hand(tmp_path: Path):
    """Two Gaussians, by the description."""
    one = Gaussians(
        torch.tensor([[math.e - 1, -1.0, 0.0], [0.0, 0.0, 3.0]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0], [-0.1, 0.1, -0.7, 0.7]]),
        torch.full((2, 3), math.exp(-2)),
        torch.tensor([1.0, 0.2]),
        torch.zeros(2, 1, 3),
    )
    write_sog(tmp_path / "a.sog", one, antialiased=True)
    meta, files = parts(tmp_path / "a.sog")
    assert (meta["version"], meta["count"], meta["antialias"]) == (2, 2, True)
    assert meta["means"]["mins"] == pytest.approx([0, -math.log(2), 0])
    assert meta["means"]["maxs"] == pytest.approx([1, 0, math.log(4)])
    low, high = (image(files[name])[0].astype(int) for name in meta["means"]["files"])
    steps = (low + 256 * high)[:2]
    assert sorted(map(tuple, steps.tolist())) == [(0, 65535, 65535), (65535, 0, 0)]
    first = int(steps[1, 0] == 65535)  # pixel of the first Gaussian
    turns = image(files["quats.webp"])[0]
    assert turns[first].tolist() == [128, 128, 128, 252]  # w is the largest; 127.5, to even
    # The other sign of it has parts 0.1, -0.1 and -0.7 besides y: 255 (0.5 + 0.7071 part) = 145.5, 109.5 and 1.3.
    assert turns[1 - first].tolist() == [146, 109, 1, 254]
    assert image(files["sh0.webp"])[0, [first, 1 - first], 3].tolist() == [255, 51]
    assert meta["scales"]["codebook"][image(files["scales.webp"])[0, 0, 0]] == pytest.approx(-2)


def test_the_same_scene_gives_the_same_bytes(tmp_path: Path):
    for name in ("a.sog", "b.sog"):
        write_sog(tmp_path / name, gaussians(300, 4))
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_what_it_cannot_hold_is_refused(tmp_path: Path):
    one = gaussians(3)
    one.means[1, 2] = torch.nan
    with pytest.raises(ValueError, match=r"must be finite, but row"):
        write_sog(tmp_path / "a.sog", one)
    assert list(tmp_path.iterdir()) == []


def webp_of(width: int, height: int) -> bytes:
    """A header of a lossless image."""
    return b"RIFF\x20\0\0\0WEBPVP8L\x14\0\0\0\x2f" + (width - 1 | height - 1 << 14).to_bytes(4, "little") + bytes(16)


def lossy() -> bytes:
    buffer = io.BytesIO()
    Image.new("RGBA", (8, 8)).save(buffer, "WEBP", lossless=False)
    return buffer.getvalue()


def transparent(_: dict, files: dict) -> None:
    buffer = io.BytesIO()
    Image.new("RGBA", (8, 8)).save(buffer, "WEBP", lossless=True, exact=True)
    files["quats.webp"] = buffer.getvalue()


HOSTILE: dict[str, tuple[Callable[[dict, dict], object], str]] = {
    "another version": (lambda meta, _: meta.update(version=3), "it has version 3 of the format"),
    "an older version": (lambda meta, _: meta.pop("version"), "it has version None of the format"),
    "a billion Gaussians": (lambda meta, _: meta.update(count=10**9), "0 to 10,000,000 Gaussians, got 1000000000"),
    "ten million Gaussians": (lambda meta, _: meta.update(count=10**7), "above its limit of"),
    "more Gaussians than pixels": (lambda meta, _: meta.update(count=9999), "9999 Gaussians need as many pixels"),
    "half a Gaussian": (lambda meta, _: meta.update(count=0.5), "got 0.5"),
    "no image": (lambda _, files: files.pop("quats.webp"), "no item named 'quats.webp'"),
    "no name": (lambda meta, _: meta["means"].update(files=["means_l.webp"]), "IndexError"),
    "a short book": (lambda meta, _: meta["sh0"].update(codebook=[0.0] * 9), r"256 finite numbers .* shape \(9,\)"),
    "a book of text": (lambda meta, _: meta["sh0"].update(codebook=["x"] * 256), "could not convert string to float"),
    "endless positions": (lambda meta, _: meta["means"].update(maxs=[900.0] * 3), "a number is not finite"),
    "four bands": (lambda meta, _: meta["shN"].update(bands=4), "1 to 3 bands, got 4"),
    "other bands": (lambda meta, _: meta["shN"].update(bands=2), "is 512 pixels wide"),
    "a small palette": (lambda meta, _: meta["shN"].update(count=3), "a label is .* the palette has 3 entries"),
    "a large palette": (lambda meta, _: meta["shN"].update(count=65536), "a palette of 65536 entries"),
    "a huge image": (lambda _, files: files.update({"sh0.webp": webp_of(16383, 16383)}), "above its limit of"),
    "half an image": (lambda _, files: files.update({"sh0.webp": webp_of(8, 8)}), "OSError"),
    "a lossy image": (lambda _, files: files.update({"sh0.webp": lossy()}), "no lossless WebP"),
    "a quaternion without a mode": (transparent, "the alpha of a quaternion lies in 252 to 255, got 0"),
}


@pytest.mark.parametrize(("change", "says"), HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_file(tmp_path: Path, change: Callable[[dict, dict], object], says: str):
    path = tmp_path / "a.sog"
    write_sog(path, gaussians(40, 4))
    meta, files = parts(path)
    change(meta, files)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {"meta.json": json.dumps(meta).encode(), **files}.items():
            archive.writestr(name, content)
    refused(path, says)


def refused(path: Path, says: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=rf"^[^\n]*is no \.sog or is damaged: [^\n]*{says}[^\n]*$"):
            read_sog(path)
        assert tracemalloc.get_traced_memory()[1] < 8 * MIB
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("packing", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2], ids=["deflate", "bzip2"])
@pytest.mark.parametrize("name", ["meta.json", "means_l.webp"])
def test_a_zip_bomb(tmp_path: Path, packing: int, name: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(limits, "FREE", 8 * MIB)
    monkeypatch.setattr(limits, "PER_BYTE", 1)
    path = tmp_path / "a.sog"
    write_sog(path, gaussians(40, 4))
    meta, files = parts(path)
    with zipfile.ZipFile(path, "w", packing) as archive:
        for own, content in {"meta.json": json.dumps(meta).encode(), **files}.items():
            if own != name:
                archive.writestr(own, content, zipfile.ZIP_STORED)
        with archive.open(name, "w") as file:
            for _ in range(16):
                file.write(bytes(MIB))
    packed = "is packed in a way" if packing == zipfile.ZIP_BZIP2 else ""
    refused(path, packed or ("at most 1048576 bytes, got" if name == "meta.json" else "above its limit of"))


@pytest.mark.slow
def test_a_million(tmp_path: Path):
    one = gaussians(1_000_000, 16)
    assert write_sog(tmp_path / "a.sog", one) == 1_000_000
    found = read_sog(tmp_path / "a.sog")
    assert found.sh.shape == (1_000_000, 16, 3)
    # Sums do not care for the order of rows.
    for name in ("means", "scales", "opacities", "sh"):
        ours, theirs = (getattr(which, name).double().mean(0) for which in (found, one))
        assert torch.allclose(ours, theirs, atol=2e-3)
