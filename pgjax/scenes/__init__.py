"""Scene files, presets, and the run from a scene to a video."""

from pathlib import Path

from pgjax._files import is_file, is_folder
from pgjax.scenes.build import PRESETS as PRESETS
from pgjax.scenes.build import Plan as Plan
from pgjax.scenes.build import plan as plan
from pgjax.scenes.build import presets as presets
from pgjax.scenes.reader import SceneError as SceneError
from pgjax.scenes.run import run as run
from pgjax.scenes.schema import SceneFile as SceneFile
from pgjax.scenes.schema import read_scene as read_scene
from pgjax.scenes.summary import summary as summary


def resolve(name: str) -> Path:
    """The scene file behind the name of a preset or a path."""
    preset = PRESETS / f"{name}.toml"
    if is_file(preset):
        return preset
    path = Path(name)
    if path.suffix != ".toml" and not is_file(path) and not is_folder(path):
        raise SceneError(
            f"There is no preset `{name}` (there are {', '.join(presets())}) and no such file."
        )
    return path
