"""Objects to simulate: triangle meshes with normals, tangents and coordinates.

All lengths are metres; objects stand on or around the world's origin, +Z up.
Normals are those of the smooth surface that the triangles stand for, tangents
its derivative dP/du.
"""

from capture_sim.objects.mesh import SurfaceMesh
from capture_sim.objects.mesh_files import finish_mesh, read_mesh
from capture_sim.objects.object_registry import make_object, object_presets
from capture_sim.objects.revolution import revolve, sweep

__all__ = [
    "SurfaceMesh",
    "finish_mesh",
    "make_object",
    "object_presets",
    "read_mesh",
    "revolve",
    "sweep",
]
