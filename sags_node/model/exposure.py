"""The camera's exposure over time: one gain per channel that all colours of an image share.

An endoscope's automatic exposure follows the tissue that comes nearer; without it, every colour of the model
would have to change with every frame. Not part of SAGS; the drift is 20 % within six seconds of a real
recording.
"""

import numpy as np

from sags_node.types import F32, I64

NEUTRAL = 1e-6  # below this brightness an image says nothing of its exposure


class Exposure:
    """Gains at the times of some frames, linear in between, constant beyond."""

    def __init__(self, times_ns: I64, brightness: F32) -> None:
        """
        Args:
            times_ns: [T] ascending.
            brightness: [T, 3] mean colour of the tissue at these times.
        """
        self.times_ns = times_ns
        lit = brightness.min(axis=1) > NEUTRAL
        reference = np.exp(np.log(np.maximum(brightness[lit], NEUTRAL)).mean(axis=0)) if lit.any() else 1.0
        self.gains = np.where(lit[:, None], brightness / reference, 1.0).astype(np.float32)

    def at(self, t_ns: int) -> F32:
        """The gain [3] at one time."""
        gain = [np.interp(t_ns, self.times_ns, self.gains[:, channel]) for channel in range(3)]
        return np.array(gain, np.float32)
