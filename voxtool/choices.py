"""The names that a user chooses between, and the defaults: each is given here once.

Where there is a default, it is the first name, or a constant of its own, or depends on the scene.
"""

from __future__ import annotations

MIN_DIM, MAX_DIM, DEFAULT_DIM = 8, 65536, 256  # voxels along the longest side of a grid
# Those that a format of meshes defines, in nanometres.
NANOMETRES = {
    "um": 10**3,
    "mm": 10**6,
    "cm": 10**7,
    "m": 10**9,
    "in": 25_400_000,
    "ft": 304_800_000,
}
LENGTH_UNITS = tuple(NANOMETRES)
FITS = ("uniform", "stretch")  # of grids to meshes
NORMALIZED = ("unit", "sphere")  # where meshes are placed: a unit cube, a unit ball
MODES = ("surface26", "surface6", "solid")  # of voxelization
DEFAULT_MODE = "solid"
FRACTION = "fraction"  # a mode that also says how much of each voxel is inside
FRACTION_TYPES = ("f4", "u2", "u1")  # of stored fractions: float32, and whole numbers
# The faces of a voxel, at low and high x, y and z.
FACE_NAMES = ("face_x0", "face_x1", "face_y0", "face_y1", "face_z0", "face_z1")
OCTREE_MODES = (*MODES, "solid+surface26", "solid+fraction")
ATTRIBUTES = ("colour", "normal", "area")  # of the voxels of a surface
COLOURS = ("mean", "nearest")  # of a voxel: by area, or of the greatest part of the surface
FILLS = ("auto", "parity", "nonzero", "winding", "flood")  # rules that decide what is inside
NAMED = ("part", "material", "object")  # parts of meshes, which files name
LABELS = (*NAMED, "shell", "file")  # what voxels are labelled by
PRIORITIES = ("first", "last")  # of parts that share voxels
OPERATIONS = ("union", "intersection", "difference", "xor")  # on sets of voxels
MORPHOLOGY = ("dilate", "erode", "open", "close", "shell")  # operations
ELEMENTS = ("ball", "cube", "cross")  # by which voxels are dilated
NEIGHBOURS = (6, 18, 26)  # of a voxel: across faces; also across edges; and across corners
LATTICES = {"D3Q19": 19, "D3Q27": 27}  # of lattice Boltzmann methods: their links, with the rest
FLUIDS = ("unset", "set")  # which voxels are the fluid
STYLES = ("marching-cubes", "voxel-faces", "surface-nets", "sharp")  # of extracted surfaces
MARCHING_CUBES, VOXEL_FACES, SURFACE_NETS, SHARP = STYLES
DEFAULT_STYLE = SURFACE_NETS
# Names of version 0.1, which are still taken, and which digests still hold.
STYLE_ALIASES = {"smooth": MARCHING_CUBES, "blocks": VOXEL_FACES, "nets": SURFACE_NETS}
VOXEL_LEVEL = "voxel"  # of samples that are single voxels
LABEL_STYLES = (SURFACE_NETS, VOXEL_FACES)  # of meshes of labels, with common borders
DEFAULT_TOLERANCE = 1e-3  # of a distance field, in sides of its cube
# Levels of the leaves of a field, from the root on: a leaf of level 21 has a parent whose key has
# 21 bits and whose identifier has 61.
DEFAULT_MAX_LEVEL, MAX_LEVEL = 9, 21
SIGNS = ("pseudonormal", "winding", "parity", "nonzero", "none")  # how a distance's sign is found
FIELD_SIGNS = ("pseudonormal", "winding", "none")  # of fields
POINT_FILLS = (*FILLS, "none")  # what is inside, for distances; none: no distance is negative
GIVEN = "given"  # of a field whose distances were an image's, signs included
# Texels along an axis of a field's 3-D textures: every device with WebGL 2 has the fewest.
MIN_TEXTURE_3D, MAX_TEXTURE_3D, DEFAULT_TEXTURE_3D = 256, 3072, 2048
# For the leaf of a field that holds a point.
SEARCHES = ("linear", "binary", "coherent", "bottom-up")
DEFAULT_SEARCH = "binary"
SAMPLERS = ("exact", "hardware")  # what interpolates the distances of a field
EXACT, HARDWARE = SAMPLERS
LAYOUTS = ("raycast", "projection", "hexahedra")  # of the textures of a volume
MIN_TEXTURE_2D, MAX_TEXTURE_2D = 2048, 16384  # texels along an axis of a volume's textures
METHODS = ("raycast", "projection")  # of rendering volumes
VIEWS = ("front", "back", "left", "right", "top", "bottom", "iso")
WHITE = (1.0, 1.0, 1.0)  # the background of pictures
LABEL, NONE = "label", "none"
BY = (LABEL,)  # attributes whose values have a mesh each
COLOUR_BY = (LABEL, "colour", "normal", "fraction", NONE)  # attributes that give voxels colours
