"""Every error of a packed Gaussian is within the bound that the module states."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sparsestreet.codec.gaussians import LEVELS, Block, Steps, packed_block, unpacked_block
from sparsestreet.codec.vectors import along_axes
from tests.codec.blocks import block, form

STEPS = Steps(0.002)


def there_and_back(one: Block, *, named_axes: bool = False, steps: Steps = STEPS) -> Block:
    """The rows in their first order."""
    kind = form(one, named_axes=named_axes)
    found = unpacked_block(b"".join(packed_block(one, kind, steps)), kind)
    back = np.argsort(found.others["instances"])
    return Block(
        found.means[back],
        found.log_scales[back],
        found.quaternions[back],
        found.opacity_logits[back],
        found.harmonics[back],
        {name: column[back] for name, column in found.others.items()},
    )


def opacity(one: Block) -> np.ndarray:
    return 1 / (1 + np.exp(-one.opacity_logits))


def growth(one: Block) -> np.ndarray:
    """From the text: the inverse root of the opacity in steps of sqrt(2), at most 16."""
    halved = np.minimum(np.rint(-np.log2(np.maximum(np.rint(LEVELS * opacity(one)), 0.5) / LEVELS)), 8)
    return np.sqrt(2.0**halved)[:, None]


def covariances(one: Block) -> np.ndarray:
    axes = Rotation.from_quat(one.quaternions, scalar_first=True).as_matrix() * np.exp(one.log_scales)[:, None, :]
    return axes @ axes.swapaxes(1, 2)


@pytest.mark.parametrize("rows", [0, 1, 2, 255, 256, 257])
@pytest.mark.parametrize("named_axes", [False, True])
def test_errors_are_within_their_bounds(rows: int, named_axes: bool):
    one = block(rows)
    found = there_and_back(one, named_axes=named_axes)
    assert len(found) == rows
    np.testing.assert_allclose(found.means, one.means, rtol=0, atol=STEPS.position / 2 + 1e-12)
    np.testing.assert_allclose(opacity(found), opacity(one), rtol=0, atol=1 / 254 + 1e-12)
    off = np.abs(along_axes(found.harmonics - one.harmonics, form(one).axes))
    assert (off <= 0.6 * STEPS.color * growth(one) + 1e-9).all()
    for name, column in one.others.items():
        assert found.others[name].dtype == column.dtype
        assert np.array_equal(found.others[name], column)
    if named_axes:
        assert (np.abs(found.log_scales - one.log_scales) <= STEPS.log_scale * growth(one) / 2 + 1e-12).all()
        unit = one.quaternions / np.linalg.norm(one.quaternions, axis=1, keepdims=True)
        # Four parts off by half a step each; to make the whole a unit again at most doubles that.
        assert (np.linalg.norm(found.quaternions - unit, axis=1) <= 2 * STEPS.rotation * growth(one)[:, 0]).all()


def test_an_ellipsoid_stays_what_it_is_though_its_axes_are_named_anew():
    one, fine = block(300), Steps(1e-4, 1e-7, 1e-7, 1e-4)
    found = there_and_back(one, steps=fine)
    # Of the log scales: 3e-6 in each variance; of the turns: 2 sqrt(3) 8e-7 of the largest one.
    expected = covariances(one)
    largest = np.abs(expected).max((1, 2), keepdims=True)
    assert (np.abs(covariances(found) - expected) <= 1e-5 * largest).all()
    assert np.allclose(np.sort(found.log_scales, axis=1), np.sort(one.log_scales, axis=1), rtol=0, atol=1e-6)
    # The stored turn is the smallest of those that look alike.
    assert np.abs(found.quaternions[:, 1:] / found.quaternions[:, :1]).max() <= np.tan(np.pi / 8) + 1e-5


def test_an_axis_turns_by_no_more_than_the_bound():
    one = block(400)
    found = there_and_back(replace(one, log_scales=np.tile([0.0, -1.0, -3.0], (400, 1))), steps=Steps(0.002, 1e-9))
    turn = Rotation.from_quat(one.quaternions, scalar_first=True).as_matrix()
    again = Rotation.from_quat(found.quaternions, scalar_first=True).as_matrix()
    # The longest axis of both: their angle.
    longest = np.take_along_axis(again, np.argmax(found.log_scales, axis=1)[:, None, None], axis=2)[:, :, 0]
    angle = np.arccos(np.clip(np.abs((turn[:, :, 0] * longest).sum(1)), 0, 1))
    assert (angle <= np.sqrt(3) * Steps(1.0).rotation * growth(one)[:, 0] * 1.05).all()  # 5 %: tan for large steps
    assert angle.max() > Steps(1.0).rotation / 4


def test_what_shows_little_has_larger_steps_and_what_shows_much_finer_ones():
    one = block(2000)
    off = np.abs(np.sort(there_and_back(one).log_scales, 1) - np.sort(one.log_scales, 1)).max(1)
    clear, dense = opacity(one) < 0.02, opacity(one) > 0.9
    assert off[dense].max() <= Steps(1.0).log_scale / 2 + 1e-9 < off[clear].max() / 3


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_damaged_bytes_are_refused_or_give_finite_rows(data: st.DataObject):
    one = block(7)
    content = bytearray(b"".join(packed_block(one, form(one), STEPS)))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(4, len(content) - 1))] = data.draw(st.integers(0, 255))
    try:
        found = unpacked_block(bytes(content), form(one))
    except ValueError:
        return
    assert len(found) == 7
    assert np.isfinite(found.means).all()
    assert np.isfinite(opacity(found)).all()


def test_every_cut_is_refused():
    one = block(3, terms=1)
    content = b"".join(packed_block(one, form(one), STEPS))
    for length in range(len(content)):
        with pytest.raises(ValueError, match="damaged"):
            unpacked_block(content[:length], form(one))
    with pytest.raises(ValueError, match="1 bytes are left over"):
        unpacked_block(content + b"x", form(one))


def test_a_turn_of_no_length_and_opacities_of_0_and_1():
    one = block(4)
    one = replace(one, quaternions=np.zeros((4, 4)), opacity_logits=np.array([-1e4, -90.0, 90.0, 1e4]))
    found = there_and_back(one, named_axes=True)
    assert np.isfinite(found.quaternions).all()
    # The ends are kept a fourth of a level inside, so that their logits are finite: 1 / 4 / 127.
    np.testing.assert_allclose(opacity(found), [0, 0, 1, 1], rtol=0, atol=1 / 508 + 1e-12)
    assert np.isfinite(there_and_back(one).quaternions).all()
