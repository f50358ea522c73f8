"""Gaussians: reading and writing them, deforming them, drawing them.

Nothing here knows the simulator: Gaussians are moved by arrays of positions and deformation
gradients.
"""

from pgjax.render.camera import Camera as Camera
from pgjax.render.cameras import load_cameras as load_cameras
from pgjax.render.gaussians import Gaussians as Gaussians
from pgjax.render.gaussians import Similarity as Similarity
from pgjax.render.gaussians import bound_stretch as bound_stretch
from pgjax.render.gaussians import concatenate as concatenate
from pgjax.render.gaussians import deform as deform
from pgjax.render.load import load_capture as load_capture
from pgjax.render.load import load_gaussians as load_gaussians
from pgjax.render.media import VideoWriter as VideoWriter
from pgjax.render.media import load_image as load_image
from pgjax.render.media import load_video as load_video
from pgjax.render.media import save_image as save_image
from pgjax.render.media import save_video as save_video
from pgjax.render.needles import AxisReport as AxisReport
from pgjax.render.needles import measure_axes as measure_axes
from pgjax.render.needles import split_long as split_long
from pgjax.render.normals import normals as normals
from pgjax.render.paths import CameraPath as CameraPath
from pgjax.render.paths import interpolate as interpolate
from pgjax.render.paths import stack_cameras as stack_cameras
from pgjax.render.ply import Capture as Capture
from pgjax.render.ply import load_ply as load_ply
from pgjax.render.ply import save_ply as save_ply
from pgjax.render.rasterize import Image as Image
from pgjax.render.rasterize import render as render
from pgjax.render.rules import RULE_3DGS as RULE_3DGS
from pgjax.render.rules import RULE_EXACT as RULE_EXACT
from pgjax.render.rules import RULE_GSPLAT15 as RULE_GSPLAT15
from pgjax.render.rules import Rule as Rule
from pgjax.render.surroundings import Surroundings as Surroundings
from pgjax.render.surroundings import prepare_surroundings as prepare_surroundings
