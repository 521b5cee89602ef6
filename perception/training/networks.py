"""The networks that find a wound: the one that is shipped, and the U-Net of the thesis as its reference."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional


def _convolution(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    layer = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
    return nn.Sequential(layer, nn.BatchNorm2d(outputs))


class Block(nn.Module):
    """Residual block of two 3x3 convolutions (He et al., CVPR 2016). Depth-wise blocks of the same accuracy class
    have a third fewer multiplications but take 1.3 times as long to train on a CPU, where they wait for memory."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _convolution(channels, channels)
        self.second = _convolution(channels, channels)

    def forward(self, features: Tensor) -> Tensor:
        """(N, C, H, W) -> the same shape."""
        return features + self.second(functional.relu(self.first(features)))


class Context(nn.Module):
    """Adds what the whole picture looks like to every place (squeeze and add)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.mix = nn.Sequential(nn.Conv2d(channels, channels, 1), nn.ReLU(), nn.Conv2d(channels, channels, 1))

    def forward(self, features: Tensor) -> Tensor:
        """(N, C, H, W) -> the same shape."""
        return features + self.mix(features.mean((2, 3), keepdim=True))


def _up(features: Tensor) -> Tensor:
    return functional.interpolate(features, scale_factor=2.0, mode="nearest")


def made(name: str, seed: int) -> nn.Module:
    """A network by name, "wound" or "thesis", with its first weights drawn from the seed."""
    torch.manual_seed(seed)
    return WoundNet() if name == "wound" else ThesisUNet()


def size_of(network: nn.Module) -> int:
    """How many numbers were learned."""
    return sum(parameter.numel() for parameter in network.parameters())


class WoundNet(nn.Module):
    """Encoder of five levels and a light decoder; (N, 3, H, W) in 0..1, RGB -> (N, 1, H, W) logits.

    H and W are multiples of 32. The first two levels only halve the picture, the depth lies at strides 8 and 16,
    and the last step puts out four sub-pixel logits a place, so that no layer runs at full size.
    """

    def __init__(
        self,
        widths: Sequence[int] = (16, 32, 64, 128, 192),
        depths: Sequence[int] = (1, 2, 3, 1),
    ) -> None:
        super().__init__()
        self.stem = nn.Sequential(_convolution(3, widths[0], stride=2), nn.ReLU())
        self.downs = nn.ModuleList(_convolution(a, b, stride=2) for a, b in pairwise(widths))
        self.stages = nn.ModuleList(
            nn.Sequential(*(Block(width) for _ in range(depth)))
            for width, depth in zip(widths[1:], depths, strict=True)
        )
        self.context = Context(widths[-1])
        rising = list(reversed(widths))
        self.laterals = nn.ModuleList(_convolution(a, b, 1) for a, b in pairwise(rising))
        self.skips = nn.ModuleList(_convolution(width, width, 1) for width in rising[1:])
        self.merges = nn.ModuleList(Block(width) for width in rising[1:-1])
        self.fine = nn.Sequential(_convolution(widths[0], widths[0]), nn.ReLU())
        self.head = nn.Conv2d(widths[0], 4, 1)

    def forward(self, pictures: Tensor) -> Tensor:
        """Logits of "this pixel belongs to a wound"."""
        levels = [self.stem((pictures - 0.45) * 4.0)]
        for down, stage in zip(self.downs, self.stages, strict=True):
            levels.append(stage(down(levels[-1])))
        features = self.context(levels.pop())
        for index, (lateral, skip) in enumerate(zip(self.laterals, self.skips, strict=True)):
            features = functional.relu(_up(lateral(features)) + skip(levels.pop()))
            features = self.merges[index](features) if index < len(self.merges) else self.fine(features)
        return functional.pixel_shuffle(self.head(features), 2)


class ThesisUNet(nn.Module):
    """The U-Net of thesis 3.3: four levels of two 3x3 convolutions with 32, 64, 128 and 256 filters, max pooling, a
    bottleneck of 256, nearest up-sampling and skips; (N, 3, H, W) RGB in 0..1, made grey -> (N, 1, H, W) logits."""

    def __init__(self, filters: Sequence[int] = (32, 64, 128, 256)) -> None:
        super().__init__()
        self.encoder = nn.ModuleList(_pair(a, b) for a, b in pairwise((1, *filters)))
        self.bottom = _pair(filters[-1], filters[-1])
        below = (filters[-1], *reversed(filters))
        self.decoder = nn.ModuleList(_pair(a + b, b) for a, b in zip(below, reversed(filters), strict=False))
        self.head = nn.Conv2d(filters[0], 1, 1)

    def forward(self, pictures: Tensor) -> Tensor:
        """Logits of "this pixel belongs to a wound"."""
        red, green, blue = pictures.split(1, 1)
        levels, features = [], 0.299 * red + 0.587 * green + 0.114 * blue  # ITU-R BT.601, as OpenCV
        for pair in self.encoder:
            levels.append(pair(features))
            features = functional.max_pool2d(levels[-1], 2)
        features = self.bottom(features)
        for pair in self.decoder:
            features = pair(torch.cat([levels.pop(), _up(features)], 1))
        return self.head(features)


def _pair(inputs: int, outputs: int) -> nn.Sequential:
    """Two convolutions with ReLU, He-initialised as in Appendix A; no normalisation, as there."""
    layers = (nn.Conv2d(inputs, outputs, 3, padding=1), nn.Conv2d(outputs, outputs, 3, padding=1))
    for layer in layers:
        nn.init.kaiming_normal_(layer.weight)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU())
