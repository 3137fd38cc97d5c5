"""Files for viewers: within the rounding that they state, upright, with colors that turn along, and read by others."""

import gzip
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sparsestreet.export.frame import VIEWER_FROM_WORLD, frame_gaussians, turned
from sparsestreet.export.ply import write_ply
from sparsestreet.export.spz import PROGRAM, check_file, read_plain_ply, read_spz, spz_notes, turned_camera, write_spz
from sparsestreet.ops import SplatSettings, splat
from sparsestreet.types import Gaussians
from tests.export.street import CAR_ROWS, ROAD_ROWS, TRAM_ROWS, stored_street, street_views

SIZES = [1, 2, 255, 256, 257]


def gaussians(rows: int, terms: int = 4, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator)

    sh = 0.1 * normal(rows, terms, 3)
    return Gaussians(8 * normal(rows, 3), normal(rows, 4), (normal(rows, 3) - 2).exp(), normal(rows).sigmoid(), sh)


def covariances(one: Gaussians) -> np.ndarray:
    axes = Rotation.from_quat(one.quaternions.double().numpy(), scalar_first=True).as_matrix()
    scaled = axes * one.scales.double().numpy()[:, None, :]
    return scaled @ scaled.swapaxes(1, 2)


def assert_near(found: Gaussians, one: Gaussians, *, position: float, scale: float, harmonic: float, first: float):
    assert len(found) == len(one)
    assert torch.allclose(found.means, one.means, rtol=0, atol=position)
    assert torch.allclose(found.scales.log(), one.scales.log(), rtol=0, atol=scale)
    assert torch.allclose(found.opacities, one.opacities, rtol=0, atol=1 / 510 + 1e-6)
    assert torch.allclose(found.dense_sh()[:, :1], one.dense_sh()[:, :1], rtol=0, atol=first)
    assert torch.allclose(found.dense_sh()[:, 1:], one.dense_sh()[:, 1:], rtol=0, atol=harmonic)
    unit = torch.nn.functional.normalize(one.quaternions, dim=1)
    # Three parts off by half of 0.0014, and the largest by what makes the whole a unit: at most twice that.
    assert float((1 - (found.quaternions * unit).sum(1).abs()).max()) < (2 * np.sqrt(3) * 0.0007) ** 2


@pytest.mark.parametrize("rows", SIZES)
@pytest.mark.parametrize("terms", [1, 16])
def test_spz_comes_back_within_its_rounding(tmp_path: Path, rows: int, terms: int):
    one = gaussians(rows, terms)
    assert write_spz(tmp_path / "a.spz", one) == rows
    found = read_spz(tmp_path / "a.spz")
    assert_near(found, one, position=2**-13 + 1e-6, scale=1 / 32 + 1e-4, harmonic=1 / 256 + 1e-6, first=1 / 76)
    write_ply(tmp_path / "a.ply", one)
    plain = read_plain_ply(tmp_path / "a.ply")
    for name in ("means", "scales", "opacities", "sh"):
        assert torch.allclose(getattr(plain, name), getattr(one, name), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("name", "write", "read"), [("spz", write_spz, read_spz), ("ply", write_ply, read_plain_ply)])
def test_a_damaged_file_is_a_value_error(name: str, write: Callable, read: Callable, tmp_path: Path):
    """300 changed files each: bytes, cuts, and words of the header that are gone, twice or another."""
    path, rng = tmp_path / f"a.{name}", np.random.default_rng(0)
    write(path, gaussians(9, 4))
    good = path.read_bytes()
    words = good[: good.find(b"end_header")].split() if name == "ply" else [good[:4], good[4:10], good[10:14]]
    refused = 0
    for number in range(300):
        content = bytearray(good)
        if number % 3 == 0:
            for place in rng.integers(0, len(good), rng.integers(1, 9)):
                content[place] = rng.integers(256)
        elif number % 3 == 1:
            content = content[: rng.integers(len(good))]
        else:
            old, new = rng.choice(len(words), 2)
            content = content.replace(words[old], words[new] if number % 2 else b"", 1 + number % 5)
        path.write_bytes(content)
        try:
            read(path)
        except ValueError:
            refused += 1
    assert refused > 100


def test_a_spz_by_hand(tmp_path: Path):
    """From the description of the format: one Gaussian with x right, y down, z ahead becomes right, up, back."""
    one = Gaussians(
        torch.tensor([[1.0, 2.0, -3.0]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([[1.0, 1.0, 1.0]]).mul(-2).exp(),
        torch.tensor([1.0]),
        torch.zeros(1, 1, 3),
    )
    write_spz(tmp_path / "a.spz", one, antialiased=True)
    content = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert struct.unpack("<IIIBBBB", content[:16]) == (0x5053474E, 3, 1, 0, 12, 1, 0)
    numbers = [int.from_bytes(content[16 + 3 * i : 19 + 3 * i], "little", signed=True) / 4096 for i in range(3)]
    assert numbers == [1.0, -2.0, 3.0]
    assert content[25] == 255
    assert list(content[26:29]) == [128] * 3  # 127.5, to even
    assert list(content[29:32]) == [128] * 3  # (-2 + 10) * 16
    # The half turn about x that turns the axes: x is the largest part, the others are 0.
    assert int.from_bytes(content[32:36], "little") == 0
    assert len(content) == 36


def with_a_far_row(meters: float) -> Gaussians:
    one = gaussians(600)
    one.means[417] = torch.tensor([0.0, meters, 0.0])
    return one


def test_one_far_row_that_coarsens_all_others_is_said(tmp_path: Path):
    """What is said is what is measured, by the readers."""
    for meters, written in ((1e6, "62.5 mm, because row 417 lies 1,000 km away"), (2e4, "1.95 mm, because row 417")):
        one = with_a_far_row(meters)
        (note,) = spz_notes(one)
        assert f"positions are kept to {written}" in note
        write_spz(tmp_path / "a.spz", one)
        worst = float((read_spz(tmp_path / "a.spz").means - one.means)[:417].abs().max())
        said = float(note.split()[4]) / 1000
        assert 0.9 * said < worst <= 1.01 * said
    assert spz_notes(with_a_far_row(5000.0)) == []  # still below a millimeter


def test_what_a_spz_cuts_is_counted():
    one = gaussians(50)
    one.scales[3, 1], one.dense_sh()[7, 2, 0], one.dense_sh()[8, 0, 1] = 1e20, 1.5, -4.0
    assert spz_notes(one) == [
        "of 1 Gaussians, scales are cut to 365 m",
        "of 1 Gaussians, colors are cut to -3.3 to 3.3",
        "of 1 Gaussians, harmonics are cut to -1 to 1",
    ]


def test_what_is_far_away_does_not_wrap_around(tmp_path: Path):
    one = gaussians(3)
    one.means[1] = torch.tensor([2500.0, -9000.0, 40_000.0])
    write_spz(tmp_path / "a.spz", one)
    assert torch.allclose(read_spz(tmp_path / "a.spz").means, one.means, rtol=0, atol=2**-8)
    one.means[1] = 1e7
    with pytest.raises(ValueError, match=r"a .spz reaches 8,388 km"):
        write_spz(tmp_path / "a.spz", one)


def test_turned_gaussians_look_the_same_to_a_turned_camera():
    found = frame_gaussians(stored_street(), 0.25, sky=False)
    camera = street_views()[4].camera
    one = splat(turned(found, VIEWER_FROM_WORLD.T), camera, settings=SplatSettings(), backend="reference")
    other = splat(found, turned_camera(camera, VIEWER_FROM_WORLD), settings=SplatSettings(), backend="reference")
    assert one.rgb.std() > 0.02
    assert torch.allclose(one.rgb, other.rgb, atol=1e-5)  # float32, in another order of sums


def test_a_frame_is_upright_and_has_its_sky_above():
    stored = stored_street()
    found = frame_gaussians(stored, 0.0)
    street = ROAD_ROWS + CAR_ROWS + TRAM_ROWS
    assert len(found) == street + 12_000
    world = stored.scene.nodes["background"].rows.means.detach()
    # x ahead, y left, z up is z ahead, x to the right of -y, and y down.
    expected = torch.stack([-world[:, 1], -world[:, 2], world[:, 0]], dim=1)
    assert torch.allclose(found.means[:ROAD_ROWS], expected, atol=1e-6)
    distances = found.means[street:].norm(dim=1)
    assert float(distances.min()) > 499
    assert float(distances.max()) < 2001
    # Each disc lies across the line to the middle: its thin axis points there.
    shapes = covariances(found)[street:]
    outward = torch.nn.functional.normalize(found.means[street:], dim=1).double().numpy()
    along = np.einsum("ni,nij,nj->n", outward, shapes, outward)
    assert (along < 1e-3 * np.trace(shapes, axis1=1, axis2=2)).all()
    assert len(frame_gaussians(stored, 0.0, nodes=["rigid"])) == CAR_ROWS + TRAM_ROWS


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_cut_spz_is_refused_in_one_line(tmp_path: Path, data):
    path = tmp_path / "a.spz"
    write_spz(path, gaussians(5))
    content = path.read_bytes()
    path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    with pytest.raises(ValueError, match=r"^[^\n]*(damaged|no \.)[^\n]*$"):
        read_spz(path)
    claims = struct.pack("<IIIBBBB", 0x5053474E, 3, 2**32 - 1, 3, 12, 0, 0)
    path.write_bytes(gzip.compress(claims + bytes(1000)))
    with pytest.raises(ValueError, match="with at most 10,000,000 Gaussians"):
        read_spz(path)


def test_a_check_says_who_read_and_how_much_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    one = frame_gaussians(stored_street(), 0.0, sky=False)
    camera = turned_camera(street_views()[4].camera, VIEWER_FROM_WORLD)
    write_spz(tmp_path / "a.spz", one)
    found = check_file(tmp_path / "a.spz", one, camera, SplatSettings())
    assert "our own reader" in found.reader
    assert found.psnr is not None
    assert 40 < found.psnr < 80
    assert check_file(tmp_path / "a.spz", read_spz(tmp_path / "a.spz"), camera, SplatSettings()).psnr == float("inf")
    with pytest.raises(ValueError, match="for 36 that were written"):
        check_file(tmp_path / "a.spz", gaussians(36), camera, SplatSettings())


@pytest.mark.skipif(
    shutil.which(PROGRAM) is None, reason=f"{PROGRAM} is not installed: npm install -g @playcanvas/{PROGRAM}"
)
@pytest.mark.lengthy
def test_another_program_reads_the_same(tmp_path: Path):
    one, camera = frame_gaussians(stored_street(), 0.0), turned_camera(street_views()[4].camera, VIEWER_FROM_WORLD)
    path = tmp_path / "a.spz"
    write_spz(path, one)
    theirs = check_file(path, one, camera, SplatSettings())
    assert theirs.reader == PROGRAM
    # Theirs and ours are the same picture: what is lost is the format's.
    assert theirs.psnr is not None
    assert check_file(path, read_spz(path), camera, SplatSettings()).psnr > 50 > 30 < theirs.psnr
