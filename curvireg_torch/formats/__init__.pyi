from .meshes import MeshWarning as MeshWarning
from .meshes import ReadMesh as ReadMesh
from .meshes import SurfaceColours as SurfaceColours
from .meshes import read_mesh as read_mesh
