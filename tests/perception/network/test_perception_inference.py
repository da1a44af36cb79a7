"""The network as it is flown against the network as it was trained, and Winograd's filtering against torch's convolution."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sortie.perception.network import winograd
from sortie.perception.network.inference import _coloured, folded
from sortie.perception.network.model import CarNet, ModelConfig, colours
from sortie.perception.network.winograd import WinogradReLU, suits


def layer(c: int, o: int, dilation: int = 1, seed: int = 0) -> nn.Conv2d:
    torch.manual_seed(seed)
    return nn.Conv2d(c, o, 3, padding=dilation, dilation=dilation)


def exact(conv: nn.Conv2d, x: Tensor) -> Tensor:
    """Bias, convolution and ReLU in doubles."""
    assert conv.bias is not None
    out = F.conv2d(x.double(), conv.weight.double(), conv.bias.double(), 1, conv.padding, conv.dilation)
    return F.relu(out)


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    n=st.integers(1, 3),
    c=st.sampled_from([1, 3, 8, 24, 40]),
    o=st.sampled_from([1, 5, 16, 40]),
    tiles=st.tuples(st.integers(1, 6), st.integers(1, 6)),
    dilation=st.sampled_from([1, 2, 3]),
    seed=st.integers(0, 2**16),
)
def test_winograd_is_the_convolution(n: int, c: int, o: int, tiles: tuple[int, int], dilation: int, seed: int) -> None:
    conv = layer(c, o, dilation, seed)
    x = torch.randn(n, c, tiles[0] * 4 * dilation, tiles[1] * 4 * dilation)
    with torch.inference_mode():
        got = WinogradReLU(conv)(x)
        want = exact(conv, x)
    assert got.shape == want.shape
    assert torch.allclose(got.double(), want, atol=1e-5 * float(want.max().clamp_min(1.0)))


@pytest.mark.parametrize("dilation", [1, 2])
def test_a_residual_is_added(dilation: int) -> None:
    conv = layer(16, 16, dilation)
    x = torch.randn(2, 16, 32, 24)
    with torch.inference_mode():
        got = WinogradReLU(conv, residual=True)(x)
        assert torch.allclose(got.double(), x + exact(conv, x), atol=1e-5)


def test_winograd_reaches_no_farther_than_the_filter() -> None:
    """One pixel is felt by the nine around it, at the border too, and by none else."""
    conv = layer(4, 4)
    x = torch.zeros(1, 4, 16, 16)
    for row, column in ((0, 0), (7, 8), (15, 15), (3, 12)):
        moved = x.clone()
        moved[0, :, row, column] = 1.0
        with torch.inference_mode():
            felt = (WinogradReLU(conv)(moved) - WinogradReLU(conv)(x)).abs().sum(dim=(0, 1)) > 1e-4
        assert not felt[:, : max(column - 1, 0)].any()
        assert not felt[:, column + 2 :].any()
        assert not felt[: max(row - 1, 0)].any()
        assert not felt[row + 2 :].any()
        assert felt[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].any()


def test_without_packed_weights_it_says_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    conv, x = layer(24, 40), torch.randn(1, 24, 64, 64)
    with torch.inference_mode():
        packed = WinogradReLU(conv)(x)
        monkeypatch.setattr(winograd, "_PACKS", False)
        assert torch.allclose(WinogradReLU(conv)(x), packed, atol=1e-5)


@pytest.mark.parametrize("shape", [(1, 8, 18, 16), (1, 8, 16, 20)])
def test_maps_of_no_whole_number_of_tiles_are_convolved_plainly(shape: tuple[int, ...]) -> None:
    conv, x = layer(8, 8, 2), torch.randn(shape)
    with torch.inference_mode():
        assert torch.equal(WinogradReLU(conv)(x), F.relu(conv(x)))
        assert torch.equal(WinogradReLU(conv, residual=True)(x), x + F.relu(conv(x)))


def test_a_gradient_is_followed() -> None:
    conv, x = layer(8, 8), torch.randn(1, 8, 16, 16)
    WinogradReLU(conv)(x).sum().backward()
    assert conv.weight.grad is not None
    assert float(conv.weight.grad.abs().sum()) > 0.0


def test_threads_say_the_same() -> None:
    quick, x = WinogradReLU(layer(40, 40)), torch.randn(1, 40, 64, 64)

    def task(_: int) -> Tensor:
        with torch.inference_mode():
            out: Tensor = quick(x)
            return out

    with ThreadPoolExecutor(4) as pool:
        first, *others = pool.map(task, range(12))
    assert all(torch.equal(first, other) for other in others)


@pytest.mark.parametrize(
    ("conv", "fits"),
    [
        (nn.Conv2d(8, 8, 3, padding=1), True),
        (nn.Conv2d(8, 8, 3, padding=2, dilation=2), True),
        (nn.Conv2d(8, 8, 3, padding=3, dilation=3), True),
        (nn.Conv2d(8, 8, 3, padding=(1, 2), dilation=(1, 2)), False),
        (nn.Conv2d(8, 8, 3, padding=1, dilation=2), False),
        (nn.Conv2d(8, 8, 3, padding=0), False),
        (nn.Conv2d(8, 8, 3, stride=2, padding=1), False),
        (nn.Conv2d(8, 8, 5, padding=2), False),
        (nn.Conv2d(8, 8, 3, padding=1, groups=2), False),
        (nn.Conv2d(8, 8, 3, padding=1, bias=False), False),
        (nn.Conv2d(8, 8, 3, padding=1, padding_mode="reflect"), False),
        (nn.ConvTranspose2d(8, 8, 3, padding=1), False),
        (nn.ReLU(), False),
    ],
)
def test_what_suits(conv: nn.Module, fits: bool) -> None:
    assert suits(conv) is fits


def lively(config: ModelConfig) -> CarNet:
    """A network whose batch norms do something."""
    torch.manual_seed(3)
    net = CarNet(config)
    for module in net.modules():
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.uniform_(module.bias, -0.3, 0.3)
            assert module.running_mean is not None
            assert module.running_var is not None
            module.running_mean.uniform_(-0.2, 0.2)
            module.running_var.uniform_(0.5, 2.0)
    return net.eval()


def test_the_network_that_flies_is_the_one_that_was_trained() -> None:
    net = lively(ModelConfig())
    quick = folded(net)
    image = torch.randint(0, 256, (2, 4, 256, 256), dtype=torch.uint8)
    image[:, 3] = torch.where(image[:, 3] > 40, 255, 0)
    with torch.inference_mode():
        features, quickly = net.encoder(image), quick.encoder(image)
        out, quick_out = net.head(features), quick.head(features)
    # features are rounded to float16 at the exchange: neighbours there, where the sums' last bits differ
    assert torch.allclose(features, quickly, rtol=2e-3, atol=1e-4)
    assert float((features != quickly).float().mean()) < 0.05
    assert torch.allclose(out, quick_out, atol=1e-4 * float(out.abs().max()))


def test_folding_leaves_the_network_as_it_was() -> None:
    net = lively(ModelConfig())
    before = {k: v.clone() for k, v in net.state_dict().items()}
    folded(net)
    assert all(torch.equal(v, before[k]) for k, v in net.state_dict().items())


def test_half_digits_are_reckoned_too() -> None:
    quick = folded(lively(ModelConfig()))
    image = torch.randint(0, 256, (1, 4, 256, 256), dtype=torch.uint8)
    with torch.inference_mode():
        whole = quick.encoder(image)
        with torch.autocast("cpu", torch.bfloat16):
            half = quick.encoder(image)
    assert half.dtype == torch.float32
    assert float((whole - half).abs().mean()) < 0.05 * float(whole.abs().mean())


def test_colours_are_the_same_to_the_bit_where_a_compiled_loop_reckons_them() -> None:
    image = torch.randint(0, 256, (2, 4, 64, 48), dtype=torch.uint8)
    assert torch.equal(_coloured(image), colours(image))
