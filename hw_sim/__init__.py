"""What surrounds the runtime: the simulated sensor and its streets, CARLA clouds."""

from .carla import read_carla
from .ground import Ground
from .lidar import Lidar, LidarConfig, Scan
from .primitives import Material, PrimitiveSet, PrimitiveSetBuilder, Shape, Surface
from .scene import SCENE_KINDS, Mover, Scene, street_scene
from .simulate import simulate_frames, simulate_parallel
from .trajectory import Trajectory

__all__ = [
    "SCENE_KINDS",
    "Ground",
    "Lidar",
    "LidarConfig",
    "Material",
    "Mover",
    "PrimitiveSet",
    "PrimitiveSetBuilder",
    "Scan",
    "Scene",
    "Shape",
    "Surface",
    "Trajectory",
    "read_carla",
    "simulate_frames",
    "simulate_parallel",
    "street_scene",
]
