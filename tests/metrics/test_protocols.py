"""Protocols name metrics that exist."""

from dataclasses import replace

import pytest

from sparsestreet.metrics.protocols import DRIVESTUDIO, PROTOCOLS, STRICT


def test_the_protocols_choose_the_definitions_that_their_names_promise():
    assert DRIVESTUDIO.metrics == (
        *("psnr_full", "ssim_uniform7_full", "lpips_alex_full"),
        *("psnr_human", "ssim_uniform7_human", "psnr_vehicle", "ssim_uniform7_vehicle"),
    )
    assert STRICT.metrics == (
        *("psnr8_no_hood", "ssim_gauss11_no_hood", "lpips_alex_no_hood", "lpips_vgg_no_hood"),
        *("psnr8_human", "ssim_gauss11_human", "psnr8_vehicle", "ssim_gauss11_vehicle"),
    )
    assert {name: protocol.name for name, protocol in PROTOCOLS.items()} == {
        "drivestudio": "drivestudio",
        "strict": "strict",
    }


def test_a_metric_without_definition_is_refused():
    with pytest.raises(ValueError, match=r"protocol strict names \['psnr_hood'\]"):
        replace(STRICT, psnr="psnr_hood")
