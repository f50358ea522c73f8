"""The viewer: frames come in, time goes by, someone presses buttons."""

import queue
import time
from collections.abc import Callable
from typing import final

from pgjax.view.panel import Panel
from pgjax.view.player import Player
from pgjax.view.reel import Reel
from pgjax.view.scene import Live
from pgjax.view.server import Window, free_port
from pgjax.view.show import Show
from pgjax.view.splats import together

_TICK = 1 / 60


@final
class App:
    """A page that shows frames while they are made.

    All that changes anything happens in `tick`, in the thread of its caller: buttons post what is
    to be done, the background appends frames.

    Args:
        show: what is shown.
        live: the scene that can be simulated again with other values, if there is one.
        host: the address to listen on.
        port: the port; the first free one from 8080 on if None.

    Raises:
        ValueError: host or port cannot be used.
        RuntimeError: viser is not installed.
    """

    def __init__(
        self,
        show: Show,
        *,
        live: Live | None = None,
        host: str = "127.0.0.1",
        port: int | None = None,
    ):
        self._live = live
        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.window = Window(host, free_port(host, port))
        self.player = Player(show.fps)
        texts = live.texts if live is not None else {}
        self.panel = Panel(self.window.gui, show, texts, self._requests.put, self)
        self.reel = Reel(show)
        # The reel and the frame that are in the window.
        self._drawn: tuple[Reel, int] | None = None
        self._ticked = time.perf_counter()

    @property
    def url(self) -> str:
        """The address of the page."""
        return self.window.url

    def run(self) -> None:
        """Show until interrupted."""
        try:
            while True:
                self.tick()
                time.sleep(_TICK)
        finally:
            self.close()

    def tick(self) -> None:
        """Do what was asked for, and show the frame whose time it is."""
        while not self._requests.empty():
            self._requests.get()()
        now = time.perf_counter()
        self.player.advance(now - self._ticked, len(self.reel.frames), is_done=self.reel.is_done)
        self._ticked = now
        self._draw()
        self.panel.update(self.player, self.reel)

    def _draw(self) -> None:
        reel, frame = self.reel, self.player.frame
        if self._drawn == (reel, frame) or frame >= len(reel.frames):
            return
        shown = together(reel.frames[frame].moving, reel.show.still)
        if self._drawn is None or self._drawn[0] is not reel:
            self.window.begin(reel.show, shown)
        else:
            self.window.draw(shown)
        self._drawn = reel, frame

    def toggle(self) -> None:
        """Play or pause."""
        self.player.toggle(len(self.reel.frames), is_done=self.reel.is_done)

    def seek(self, frame: int) -> None:
        """Pause at a frame."""
        self.player.seek(frame, len(self.reel.frames))

    def restart(self) -> None:
        """Simulate again with the values in the panel; what is wrong with them is said there."""
        assert self._live is not None
        try:
            show = self._live.show(self.panel.texts())
        except (ValueError, RuntimeError, OSError) as error:
            self.panel.complain(str(error))
            return
        self.reel.stop()
        self.reel = Reel(show)
        self.player.frame, self.player.is_playing = 0, True
        self.panel.complain("")
        self.panel.describe(show)

    def close(self) -> None:
        """Free the port, and stop when the frame that is being made is there."""
        self.window.stop()
        self.reel.stop()
