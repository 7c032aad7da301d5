"""The test whether a mesh defines an inside by the directions of its faces.

A mesh is consistent if edges of two faces agree, none of the boundary has more than one face, and
every part that vertices connect, its holes closed, encloses a volume with its faces outward.
"""

from __future__ import annotations

import numpy as np

from voxtool.mesh.mesh import Mesh
from voxtool.mesh.parts import find_parts
from voxtool.mesh.shells import FLAT
from voxtool.mesh.topology import edge_keys, net_faces, sides_of
from voxtool.morton import among, distinct
from voxtool.opencl import Device
from voxtool.spatial.bvh import Frame
from voxtool.svo.voxelization.fill.caps import Boundary, find_boundary

LARGEST = 1000  # exponent of an extent: volumes are computed in local coordinates


def consistent(mesh: Mesh, boundary: Boundary, device: Device) -> bool:
    """Return whether a mesh defines an inside by the directions of its faces."""
    if not agree(boundary) or _fins(mesh, boundary):
        return False
    volumes, flat = _volumes(mesh, boundary, device)
    return bool((volumes > flat).all())


def encloses(mesh: Mesh, device: Device) -> bool:
    """Return whether edges agree and every part encloses a volume, or is a cavity."""
    boundary = find_boundary(mesh, net_faces(mesh))
    volumes, flat = _volumes(mesh, boundary, device)
    return agree(boundary) and bool((np.abs(volumes) > flat).all())


def _volumes(mesh: Mesh, boundary: Boundary, device: Device) -> tuple[np.ndarray, np.ndarray]:
    """Return the volume of each part, its holes closed, and that up to which it is flat."""
    points = Frame.of(mesh, LARGEST).local(mesh.vertices)
    parts = find_parts(mesh, points, boundary.edges, device)
    side = (parts.high - parts.low).max(axis=1, initial=0)
    return parts.volumes, FLAT * side * side * side


def agree(boundary: Boundary) -> bool:
    """Return whether no edge is traversed twice or more in one direction than in the other."""
    edges = boundary.edges
    return not (edges[1:] == edges[:-1]).all(axis=1).any()


def _fins(mesh: Mesh, boundary: Boundary) -> bool:
    """Return whether an edge of the boundary has more than one face."""
    on_boundary = np.zeros(len(mesh.vertices), bool)
    places = mesh.positions[boundary.edges]
    on_boundary[places] = True
    corners = mesh.positions[mesh.faces]
    near = np.count_nonzero(on_boundary[corners], axis=1) > 1
    sides, _ = edge_keys(*sides_of(corners[near]))
    edges = distinct(edge_keys(*places.T)[0])
    return int(np.count_nonzero(among(edges, sides))) > len(places)
