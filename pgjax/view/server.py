"""The server behind the browser's window; the one place that imports viser."""

import importlib.util
import math
import socket
from typing import Any, final

import numpy as np

from pgjax.view.show import Show
from pgjax.view.splats import Splats, middle, unit_of

_FIRST_PORT = 8080
_LAST_PORT = 65535


def require_viser() -> None:
    """Raise a `RuntimeError` that says how to install viser, if it is not there."""
    if importlib.util.find_spec("viser") is None:
        raise RuntimeError(
            'The viewer needs viser, which is not installed: pip install "pgjax[view]".'
        )


def free_port(host: str, port: int | None) -> int:
    """The port, if it is free; the first free one from 8080 on if it is None.

    Raises:
        ValueError: the port is not a number of a port, or not free, or the host is not one of
            this machine.
    """
    if port is None:
        for candidate in range(_FIRST_PORT, _FIRST_PORT + 100):
            if _is_free(host, candidate):
                return candidate
        raise ValueError(
            f"Argument `--port` must be given, since none from {_FIRST_PORT} to "
            f"{_FIRST_PORT + 99} is free."
        )
    if not 1 <= port <= _LAST_PORT:
        raise ValueError(f"Argument `--port` must be from 1 to {_LAST_PORT}, but is {port}.")
    if not _is_free(host, port):
        raise ValueError(f"Argument `--port` must be a port that is free, but {port} is not.")
    return port


def _is_free(host: str, port: int) -> bool:
    try:
        family, *_ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        socket.create_server((host, 0), family=family).close()
    except OSError as error:
        raise ValueError(
            f"Argument `--host` must be a name or an address of this machine, but is {host!r} "
            f"({error.strerror})."
        ) from error
    try:
        socket.create_server((host, port), family=family).close()
    except OSError:
        return False
    return True


@final
class Window:
    """A page with a scene of Gaussians and a panel."""

    def __init__(self, host: str, port: int):
        require_viser()
        import viser  # pyright: ignore[reportMissingImports]

        self._server = viser.ViserServer(host=host, port=port, verbose=False)
        self._node: Any = None
        self._unit = 1.0
        self.gui: Any = self._server.gui
        name = "localhost" if host in ("0.0.0.0", "::") else host
        self.url = f"http://{f'[{name}]' if ':' in name else name}:{port}"
        self.gui.configure_theme(show_logo=False, show_share_button=False)

    def begin(self, show: Show, first: Splats) -> None:
        """Take a new show, and its first frame; a camera that was moved stays where it is."""
        color = np.rint(255 * np.clip(np.asarray(show.background), 0, 1)).astype(np.uint8)
        self._server.scene.set_background_image(np.tile(color, (4, 4, 1)), format="png")
        self._server.scene.set_up_direction(show.up)
        self._look(show, middle(first))
        if self._node is not None:
            self._node.remove()
        self._unit = unit_of(first)
        self._node = self._server.scene.add_gaussian_splats(
            "/gaussians", *self._scaled(first), scale=self._unit
        )

    def draw(self, shown: Splats) -> None:
        """Show a frame."""
        self._node.set_gaussians(*self._scaled(shown))

    @property
    def shown_anything(self) -> bool:
        """Whether there was a frame."""
        return self._node is not None

    @property
    def camera(self) -> Any:
        """Where the camera of a new page begins."""
        return self._server.initial_camera

    def shown(self) -> Splats:
        """What the browser is given, in the units of the scene."""
        node, unit = self._node, self._unit
        return Splats(unit * node.centers, unit**2 * node.covariances, node.rgbs, node.opacities)

    def stop(self) -> None:
        """Close the page and free the port."""
        self._server.stop()

    def _scaled(self, shown: Splats) -> Splats:
        centers, covariances = shown.centers / self._unit, shown.covariances / self._unit**2
        return shown._replace(centers=centers, covariances=covariances)

    def _look(self, show: Show, center: np.ndarray) -> None:
        """Where the camera begins. It turns about the point of its axis that is as far as `center`.

        The browser's camera has square pixels and its axis in the middle.
        """
        pose = np.asarray(show.camera.world_to_camera, np.float64)
        right, down, forward = pose[:3, :3]
        position = -pose[:3, :3].T @ pose[:3, 3]
        distance = max(float(forward @ (center - position)), 10 * float(show.camera.near))
        camera = self.camera
        camera.position = tuple(position)
        camera.look_at = tuple(position + distance * forward)
        # The horizon of a camera that was held at a slant is not that of the scene.
        camera.up = show.up if abs(right @ np.asarray(show.up)) < 1e-3 else tuple(-down)
        camera.fov = 2 * math.atan(show.camera.height / 2 / float(show.camera.fy))
        camera.near = min(float(show.camera.near), distance / 100)
        camera.far = 1000 * distance
