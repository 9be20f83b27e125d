"""A square grid of nodes, and what can be counted and measured of triangles."""

from collections import Counter

import numpy as np


def grid(count=12):
    line = np.linspace(0.0, 1.0, count)
    x, y = (axis.ravel() for axis in np.meshgrid(line, line))
    return x, y


def directed_edges(faces):
    return Counter((a, b) for f in faces.tolist() for a, b in zip(f, f[1:] + f[:1], strict=True))


def euler(faces):
    edges = {tuple(sorted(edge)) for edge in directed_edges(faces)}
    return len(np.unique(faces)) - len(edges) + len(faces)


def area(node, faces):
    a, b, c = (node[faces[:, i]] for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def volume(node, faces):
    a, b, c = (node[faces[:, i]] for i in range(3))
    return np.sum(a * np.cross(b, c)) / 6
