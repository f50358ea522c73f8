"""The viewer: Gaussians in a browser while they are simulated (`pip install "pgjax[view]"`)."""

from pgjax.view.app import App as App
from pgjax.view.scene import Live as Live
from pgjax.view.server import free_port as free_port
from pgjax.view.server import require_viser as require_viser
from pgjax.view.show import Show as Show
from pgjax.view.show import show_capture as show_capture
from pgjax.view.show import show_run as show_run
