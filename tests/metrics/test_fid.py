"""FID's Inception against a network written down a second time, sizes by hand, and files that are not its weights."""

import numpy as np
import pytest
import torch
from torch.nn import functional

from sparsestreet.metrics.distances import frechet_distance
from sparsestreet.metrics.fid import (
    FOLDER_VARIABLE,
    WEIGHTS,
    InceptionFeatures,
    InceptionV3,
    open_inception,
    read_inception,
)
from sparsestreet.metrics.reported import SetDistances
from tests.typed import there

pytestmark = pytest.mark.lengthy
CPU = torch.device("cpu")
SIDES = {
    "Conv2d_1a_3x3": (32, 149), "Conv2d_2a_3x3": (32, 147), "Conv2d_2b_3x3": (64, 147), "maxpool1": (64, 73),
    "Conv2d_3b_1x1": (80, 73), "Conv2d_4a_3x3": (192, 71), "maxpool2": (192, 35),
    "Mixed_5b": (256, 35), "Mixed_5c": (288, 35), "Mixed_5d": (288, 35),
    "Mixed_6a": (768, 17), "Mixed_6b": (768, 17), "Mixed_6c": (768, 17), "Mixed_6d": (768, 17), "Mixed_6e": (768, 17),
    "Mixed_7a": (1280, 8), "Mixed_7b": (2048, 8), "Mixed_7c": (2048, 8),
}  # fmt: skip
"""Layer -> channels and side: (299 - 3) / 2 + 1 = 149, and so on."""


@pytest.fixture(scope="module")
def network():
    """Weights that keep the size of what they are given, and channels with means and variances of their own."""
    torch.manual_seed(0)
    made = InceptionV3().eval()
    for name, values in made.state_dict().items():
        if name.endswith("conv.weight"):
            values.normal_(std=(2 / values[0].numel()) ** 0.5)
        elif name.endswith("running_var"):
            values.uniform_(0.5, 1.5)
        elif name.endswith(("running_mean", "bn.bias")):
            values.normal_(std=0.2)
        elif name.endswith("bn.weight"):
            values.uniform_(0.8, 1.2)
    return made


@pytest.fixture(scope="module")
def file(network, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / WEIGHTS
    torch.save(network.state_dict(), path)
    return path


class Reference:
    """The network as the papers draw it, layer by layer, in float64."""

    def __init__(self, state):
        self.state = {name: values.double() for name, values in state.items()}

    def conv(self, name, x, stride=1, padding=0):
        y = functional.conv2d(x, self.state[f"{name}.conv.weight"], stride=stride, padding=padding)
        mean, variance, scale, shift = (
            self.state[f"{name}.bn.{part}"][:, None, None] for part in ("running_mean", "running_var", "weight", "bias")
        )
        return ((y - mean) / (variance + 0.001).sqrt() * scale + shift).clamp(min=0)

    def chain(self, block, x, *layers):
        for name, padding, stride in layers:
            x = self.conv(f"{block}.{name}", x, stride, padding)
        return x

    def average(self, x):
        """Of the pixels that are there: the sum over 3x3, divided by how many they are."""
        ones = torch.ones(1, 1, 3, 3, dtype=x.dtype)
        sums = functional.conv2d(x.transpose(0, 1), ones, padding=1).transpose(0, 1)
        return sums / functional.conv2d(torch.ones_like(x[:, :1]), ones, padding=1)

    def five(self, b, x):
        return torch.cat([
            self.chain(b, x, ("branch1x1", 0, 1)),
            self.chain(b, x, ("branch5x5_1", 0, 1), ("branch5x5_2", 2, 1)),
            self.chain(b, x, ("branch3x3dbl_1", 0, 1), ("branch3x3dbl_2", 1, 1), ("branch3x3dbl_3", 1, 1)),
            self.chain(b, self.average(x), ("branch_pool", 0, 1)),
        ], 1)  # fmt: skip

    def six_a(self, x):
        b = "Mixed_6a"
        return torch.cat([
            self.chain(b, x, ("branch3x3", 0, 2)),
            self.chain(b, x, ("branch3x3dbl_1", 0, 1), ("branch3x3dbl_2", 1, 1), ("branch3x3dbl_3", 0, 2)),
            functional.max_pool2d(x, 3, 2),
        ], 1)  # fmt: skip

    def six(self, b, x):
        wide, tall = (0, 3), (3, 0)
        return torch.cat([
            self.chain(b, x, ("branch1x1", 0, 1)),
            self.chain(b, x, ("branch7x7_1", 0, 1), ("branch7x7_2", wide, 1), ("branch7x7_3", tall, 1)),
            self.chain(b, x, ("branch7x7dbl_1", 0, 1), ("branch7x7dbl_2", tall, 1), ("branch7x7dbl_3", wide, 1),
                       ("branch7x7dbl_4", tall, 1), ("branch7x7dbl_5", wide, 1)),
            self.chain(b, self.average(x), ("branch_pool", 0, 1)),
        ], 1)  # fmt: skip

    def seven_a(self, x):
        b = "Mixed_7a"
        return torch.cat([
            self.chain(b, x, ("branch3x3_1", 0, 1), ("branch3x3_2", 0, 2)),
            self.chain(b, x, ("branch7x7x3_1", 0, 1), ("branch7x7x3_2", (0, 3), 1), ("branch7x7x3_3", (3, 0), 1),
                       ("branch7x7x3_4", 0, 2)),
            functional.max_pool2d(x, 3, 2),
        ], 1)  # fmt: skip

    def seven(self, b, x, pooled):
        three = self.chain(b, x, ("branch3x3_1", 0, 1))
        double = self.chain(b, x, ("branch3x3dbl_1", 0, 1), ("branch3x3dbl_2", 1, 1))
        return torch.cat([
            self.chain(b, x, ("branch1x1", 0, 1)),
            self.chain(b, three, ("branch3x3_2a", (0, 1), 1)),
            self.chain(b, three, ("branch3x3_2b", (1, 0), 1)),
            self.chain(b, double, ("branch3x3dbl_3a", (0, 1), 1)),
            self.chain(b, double, ("branch3x3dbl_3b", (1, 0), 1)),
            self.chain(b, pooled, ("branch_pool", 0, 1)),
        ], 1)  # fmt: skip

    def __call__(self, x):
        x = self.conv("Conv2d_2a_3x3", self.conv("Conv2d_1a_3x3", x, stride=2))
        x = functional.max_pool2d(self.conv("Conv2d_2b_3x3", x, padding=1), 3, 2)
        x = functional.max_pool2d(self.conv("Conv2d_4a_3x3", self.conv("Conv2d_3b_1x1", x)), 3, 2)
        for letter in "bcd":
            x = self.five(f"Mixed_5{letter}", x)
        x = self.six_a(x)
        for letter in "bcde":
            x = self.six(f"Mixed_6{letter}", x)
        x = self.seven_a(x)
        x = self.seven("Mixed_7b", x, self.average(x))
        x = self.seven("Mixed_7c", x, functional.max_pool2d(x, 3, 1, 1))
        return x.mean((0, 2, 3))


def picture(seed, height=24, width=40):
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


def test_features_are_those_of_the_network_written_a_second_time(network, file):
    """From a file to features; the image is rounded to 8 bits and resized by half-pixel bilinear weights."""
    image = picture(1)
    weights = [bilinear(side) for side in image.shape[:2]]
    eight = (image.double() * 255).round() / 255
    resized = torch.einsum("ih,jw,hwc->cij", *weights, eight)
    expected = Reference(network.state_dict())(2 * resized[None] - 1)
    found = InceptionFeatures(read_inception(file))(image)
    assert found.shape == (2048,)
    assert float(expected.std()) > 0.1 * float(expected.mean()) > 0  # features that tell something
    np.testing.assert_allclose(found, expected.numpy(), rtol=2e-4, atol=2e-4 * float(expected.mean()))


def bilinear(side):
    """Row i mixes the two pixels around (i + 0.5) side / 299 - 0.5, none beyond the border."""
    mixed = torch.zeros(299, side, dtype=torch.float64)
    for row in range(299):
        place = min(max((row + 0.5) * side / 299 - 0.5, 0.0), side - 1.0)
        low = min(int(place), side - 2)
        mixed[row, low], mixed[row, low + 1] = 1 - (place - low), place - low
    return mixed


def test_layers_have_the_sizes_of_the_paper(network):
    seen = {}
    hooks = [
        network.get_submodule(name).register_forward_hook(
            lambda module, given, found, name=name: seen.update({name: (found.shape[1], found.shape[2])})
        )
        for name in SIDES
    ]
    assert network(torch.zeros(1, 3, 299, 299)).shape == (1, 2048)
    for hook in hooks:
        hook.remove()
    assert seen == SIDES
    # Of 23,834,568 that are told of 1,000 classes: less 2,049,000 of these and 34,432 of the channels.
    kernels = sum(values.numel() for name, values in network.state_dict().items() if name.endswith("conv.weight"))
    assert kernels == 21_751_136


def test_sets_of_images_have_fid_and_kid_by_these_features(network):
    extractor = InceptionFeatures(network)
    sets = {real: [picture(seed, 12, 16) for seed in seeds] for real, seeds in ((True, (1, 2, 3)), (False, (4, 5)))}
    metric = SetDistances(extractor, sync_on_compute=False)
    for real, images in sets.items():
        for image in images:
            metric.update(image, real=real)
    rendered, recorded = (np.stack([extractor(image) for image in sets[real]]) for real in (False, True))
    assert set(metric.compute()) == {"fid", "kid"}
    assert metric.compute()["fid"] == frechet_distance(rendered, recorded) > 0


def test_the_file_is_looked_for_in_the_named_folder_alone(file, tmp_path, monkeypatch):
    for named in (None, tmp_path):
        monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
        if named is not None:
            monkeypatch.setenv(FOLDER_VARIABLE, str(named))
        found, missing = open_inception(CPU)
        assert (found, set(missing)) == (None, {"fid", "kid"})
        assert f"no weights ({WEIGHTS}): set {FOLDER_VARIABLE} to a folder" in missing["fid"]
    monkeypatch.setenv(FOLDER_VARIABLE, str(file.parent))
    found, missing = open_inception(CPU)
    assert (there(found).name, missing) == ("inception", {})


def without(state):
    del state["Mixed_6c.branch7x7_2.bn.bias"]


def with_another(state):
    state["AuxLogits.fc.weight"] = torch.zeros(2)


def of_other_classes(state):
    state["fc.weight"] = torch.zeros(1000, 2048)


def with_words(state):
    state["fc.bias"] = "words"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (without, r'Missing key.*"Mixed_6c.branch7x7_2.bn.bias"'),
        (with_another, r'Unexpected key.*"AuxLogits.fc.weight"'),
        (of_other_classes, r"size mismatch for fc.weight.*\[1000, 2048\]"),
        (with_words, "fc.bias"),
    ],
)
def test_a_file_of_another_network_is_refused(network, tmp_path, change, said):
    state = dict(network.state_dict())
    change(state)
    torch.save(state, tmp_path / WEIGHTS)
    with pytest.raises(ValueError, match=f"{WEIGHTS} does not hold the Inception of FID.*{said}") as error:
        read_inception(tmp_path / WEIGHTS)
    assert "\n" not in str(error.value)
    assert FOLDER_VARIABLE in str(error.value)


class Malicious:
    def __reduce__(self):
        return exec, ("raise SystemExit",)


def test_files_that_are_no_weights_are_refused_and_run_nothing(file, tmp_path):
    path = tmp_path / WEIGHTS
    torch.save({"fc.weight": Malicious()}, path)
    with pytest.raises(ValueError, match="does not hold the Inception of FID"):
        read_inception(path)
    for content in (b"", b"words", file.read_bytes()[:1000]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="does not hold the Inception of FID"):
            read_inception(path)
    with pytest.raises(FileNotFoundError):
        read_inception(tmp_path / "absent.pth")
