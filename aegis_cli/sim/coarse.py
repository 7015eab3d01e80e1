"""Meshes with no more detail than a small picture shows, which are drawn several times faster."""

from __future__ import annotations

import copy

import numpy as np

from aegis_cli.common import gl

gl.choose_backend()

import mujoco  # noqa: E402  (the backend is chosen when MuJoCo is imported)


def coarse(model: mujoco.MjModel, cell_m: float, least_faces: int) -> mujoco.MjModel:
    """A copy of the model to draw from: of vertices that share a cell, one stands for all.

    Faces that become lines or points, or one another, are left out. So a mesh's surface moves by at
    most a cell's diagonal. Nothing is to be simulated with the copy.

    Args:
        cell_m: side of the cubes that vertices are gathered in, in metres.
        least_faces: meshes of fewer faces are left as they are.
    """
    model = copy.copy(model)  # of its arrays too, which are written to below
    for mesh in np.flatnonzero(model.mesh_facenum >= least_faces):
        start, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
        faces = _gathered(vertices, cell_m)[model.mesh_face[start : start + count]]
        kept = _distinct(faces)
        # The faces that are kept move to the front of the mesh's own rows; the rest is not drawn.
        rows = slice(start, start + len(kept))
        model.mesh_face[rows] = faces[kept]
        for corners in (model.mesh_facenormal, model.mesh_facetexcoord):
            corners[rows] = corners[start + kept]
        model.mesh_facenum[mesh] = len(kept)
    return model


def _gathered(vertices: np.ndarray, cell_m: float) -> np.ndarray:
    """For each vertex [V, 3] the number [V] of the first one in its cell."""
    cells = np.floor(vertices / cell_m).astype(np.int64)
    _, first, cell_of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    return first[cell_of.reshape(-1)]


def _distinct(faces: np.ndarray) -> np.ndarray:
    """The numbers of the faces [F, 3] that have three corners, each triple of them once."""
    ordered = np.sort(faces, axis=1)
    proper = np.flatnonzero((np.diff(ordered, axis=1) > 0).all(1))
    _, first = np.unique(ordered[proper], axis=0, return_index=True)
    return np.sort(proper[first])
