"""The network's way from a picture to a probability: sizes, backends, files."""

import importlib.util
import json
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from zsdt.errors import DataError, OptionError
from zsdt.perception.openvino_segmenter import load_openvino
from zsdt.perception.segmentation import (
    WORKING_SIDE,
    EagerNetwork,
    SegmentationBackend,
    Segmenter,
    UNetSegmenter,
    folded,
    has_bfloat16,
    load_segmenter,
    resolved,
)
from zsdt.perception.unet import UNet, UNetOptions, parameters
from zsdt.perception.unet_weights import load_unet, save_unet, unet_card

torch.set_num_threads(1)
SMALL = UNetOptions([4, 8, 8])


def network(options: UNetOptions = SMALL) -> UNet:
    """Random weights, with statistics of normalisation and biases that are not those of a fresh network."""
    torch.manual_seed(0)
    net = UNet(options)
    net.train()
    for _ in range(3):
        net(torch.randn(2, 3, net.multiple * 4, net.multiple * 4) * 0.3 + 0.1)
    for value in net.parameters():
        value.data += 0.05 * torch.randn_like(value)
    return net.eval()


def picture(h: int, w: int) -> np.ndarray:
    """Random colours."""
    return np.random.default_rng(0).integers(0, 256, (h, w, 3), dtype=np.uint8)


@pytest.fixture
def folder(tmp_path):
    save_unet(tmp_path, network(), SMALL, {"pictures": 3})
    return tmp_path


@pytest.mark.parametrize("size", [(64, 96), (61, 97), (9, 200), (1, 1)])
def test_a_picture_of_any_size_gives_a_probability_of_that_size(folder, size):
    segmenter = load_segmenter(folder)
    answer = segmenter.probability(picture(*size))
    assert isinstance(segmenter, Segmenter)
    assert answer.shape == size and answer.dtype == np.float32
    assert (answer >= 0).all() and (answer <= 1).all()


def test_padding_does_not_change_what_is_far_from_the_border(folder):
    segmenter = load_segmenter(folder)
    image = picture(96, 128)
    whole, cut = segmenter.probability(image), segmenter.probability(image[:90, :121])
    np.testing.assert_allclose(whole[:40, :60], cut[:40, :60], atol=1e-5)


def test_a_large_picture_is_computed_at_the_working_size(folder):
    segmenter = load_segmenter(folder)
    small = np.full((100, WORKING_SIDE, 3), 90, np.uint8)
    small[40:60] = 200
    large = np.repeat(np.repeat(small, 2, axis=0), 2, axis=1)
    answer = segmenter.probability(large)
    assert answer.shape == large.shape[:2]
    one, other = (
        cv2.resize(p, (160, 10), interpolation=cv2.INTER_AREA) for p in (answer, segmenter.probability(small))
    )
    np.testing.assert_allclose(one, other, atol=0.02)


def test_folding_the_normalisation_changes_nothing():
    image = torch.randn(1, 3, 32, 32)
    with torch.inference_mode():
        plain = network()(image)
        torch.testing.assert_close(folded(network())(image), plain, atol=1e-5, rtol=1e-4)


def test_openvino_gives_the_same_probability(folder):
    pytest.importorskip("torch")
    try:
        load_openvino()
    except OptionError as error:
        pytest.skip(str(error))
    fast = load_segmenter(folder, SegmentationBackend.openvino)
    slow = load_segmenter(folder)
    for size in ((61, 97), (64, 64)):
        image = picture(*size)
        np.testing.assert_allclose(fast.probability(image), slow.probability(image), atol=1e-3)
    assert sys.modules.get("openvino_telemetry") is None  # nothing is reported to anybody


@pytest.mark.skipif(not has_bfloat16(), reason="this processor has no bfloat16")
def test_bfloat16_gives_the_same_probability_to_its_three_digits(folder):
    image = picture(64, 96)
    slow = load_segmenter(folder).probability(image)
    for name in ("eager_bf16", "openvino_bf16" if importlib.util.find_spec("openvino") else "eager_bf16"):
        fast = load_segmenter(folder, SegmentationBackend(name)).probability(image)
        np.testing.assert_allclose(fast, slow, atol=0.03)
        assert np.abs(fast - slow).max() > 0  # it is another arithmetic


def test_the_fastest_backend_is_one_that_this_machine_has(folder, monkeypatch):
    chosen = resolved(SegmentationBackend.fastest)
    assert chosen.half == has_bfloat16() and chosen.startswith("openvino") == bool(importlib.util.find_spec("openvino"))
    monkeypatch.setattr("zsdt.perception.segmentation.has_bfloat16", lambda: False)
    assert not resolved(SegmentationBackend.fastest).half
    with pytest.raises(OptionError, match="bfloat16"):
        load_segmenter(folder, SegmentationBackend.eager_bf16)


def test_a_missing_openvino_is_said(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "openvino", None)
    with pytest.raises(OptionError, match="pip install openvino"):
        load_segmenter(folder, SegmentationBackend.openvino)


def test_weights_come_back_to_half_precision(tmp_path):
    net = network(UNetOptions())
    save_unet(tmp_path, net, UNetOptions(), {})
    assert 400_000 < parameters(net) < 600_000
    assert (tmp_path / "unet.pt").stat().st_size < 2_000_000
    image = picture(64, 64)
    one, other = (UNetSegmenter(EagerNetwork(n), n.multiple).probability(image) for n in (net, load_unet(tmp_path)))
    np.testing.assert_allclose(one, other, atol=5e-3)


def test_too_large_a_network_is_not_written(tmp_path):
    options = UNetOptions([32, 64, 128, 256])
    with pytest.raises(OptionError, match="2 MB"):
        save_unet(tmp_path, UNet(options), options, {})
    assert not list(tmp_path.iterdir())


def test_missing_and_broken_weights_are_said(folder, tmp_path_factory):
    with pytest.raises(DataError, match="No trained segmentation"):
        load_segmenter(tmp_path_factory.mktemp("empty"))
    card = unet_card(folder)
    assert card["pictures"] == 3 and card["widths"] == SMALL.widths
    (folder / "unet.json").write_text(json.dumps({**card, "widths": [4, 8, 16]}))
    with pytest.raises(DataError, match=r"broken|fit"):
        load_segmenter(folder)
    (folder / "unet.json").write_text(json.dumps(card))
    (folder / "unet.pt").write_bytes(b"nonsense")
    with pytest.raises(DataError, match="broken"):
        load_segmenter(folder)


def test_options_refuse_nonsense():
    with pytest.raises(OptionError, match="levels"):
        UNetOptions([16])


def test_openvino_closes_no_error_stream_that_it_found():
    """What comes along with it (absl) would close a redirected stderr when logging is set up anew."""
    if importlib.util.find_spec("openvino") is None:  # looked for, not imported: that would be the very thing
        pytest.skip("OpenVINO is not installed.")
    program = (
        "import io, logging, sys\n"
        "found = sys.stderr = io.StringIO()\n"
        "from zsdt.perception.openvino_segmenter import load_openvino\n"
        "load_openvino()\n"
        "sys.stderr = io.StringIO()\n"
        "logging.shutdown()\n"
        "print('closed' if found.closed else 'open')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "open"
