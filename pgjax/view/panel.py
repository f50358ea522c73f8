"""The panel beside the picture: playing, progress, materials, and what the scene is."""

from collections.abc import Callable, Mapping
from typing import Any, final

from pgjax.view.player import Player
from pgjax.view.reel import Reel
from pgjax.view.scene import Place, label
from pgjax.view.show import Show


@final
class Panel:
    """The controls. What is done with them is posted, and done by the one who asks.

    Args:
        gui: of the server.
        show: what is shown.
        texts: the values that can be edited, as they are written; empty for what is not simulated.
        post: takes what is to be done, a function of no arguments.
        app: with the `player`, and with `toggle`, `seek` and `restart`.
    """

    def __init__(
        self,
        gui: Any,
        show: Show,
        texts: Mapping[Place, str],
        post: Callable[[Callable[[], None]], None],
        app: Any,
    ):
        self._gui = gui
        self._post = post
        self._app = app
        gui.set_panel_label(show.name)
        with gui.add_folder("Frames", visible=show.count > 1):
            self._playing(show)
        with gui.add_folder("Simulation" if texts else "Progress"):
            self._progress = gui.add_progress_bar(0)
            self._status = gui.add_markdown("")
        self._materials: dict[int, Any] = {}
        self._fields: dict[Place, Any] = {}
        self._complaint: Any = None
        if texts:
            self._editing(texts)
        with gui.add_folder("Scene", expand_by_default=False):
            self._facts = gui.add_markdown("")
        self.describe(show)

    def _playing(self, show: Show) -> None:
        gui, app = self._gui, self._app
        self._button = gui.add_button("Pause")
        self._button.on_click(lambda _: self._post(app.toggle))
        last = max(show.count - 1, 1)
        self._slider = gui.add_slider("frame", min=0, max=last, step=1, initial_value=0)
        self._on_change(self._slider, lambda value: app.seek(int(value)))
        self._time = gui.add_markdown("")
        loops = gui.add_checkbox("loop", initial_value=True)
        self._on_change(loops, lambda value: setattr(app.player, "loops", bool(value)))
        fps = gui.add_number("frames per second", initial_value=show.fps, min=0.1, max=240.0)
        self._on_change(fps, lambda value: setattr(app.player, "fps", float(value)))

    def _on_change(self, handle: Any, act: Callable[[Any], None]) -> None:
        """Act when someone in a browser changes a value; what is set from here does not count."""

        def changed(event: Any) -> None:
            if event.client is not None:
                value = event.target.value
                self._post(lambda: act(value))

        handle.on_update(changed)

    def _editing(self, texts: Mapping[Place, str]) -> None:
        gui = self._gui
        for index in sorted({int(place[1]) for place in texts}):
            with gui.add_folder(f"Material {index + 1}"):
                self._materials[index] = gui.add_markdown("")
                for place, text in texts.items():
                    if place[1] == index:
                        self._fields[place] = gui.add_text(label(place), text)
        button = gui.add_button("Restart with these values")
        button.on_click(lambda _: self._post(self._app.restart))
        self._complaint = gui.add_markdown("")

    def texts(self) -> dict[Place, str]:
        """The values as they stand in the panel."""
        return {place: field.value.strip() for place, field in self._fields.items()}

    def write(self, texts: Mapping[Place, str]) -> None:
        """Put values into the panel."""
        for place, text in texts.items():
            self._fields[place].value = text

    def complain(self, message: str) -> None:
        """Say what is wrong with the values; nothing if it is empty."""
        if self._complaint is not None:
            _set(self._complaint, "content", f"**Not restarted.** {message}" if message else "")

    @property
    def complaint(self) -> str:
        """What is said to be wrong with the values."""
        return "" if self._complaint is None else self._complaint.content

    @property
    def status(self) -> str:
        """What is said of the simulation."""
        return self._status.content

    def describe(self, show: Show) -> None:
        """Say what is shown."""
        for index, heading in self._materials.items():
            _set(heading, "content", show.materials[index])
        self._facts.content = "\n\n".join(f"**{name}** {text}" for name, text in show.facts)

    def update(self, player: Player, reel: Reel) -> None:
        """Say where we are."""
        made, count = len(reel.frames), reel.show.count
        _set(self._button, "label", "Pause" if player.is_playing else "Play")
        _set(self._slider, "value", min(player.frame, max(count - 1, 1)))
        seconds = player.frame / reel.show.fps
        _set(self._time, "content", f"frame {player.frame} of {count - 1}, {seconds:.3f} s")
        _set(self._progress, "value", round(100 * made / count, 1))
        _set(self._status, "content", reel.status())


def _set(handle: Any, name: str, value: Any) -> None:
    """Set what differs: each setting is a message to the browser."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)
