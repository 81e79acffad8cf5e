"""Meshes of the embedded scenes: closed, facing outwards, normals as in closed form."""
from __future__ import annotations

import numpy as np
import pytest

from olpm_bench.scenes import geometry


def volume(part: geometry.Part) -> float:
    """By the divergence theorem: right only for a closed surface that faces outwards [m^3]."""
    a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def is_closed(part: geometry.Part) -> bool:
    """Every edge, by the places of its ends, is used once in each direction."""
    _, place = np.unique(np.round(part.vertices, 9), axis=0, return_inverse=True)
    faces = place.reshape(-1)[part.faces]
    edges = np.concatenate([faces[:, ends] for ends in ((0, 1), (1, 2), (2, 0))]).tolist()
    return len({*map(tuple, edges)}) == len(edges) and {(a, b) for a, b in edges} == {(b, a) for a, b in edges}


def test_cushion_is_a_box_with_round_edges():
    low, high, radius = np.array((-0.3, 0.1, 0.0)), np.array((0.4, 0.5, 1.0)), 0.1
    part = geometry.cushion(low, high, radius)
    inner = np.clip(part.vertices, low + radius, high - radius)
    assert np.allclose(part.vertices, inner + radius * part.normals)
    assert is_closed(part)
    a, b, c = high - low - 2 * radius
    exact = a * b * c + 2 * radius * (a * b + b * c + c * a) + np.pi * radius**2 * (a + b + c) + 4 / 3 * np.pi * radius**3
    assert volume(part) == pytest.approx(exact, rel=0.01)


def test_a_puffed_cushion_is_larger_and_faces_outwards():
    flat, puffed = (geometry.cushion((-0.2, -0.05, 0), (0.2, 0.05, 0.4), 0.04, puff) for puff in (0.0, 0.04))
    assert volume(puffed) > 1.2 * volume(flat)
    a, b, c = np.moveaxis(puffed.vertices[puffed.faces], 1, 0)
    assert np.all(np.einsum("ij,ij->i", np.cross(b - a, c - a), puffed.normals[puffed.faces[:, 0]]) >= -1e-12)
    assert np.allclose(np.linalg.norm(puffed.normals, axis=1), 1)


def test_normals_of_a_sheet():
    y, x = np.mgrid[-1:1:81j, -1:1:61j]
    part = geometry.sheet(np.stack([x, y, 0.3 * x**2 - 0.2 * x * y], -1))
    slope = np.stack([0.2 * y - 0.6 * x, 0.2 * x, np.ones_like(x)], -1)
    exact = slope / np.linalg.norm(slope, axis=2, keepdims=True)
    assert np.allclose(part.normals.reshape(exact.shape)[1:-1, 1:-1], exact[1:-1, 1:-1], atol=1e-3)
    assert np.allclose(part.uv.reshape(81, 61, 2)[20, 30], (0.5, 0.25))
