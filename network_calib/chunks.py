"""How the joint engine cuts its measurements: chunks of points, within a chunk by block, within a block by group.

A chunk is dense over the shared columns that it touches, so it should hold points that the same cameras see; points are
in order of time, and a walking person gives just that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from network_calib.blocks import PointBlock
from network_calib.observations import IntArray

# Cost model of one pass, in seconds: Python overhead of a chunk and of a group in it, and one multiply-add in BLAS.
_CHUNK_OVERHEAD_S, _GROUP_OVERHEAD_S, _FLOP_S = 400e-6, 40e-6, 1e-10
_SIZES = (64, 128, 256, 512, 1024, 2048)


@dataclass(frozen=True, slots=True)
class GroupRows:
    """The measurements of one group in one chunk.

    Attributes:
        rows: within the chunk's rows of the block.
        used: Jacobian columns that are free.
        targets: the chunk's columns that they belong to.
        row_of_point: (P,) for each point of the chunk its row within the chunk's rows of the block, or their number
            where the group did not see it; None when the group saw every point, in order.
    """

    rows: slice
    used: IntArray
    targets: IntArray
    row_of_point: IntArray | None


@dataclass(frozen=True, slots=True)
class BlockRows:
    """One block's measurements that belong to one chunk.

    Attributes:
        rows: within the block.
        local_point: point index within the chunk, for each row.
        groups: the rows cut by group.
    """

    rows: slice
    local_point: IntArray
    groups: tuple[GroupRows, ...]


@dataclass(frozen=True, slots=True)
class Chunk:
    """A run of points with the shared columns they touch; `blocks` has one entry for each block of the problem."""

    points: slice
    columns: IntArray
    blocks: list[BlockRows] = field(default_factory=list)

    @property
    def n_points(self) -> int:
        return self.points.stop - self.points.start


def cut(blocks: Sequence[PointBlock], n_points: int) -> tuple[list[PointBlock], list[Chunk]]:
    """The blocks with their measurements sorted by chunk, group and point, and the chunks."""
    size = _choose_size(blocks, n_points)
    n_chunks = -(-n_points // size)
    ordered = [block.take(np.lexsort((block.point, block.group, block.point // size))) for block in blocks]
    edges = [np.searchsorted(block.point // size, np.arange(n_chunks + 1)) for block in ordered]
    chunks = []
    for i in range(n_chunks):
        rows = [slice(int(edge[i]), int(edge[i + 1])) for edge in edges]
        touched = [block.columns[np.unique(block.group[r])].ravel() for block, r in zip(ordered, rows, strict=True)]
        columns = np.unique(np.concatenate(touched))
        chunk = Chunk(slice(i * size, min((i + 1) * size, n_points)), columns[columns >= 0])
        chunk.blocks.extend(_cut_by_group(block, r, chunk) for block, r in zip(ordered, rows, strict=True))
        chunks.append(chunk)
    return ordered, chunks


def _choose_size(blocks: Sequence[PointBlock], n_points: int) -> int:
    """The number of points in a chunk that the cost model likes best: big for BLAS, small for sparse graphs."""
    costs = {}
    for size in _SIZES:
        n_chunks = -(-n_points // size)
        width, n_groups = np.zeros(n_chunks), 0
        for block in blocks:
            touched = np.unique(block.point // size * len(block.columns) + block.group)
            width += np.bincount(touched // len(block.columns), minlength=n_chunks) * block.columns.shape[1]
            n_groups += len(touched)
        flops = float((width**2).sum()) * 3 * size
        costs[size] = n_chunks * _CHUNK_OVERHEAD_S + n_groups * _GROUP_OVERHEAD_S + flops * _FLOP_S
    return min(costs, key=costs.__getitem__)


def _cut_by_group(block: PointBlock, rows: slice, chunk: Chunk) -> BlockRows:
    group = block.group[rows]
    local_point = block.point[rows] - chunk.points.start
    edges = [0, *(np.flatnonzero(np.diff(group)) + 1).tolist(), len(group)] if len(group) else [0]
    groups = []
    for start, stop in pairwise(edges):
        columns = block.columns[group[start]]
        used = np.flatnonzero(columns >= 0)
        if not len(used):
            continue
        targets = np.searchsorted(chunk.columns, columns[used])
        row_of_point = None
        if stop - start < chunk.n_points:
            row_of_point = np.full(chunk.n_points, len(group))
            row_of_point[local_point[start:stop]] = np.arange(start, stop)
        groups.append(GroupRows(slice(start, stop), used, targets, row_of_point))
    return BlockRows(rows, local_point, tuple(groups))
