"""Something on a robot's camera, such as a part of the robot that comes into the picture: its latents show it too.

As long as the robot does not notice it, what is registered of these keyframes is wrong, and nothing tells it from what
is right. With the first keyframe after it noticed, the latents before are made anew and their keyframes withdrawn
(`core/withdrawals.py`), as `perception/watch/camera_watch.py` does it.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import KeyframeLook
from flocc_agent.perception.synthetic import moved_latent
from flocc_protocol.ids import KeyframeId, LogId

Mask = NDArray[np.bool_]

OFF_M = 1.0
"""So far from where it was a keyframe seems to be, by what its latent shows."""
HIDDEN = np.ones((1, 1), np.bool_)


@dataclass(slots=True)
class Overlay:
    """What is on one robot's camera.

    Attributes:
        is_there: The pictures show it, and the robot does not know.
        shown: Keyframes whose latents showed it, when they were encoded.
    """

    is_there: bool = False
    shown: set[KeyframeId] = field(default_factory=set)
    _unnoticed: set[LogId] = field(default_factory=set)
    _clean: dict[bytes, bytes] = field(default_factory=dict)

    def look(self, keyframe: KeyframeId, looked: KeyframeLook) -> KeyframeLook:
        """What became of a keyframe's image with this on the camera; the first one without it withdraws all before."""
        if self.is_there and looked.latent is not None:
            self.shown.add(keyframe)
            self._unnoticed.add(keyframe.log)
            spoilt = moved_latent(looked.latent, OFF_M)
            self._clean[spoilt] = looked.latent
            return replace(looked, latent=spoilt)
        if keyframe.log not in self._unnoticed:
            return looked
        self._unnoticed.discard(keyframe.log)
        return replace(looked, hidden=HIDDEN, withdrawn=keyframe.index)

    def without(self, latent: bytes, hidden: Mask) -> bytes:  # noqa: ARG002 - as perception's own does
        """Take it out of a latent."""
        return self._clean.get(latent, latent)
