"""The network: an encoder of five halvings, a decoder, and two heads; 1.3 million parameters."""

import torch
from torch import Tensor, nn
from torch.nn import functional

CLASSES = ("other", "support", "flat", "thing")
"""Channels of the fine head that exclude each other; then come `drawn` and `rim`."""
FINE, COARSE = len(CLASSES) + 2, 7
WIDTHS = (16, 32, 64, 96, 128)
OFFSET_UNIT = 32
"""Pixels of the picture in one unit of an offset."""


class Layer(nn.Sequential):
    """Convolution, batch norm, rectifier."""

    def __init__(self, inputs: int, outputs: int, size: int = 3, stride: int = 1, dilation: int = 1) -> None:
        margin = dilation * (size // 2)
        super().__init__(
            nn.Conv2d(inputs, outputs, size, stride, margin, dilation, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )


class Residual(nn.Module):
    """Two convolutions beside a shortcut."""

    def __init__(self, channels: int, dilation: int = 1) -> None:
        super().__init__()
        self.first = Layer(channels, channels, 3, 1, dilation)
        self.second = nn.Sequential(nn.Conv2d(channels, channels, 3, 1, 1, bias=False), nn.BatchNorm2d(channels))

    def forward(self, features: Tensor) -> Tensor:
        """The features, refined."""
        return functional.relu(features + self.second(self.first(features)))


def doubled(features: Tensor) -> Tensor:
    """Features at twice the size."""
    return functional.interpolate(features, scale_factor=2.0, mode="bilinear", align_corners=False)


class Network(nn.Module):
    """RGB of 0 to 1 (n, 3, h, w), sides multiples of 32, to two maps of logits and numbers.

    Fine (n, 6, h/2, w/2): the four CLASSES, then `drawn` over the picture, then `rim` (the edge of a thing).
    Coarse (n, 7, h/4, w/4): `centre` of a thing or flat thing, the offset to it (down, right) in units of 32 pixels,
    the logarithm of the inverse depth up to a constant, and the normal of the plane (right, down, forward).
    """

    def __init__(self) -> None:
        super().__init__()
        a, b, c, d, e = WIDTHS
        self.stage1 = Layer(3, a, 3, 2)
        self.stage2 = nn.Sequential(Layer(a, b, 3, 2), Residual(b))
        self.stage3 = nn.Sequential(Layer(b, c, 3, 2), Residual(c))
        self.stage4 = nn.Sequential(Layer(c, d, 3, 2), Residual(d), Residual(d))
        self.stage5 = nn.Sequential(Layer(d, e, 3, 2), Residual(e), Residual(e, 2))
        self.side5, self.side4, self.side3 = Layer(e, 64, 1), Layer(d, 64, 1), Layer(c, 64, 1)
        self.side2, self.side1, self.narrow = Layer(b, 48, 1), Layer(a, 16, 1), Layer(32, 16, 1)
        self.merge4, self.merge3, self.merge2, self.merge1 = Layer(64, 64), Layer(64, 48), Layer(48, 32), Layer(16, 24)
        self.fine = nn.Conv2d(24, FINE, 1)
        self.coarse = nn.Sequential(Layer(32, 24), nn.Conv2d(24, COARSE, 1))

    def forward(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        """The fine and the coarse map."""
        first = self.stage1(picture * 4 - 2)
        second = self.stage2(first)
        third = self.stage3(second)
        fourth = self.stage4(third)
        wide = self.merge4(doubled(self.side5(self.stage5(fourth))) + self.side4(fourth))
        wide = self.merge3(doubled(wide) + self.side3(third))
        wide = self.merge2(doubled(wide) + self.side2(second))
        fine = self.merge1(doubled(self.narrow(wide)) + self.side1(first))
        return self.fine(fine), self.coarse(wide)


def new_network(seed: int) -> Network:
    """A network with weights drawn by a seed; it starts with few centres and nothing drawn."""
    torch.manual_seed(seed)
    network = Network()
    last = network.coarse[1]
    assert isinstance(last, nn.Conv2d)
    for bias, row in ((last.bias, 0), (network.fine.bias, len(CLASSES))):
        assert bias is not None
        bias.data[row] = -4
    return network
