"""A small stereo network: searched coarse, refined twice by what it learns, then fitted to the pictures.

Coarse to fine with warped features as in PWC-Net (Sun et al., CVPR 2018), upsampled by learned weights as in
RAFT (Teed and Deng, ECCV 2020). Parts of a pixel are not learned: they come from Gauss-Newton steps on the
pictures themselves (Lucas and Kanade, IJCAI 1981), in which the network only says how far to trust each pixel
and its own guess.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

MULTIPLE = 16  # px: sides of the pictures must be multiples of it
COARSEST = 8  # px of the pictures per px of the search
SHIFTS = 16  # disparities that are searched, of COARSEST px each: 0 to 120 px
REACH = (3, 2)  # px of a refinement's own picture, to both sides
SECOND, FOURTH, EIGHTH = 16, 24, 32  # channels of the features
HIDDEN = 8  # channels from one refinement to the next
SHARPNESS = 20.0  # of a choice among likenesses of -1..1, before it is learnt
EVEN_WINDOW = 15  # px: brightness and contrast that are even over it do not count
NOISE = 0.01  # of white: contrast below it is noise
STEPS = 2  # on the pictures
WINDOW = 9  # px, of such a step, and of what smooths it
LARGEST_STEP = 1.0  # px
# Before they are learnt:
DOUBT = 0.01  # contrast that it takes to leave a guess
EDGE = 0.2  # px squared: a disparity that varies less in a window is smoothed, one that varies more is kept
GRAY = (0.299, 0.587, 0.114)


class StereoNetwork(nn.Module):
    """Disparity of the left picture, from pictures of any brightness."""

    def __init__(self) -> None:
        super().__init__()
        self.features = _Features()
        self.search = _Search()
        self.fourth = _Refinement(FOURTH, EIGHTH, 32, REACH[0])
        self.second = _Refinement(SECOND, HIDDEN, 16, REACH[1])
        self.finest = _silent(nn.Conv2d(HIDDEN, 9 * 4, 1))
        self.trust = _silent(nn.Conv2d(HIDDEN, 3, 1))

    def forward(self, left: Tensor, right: Tensor) -> Tensor:
        """Disparity [B, 1, H, W] (px) of pictures [B, 3, H, W] (RGB, 0..1)."""
        return self.stages(left, right)[-1]

    def stages(self, left: Tensor, right: Tensor) -> list[Tensor]:
        """The disparities (px of the pictures) that follow each other, coarse to fine, each of its size."""
        both = torch.cat([left, right])
        even = evened(both)
        second, fourth, eighth = (
            part.chunk(2) for part in self.features(torch.cat([_scaled(both), even], 1))
        )
        coarse, hidden = self.search(*eighth)
        fine, hidden = self.fourth(*fourth, coarse, hidden)
        finer, hidden = self.second(*second, fine, hidden)
        found = [coarse * COARSEST, fine * (COARSEST // 2), finer * (COARSEST // 4)]
        found.append(_upsampled(finer, self.finest(hidden)))
        trust = functional.interpolate(
            self.trust(hidden), scale_factor=2.0, mode="bilinear", align_corners=False
        )
        gray = even.chunk(2)
        weight, scales = torch.sigmoid(trust[:, :1]), torch.exp(trust[:, 1:].clamp(-5, 5))
        doubt, edge = DOUBT * scales[:, :1], EDGE * scales[:, 1:]
        return [*found, *fit(gray[0], gray[1], found[-1], weight, doubt, edge)]


class _Features(nn.Module):
    """What is compared: of a half, a quarter and an eighth of the size."""

    def __init__(self) -> None:
        super().__init__()
        self.second = _block(4, SECOND)
        self.fourth = _block(SECOND, FOURTH)
        self.eighth = _block(FOURTH, EIGHTH)

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        second = self.second(pictures)
        fourth = self.fourth(second)
        return _unit(second), _unit(fourth), _unit(self.eighth(fourth))


class _Search(nn.Module):
    """All disparities, at an eighth of the size: [B, 1, h, w] in px of its own, and what goes on."""

    def __init__(self) -> None:
        super().__init__()
        self.mix = nn.Sequential(
            _conv(SHIFTS + EIGHTH, 48), _conv(48, 48, dilation=2), _conv(48, 48, dilation=4), _conv(48, 48)
        )
        self.score = _silent(nn.Conv2d(48, SHIFTS, 3, padding=1))
        self.hidden = nn.Conv2d(48, EIGHTH, 1)
        self.sharpness = nn.Parameter(torch.tensor(SHARPNESS))

    def forward(self, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
        alike = _likeness(left, functional.pad(right, (SHIFTS - 1, 0, 0, 0)), SHIFTS)
        mixed = self.mix(torch.cat([alike, left], 1))
        chances = _chances(self.sharpness * alike + self.score(mixed))
        return _expected(chances, 0), torch.relu(self.hidden(mixed))


class _Refinement(nn.Module):
    """A disparity of half the size, made finer: what it leads to in the right picture is searched nearby."""

    def __init__(self, channels: int, before: int, width: int, reach: int) -> None:
        super().__init__()
        self._reach = reach
        self.mix = nn.Sequential(
            _conv(2 * reach + 1 + channels + before + 1, width), _conv(width, width, dilation=2)
        )
        self.score = _silent(nn.Conv2d(width, 2 * reach + 1, 3, padding=1))
        self.hidden = nn.Conv2d(width, HIDDEN, 1)
        self.sharpness = nn.Parameter(torch.tensor(SHARPNESS))

    def forward(self, left: Tensor, right: Tensor, coarse: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        begin = 2 * functional.interpolate(coarse, scale_factor=2.0, mode="bilinear", align_corners=False)
        before = functional.interpolate(before, scale_factor=2.0, mode="nearest")
        reach, count = self._reach, 2 * self._reach + 1
        alike = _likeness(left, functional.pad(_seen(right, begin), (reach, reach, 0, 0)), count)
        bumps = begin - _mean(begin, 7)
        mixed = self.mix(torch.cat([alike, left, before, bumps], 1))
        chances = _chances(self.sharpness * alike + self.score(mixed))
        return begin + _expected(chances, -reach), torch.relu(self.hidden(mixed))


def _conv(inputs: int, outputs: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    conv = nn.Conv2d(inputs, outputs, 3, stride, padding=dilation, dilation=dilation)
    return nn.Sequential(conv, nn.LeakyReLU(0.1))


def _block(inputs: int, outputs: int) -> nn.Sequential:
    """Half of the size; the last layer has no bend, so that likeness may be of either sign."""
    return nn.Sequential(_conv(inputs, outputs, stride=2), nn.Conv2d(outputs, outputs, 3, padding=1))


def _silent(conv: nn.Conv2d) -> nn.Conv2d:
    """One that says nothing yet: until it learns, likeness alone decides."""
    nn.init.zeros_(conv.weight)
    assert conv.bias is not None  # as all of them here
    nn.init.zeros_(conv.bias)
    return conv


def _unit(features: Tensor) -> Tensor:
    """Centred, and of mean square 1 over the channels: their mean product is a likeness of -1..1."""
    features = features - features.mean((2, 3), keepdim=True)
    return features * torch.rsqrt((features * features).mean(1, keepdim=True) + 1e-6)


def _likeness(left: Tensor, right: Tensor, count: int) -> Tensor:
    """[B, count, h, w]: the mean product of features; the k-th with what lies k px to the left of the last.

    Args:
        right: `count` - 1 px wider than `left`.
    """
    width = left.shape[3]
    starts = range(count - 1, -1, -1)
    return torch.cat([(left * right[..., k : k + width]).mean(1, keepdim=True) for k in starts], 1)


def _chances(scores: Tensor) -> Tensor:
    """Shares of their sum over the second axis: a softmax that ONNX Runtime is quick at."""
    chances = torch.exp(scores.clamp(-40, 40))
    return chances / chances.sum(1, keepdim=True)


def _expected(chances: Tensor, first: int) -> Tensor:
    """The mean [B, 1, h, w] of first, first + 1, ... with these chances [B, n, h, w]."""
    values = torch.arange(first, first + chances.shape[1], dtype=chances.dtype, device=chances.device)
    return (chances * values[:, None, None]).sum(1, keepdim=True)


def _seen(right: Tensor, disparity: Tensor) -> Tensor:
    """The right picture [B, C, h, w] where each left pixel is matched to; its edges are repeated. In ONNX
    Runtime this takes a tenth of the time of `grid_sample`."""
    width = right.shape[3]
    columns = torch.arange(width, dtype=right.dtype, device=right.device)
    place = (columns - disparity).clamp(0, width - 1)
    before = place.floor().clamp(max=width - 2)
    index = before.long().expand(-1, right.shape[1], -1, -1)
    one, next_one = right.gather(3, index), right.gather(3, index + 1)
    return one + (place - before) * (next_one - one)


def _scaled(pictures: Tensor) -> Tensor:
    """Zero mean and unit contrast: the eyes' exposures differ."""
    gray = pictures.mean((1, 2, 3), keepdim=True)
    contrast = ((pictures - gray) ** 2).mean((1, 2, 3), keepdim=True)
    return (pictures - gray) * torch.rsqrt(contrast + NOISE**2)


def evened(pictures: Tensor) -> Tensor:
    """Gray [B, 1, h, w] of even brightness and contrast everywhere."""
    weights = torch.tensor(GRAY, dtype=pictures.dtype, device=pictures.device)[:, None, None]
    gray = (pictures * weights).sum(1, keepdim=True)
    detail = gray - _mean(gray, EVEN_WINDOW)
    return (detail * torch.rsqrt(_mean(detail * detail, EVEN_WINDOW) + NOISE**2)).clamp(-3, 3)


def _slope(picture: Tensor) -> Tensor:
    """Change per px to the right."""
    wide = functional.pad(picture, (1, 1, 0, 0), mode="replicate")
    return (wide[..., 2:] - wide[..., :-2]) / 2


def _mean(picture: Tensor, window: int) -> Tensor:
    """Of square windows, px; of those at an edge the part inside."""
    half = window // 2
    along = functional.avg_pool2d(picture, (1, window), 1, (0, half), count_include_pad=False)
    return functional.avg_pool2d(along, (window, 1), 1, (half, 0), count_include_pad=False)


def _upsampled(disparity: Tensor, scores: Tensor) -> Tensor:
    """Twice the size: each pixel is a mean of the 3x3 coarse ones around, by scores [B, 9 * 4, h, w]."""
    count, _, height, width = disparity.shape
    wide = functional.pad(2 * disparity, (1, 1, 1, 1), mode="replicate")
    around = [wide[:, :, j : j + height, i : i + width] for j in range(3) for i in range(3)]
    weights = _chances(scores.view(count, 9, 4, height, width))
    return functional.pixel_shuffle((weights * torch.stack(around, 1)).sum(1), 2)


def fit(
    left: Tensor, right: Tensor, disparity: Tensor, weight: Tensor, doubt: Tensor, edge: Tensor
) -> list[Tensor]:
    """Disparities [B, 1, h, w] that follow each other, ever nearer to what makes the pictures alike.

    Args:
        left, right: [B, 1, h, w] as `evened` gives them.
        weight: [B, 1, h, w] how far to trust each pixel, 0..1.
        doubt: [B, 1, h, w] how much contrast it takes to leave the guess.
        edge: [B, 1, h, w] how much the disparity must vary in a window (px squared) not to be smoothed.
    """
    one, other = torch.cat([left, _slope(left)], 1), torch.cat([right, _slope(right)], 1)
    found = [disparity]
    for _ in range(STEPS):
        found.append(_smoothed(_step(one, other, found[-1], weight, doubt), weight, edge))
    return found[1:]


def _step(left: Tensor, right: Tensor, disparity: Tensor, weight: Tensor, doubt: Tensor) -> Tensor:
    """A Gauss-Newton step over windows of pixels; the pictures [B, 2, h, w] are gray and their slope."""
    seen = _seen(right, disparity)
    off = left[:, :1] - seen[:, :1]
    slope = (left[:, 1:] + seen[:, 1:]) / 2
    columns = torch.arange(disparity.shape[3], dtype=disparity.dtype, device=disparity.device)
    trusted = weight * (columns >= disparity).to(disparity.dtype) / (1 + off * off)
    down, up = _mean(trusted * slope * off, WINDOW), _mean(trusted * slope * slope, WINDOW)
    return disparity - (down / (up + doubt)).clamp(-LARGEST_STEP, LARGEST_STEP)


def _smoothed(disparity: Tensor, weight: Tensor, edge: Tensor) -> Tensor:
    """By the guided filter (He et al., PAMI 2013), itself the guide: no step sees what is smaller than its
    window."""
    weight = weight + 0.02  # nothing is left without a mean
    whole = _mean(weight, WINDOW)
    mean = _mean(weight * disparity, WINDOW) / whole
    spread = torch.relu(_mean(weight * disparity * disparity, WINDOW) / whole - mean * mean)
    kept = spread / (spread + edge)
    return _mean(kept, WINDOW) * disparity + _mean((1 - kept) * mean, WINDOW)
