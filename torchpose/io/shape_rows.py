"""Rows of the table of shapes: ellipses, segments and polygons of pictures."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.detect import Candidates, Segments, Shapes, Verdict
from torchpose.io.rows import Row, Schema, finite, table

SHAPE_SCHEMA: Schema = {
    "frame": str,
    "kind": str,
    **dict.fromkeys(("cx", "cy", "a", "b", "theta", "arc", "log10_nfa"), float),
    "polarity": int,
    "vertices": str,
    "verdict": str,
    "ring_ratio": float,
}
"""One row a shape. Ellipse: centre, semi-axes (px), direction of the major axis and extent of the visible arc (rad),
polarity +1 dark inside, -1 light inside, ring_ratio of a circle inside of it to the ellipse where there is one. Segment
and polygon: middle of the vertices, vertices as ``u v u v ...`` (px), for a segment half its length as a and its
direction, light on the left hand. verdict: accepted, or with --explain why not."""


def shape_rows(shapes: Shapes, ratios: Float[Tensor, " M"], frames: Sequence[str]) -> list[Row]:
    """Rows of `SHAPE_SCHEMA`, frame by frame: ellipses, then polygons, then segments, the surest first.

    Args:
        shapes: of a batch.
        ratios: inner to outer radius of its ellipses, NaN where there is no inner circle.
        frames: name of each frame of the batch.
    """
    ellipses = zip(shapes.ellipses.frame.tolist(), _ellipse_rows(shapes.ellipses, ratios), strict=True)
    rows = sorted([*ellipses, *_line_rows(shapes.segments)], key=lambda pair: pair[0])
    return [{"frame": frames[frame], **row} for frame, row in rows]


def _ellipse_rows(found: Candidates, ratios: Tensor) -> list[Row]:
    return table(
        kind=["ellipse"] * len(found),
        **dict(zip(("cx", "cy", "a", "b", "theta"), found.ellipse.T.tolist(), strict=True)),
        arc=[finite(2 * math.pi * cover) for cover in found.cover.tolist()],
        log10_nfa=[finite(nfa) for nfa in found.log10_nfa.tolist()],
        polarity=[int(polarity) for polarity in found.polarity.tolist()],
        verdict=[Verdict(verdict).name.lower() for verdict in found.verdict.tolist()],
        ring_ratio=[finite(ratio) for ratio in ratios.tolist()],
    )


def _line_rows(found: Segments) -> list[tuple[int, Row]]:
    single = found[found.chain < 0]
    direction = single.ends[:, 1] - single.ends[:, 0]
    half = 0.5 * torch.linalg.vector_norm(direction, dim=-1)
    theta = torch.atan2(direction[:, 1], direction[:, 0])
    rows: list[tuple[int, Row]] = []
    for chain in torch.unique(found.chain[found.chain >= 0]).tolist():
        sides = found[found.chain == chain]
        sides = sides[torch.argsort(sides.place)]
        # corners lie between the end of one side and the start of the next
        inner = 0.5 * (sides.ends[:-1, 1] + sides.ends[1:, 0])
        corners = torch.cat([sides.ends[:1, 0], inner, sides.ends[-1:, 1]])
        rows.append((int(sides.frame[0]), _line("polygon", corners, float(sides.chain_log10_nfa[0]))))
    for frame, ends, nfa, a, angle in zip(
        single.frame.tolist(), single.ends, single.log10_nfa.tolist(), half.tolist(), theta.tolist(), strict=True
    ):
        rows.append((frame, _line("segment", ends, nfa) | {"a": a, "theta": angle}))
    return rows


def _line(kind: str, vertices: Tensor, nfa: float) -> Row:
    cx, cy = vertices.mean(0).tolist()
    text = " ".join(f"{value:.3f}" for value in vertices.flatten().tolist())
    return {"kind": kind, "cx": cx, "cy": cy, "log10_nfa": nfa, "vertices": text, "verdict": "accepted"}
