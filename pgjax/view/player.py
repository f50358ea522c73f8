"""Which frame is looked at, as time goes by."""

from typing import final


@final
class Player:
    """The position in a series of frames of which more may still come.

    Attributes:
        frame: the one to show.
        fps: frames per second.
        is_playing: whether time goes on.
        loops: whether the first frame follows the last.
    """

    def __init__(self, fps: float):
        self.frame = 0
        self.fps = fps
        self.is_playing = True
        self.loops = True
        self._part = 0.0

    def advance(self, seconds: float, ready: int, *, is_done: bool) -> None:
        """Let time go by.

        Args:
            seconds: since the last call.
            ready: number of frames that are there.
            is_done: whether no more will come. Before that the latest frame is waited at.
        """
        if not self.is_playing or ready == 0:
            return
        self._part += seconds * self.fps
        steps = int(self._part)
        self._part -= steps
        following = self.frame + steps
        if following < ready:
            self.frame = following
        elif not is_done:
            self.frame, self._part = ready - 1, 0.0
        elif self.loops:
            self.frame = following % ready
        else:
            self.frame, self.is_playing = ready - 1, False

    def toggle(self, ready: int, *, is_done: bool) -> None:
        """Play or pause; what has ended begins again."""
        self.is_playing = not self.is_playing
        self._part = 0.0
        if self.is_playing and is_done and self.frame >= ready - 1:
            self.frame = 0

    def seek(self, frame: int, ready: int) -> None:
        """Pause at a frame, or at the latest one there is."""
        self.is_playing = False
        self.frame = max(0, min(frame, ready - 1))
