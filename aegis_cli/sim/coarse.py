"""Meshes reduced to the detail that a small picture shows, which render several times faster."""

from __future__ import annotations

import copy

import numpy as np

from aegis_cli.common import gl

gl.choose_backend()

import mujoco  # noqa: E402  (the backend is chosen when MuJoCo is imported)


def coarse(model: mujoco.MjModel, cell_m: float, least_faces: int) -> mujoco.MjModel:
    """A copy of the model for rendering, in which vertices that share a cell are merged.

    Faces that collapse to lines or points, or become duplicates, are left out. So the surface of a
    mesh moves by at most the diagonal of a cell. The copy must not be simulated.

    Args:
        cell_m: side of the cubes in which vertices are merged, in metres.
        least_faces: meshes with fewer faces are left as they are.
    """
    model = copy.copy(model)  # includes its arrays, which are modified below
    for mesh in np.flatnonzero(model.mesh_facenum >= least_faces):
        start, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
        faces = _gathered(vertices, cell_m)[model.mesh_face[start : start + count]]
        kept = _distinct(faces)
        # The faces that are kept move to the front of the mesh's rows; the rest is not drawn.
        rows = slice(start, start + len(kept))
        model.mesh_face[rows] = faces[kept]
        for corners in (model.mesh_facenormal, model.mesh_facetexcoord):
            corners[rows] = corners[start + kept]
        model.mesh_facenum[mesh] = len(kept)
    return model


def _gathered(vertices: np.ndarray, cell_m: float) -> np.ndarray:
    """For each vertex [V, 3], the index [V] of the first one in its cell."""
    cells = np.floor(vertices / cell_m).astype(np.int64)
    _, first, cell_of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    return first[cell_of.reshape(-1)]


def _distinct(faces: np.ndarray) -> np.ndarray:
    """Indices of the faces [F, 3] with three distinct corners, without duplicates."""
    ordered = np.sort(faces, axis=1)
    proper = np.flatnonzero((np.diff(ordered, axis=1) > 0).all(1))
    _, first = np.unique(ordered[proper], axis=0, return_index=True)
    return np.sort(proper[first])
