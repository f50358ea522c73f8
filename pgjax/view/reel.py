"""Frames that are made in the background, ahead of what is looked at."""

import threading
from typing import final

from pgjax.view.show import Frame, Show


@final
class Reel:
    """Makes the frames of a show in a thread of its own, until the last or until it is stopped.

    Attributes:
        show: what is shown.
        frames: those that are there; more are appended.
        failure: why no more will come, if something failed.
    """

    def __init__(self, show: Show):
        self.show = show
        self.frames: list[Frame] = []
        self.failure: str | None = None
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._make, name="pgjax view", daemon=True)
        self._thread.start()

    @property
    def is_done(self) -> bool:
        """Whether no more frames will come."""
        return not self._thread.is_alive()

    def _make(self) -> None:
        try:
            for frame in self.show.frames():
                if self._stopped.is_set():
                    return
                self.frames.append(frame)
        except Exception as error:
            # Whatever it is, the one who looks is told, not a log.
            self.failure = f"{type(error).__name__}: {error}"

    def stop(self) -> None:
        """Make no more; returns when the frame that is being made is there."""
        self._stopped.set()
        self._thread.join()

    def status(self) -> str:
        """How far it is, and what went wrong, in Markdown."""
        made, last = len(self.frames), self.show.count - 1
        if self.failure is not None:
            return f"**Stopped after frame {made - 1}.** {self.failure}"
        if not made:
            return "Preparing the first frame."
        latest = self.frames[-1]
        if latest.is_lost:
            text = f"**Stopped at frame {made - 1} of {last}.**"
        elif made - 1 >= last:
            text = "All frames are there."
        else:
            text = f"Frame {made - 1} of {last} is there."
        return "\n\n".join([text, *latest.messages])
