"""A target measured by a camera: places, edge gain and sizes of its rings, with the covariance of all of it.

The frame of a measured target is the one in which its places fit the nominal ones best. Views tell no scale: it is that
of the nominal places, too, by definition, or follows from a distance between two of them that was measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from torchpose import pnp
from torchpose.calibration.bundle import adjust
from torchpose.calibration.intrinsics import MIN_POINTS, Calibration, common_sigma, name_of, redundancy
from torchpose.calibration.plate import Plate, free_plate
from torchpose.calibration.views import Views
from torchpose.camera import Camera
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.geometry.segments import segment_mean
from torchpose.grids import Grid
from torchpose.target import Target

_LEAST_VIEWS = 3  # of a marker: two give a place, without anything to check it by
_POOR = 1e-3  # deviation of a place over the extent of the plate, above which it is called poorly known
_OFTEN = 0.15  # share of a marker's points left out, from which on chance is no explanation
_ODD = 0.3  # residual without a marker over that with it, below which this marker alone contradicts a view
_SCALE = 2.0  # of a measured distance to the nominal one (convention): beyond, ids or units are others
_SHOWN = 3  # names in a sentence
_FEWEST, _MOST_TRIED = 5, 24  # markers of a plate of which one may be left out to see what the others say, and be tried
_BENT = 2.0  # residual of a view over the median of all, above which it is named


@dataclass(frozen=True)
class Distance:
    """Between the centres of two markers, by their ids, in mm, with its standard deviation."""

    first: int
    second: int
    length: float
    sigma: float = 0.0

    def check(self, target: Target | Grid) -> None:
        """Raises ConfigError where the target has no such markers, or the numbers are none."""
        name, centers = target.name, target.points if isinstance(target, Grid) else target.centers
        known = list(range(len(centers))) if isinstance(target, Grid) else target.ids.tolist()
        for marker in (self.first, self.second):
            if marker not in known:
                raise ConfigError(f"--distance: target {name} has no marker {marker}; its ids are {known}")
        if self.first == self.second or not 0 < self.length < math.inf or not 0 <= self.sigma < self.length:
            raise ConfigError(
                "--distance: give two different markers, a length above 0 mm and a deviation from 0 mm, below that"
            )
        ends = [centers[known.index(marker)] for marker in (self.first, self.second)]
        nominal = float((ends[0] - ends[1]).norm())
        if not 1 / _SCALE < self.length / nominal < _SCALE:
            raise ConfigError(
                f"--distance: markers {self.first} and {self.second} of target {name} are {nominal:.6g} mm "
                f"apart, not {self.length:.6g}; give their distance in mm, or correct the target file"
            )


def scaled_by_distance(calibration: Calibration, distance: Distance) -> Calibration:
    """The calibration with its places, and poses, scaled so that a distance between two of them is as measured."""
    plate = calibration.plate
    assert plate is not None  # what was measured
    ends = plate.index(plate.ids.new_tensor([distance.first, distance.second]))
    places = plate.at(calibration.bundle.plate).places[ends]
    between = places[0] - places[1]
    length = between.norm()
    by_unknown = -(between / length.square()) @ (plate.places[ends[0]] - plate.places[ends[1]])
    row = pad(by_unknown, (len(calibration.joint) - len(plate), 0))
    factor = distance.length / float(length)
    return _scaled(calibration, factor, row)


def scale_sigma(target: Target, distance: Distance | None) -> float:
    """Relative standard deviation of the scale: of the distance, or of the mean of the nominal distances."""
    if distance is not None:
        return distance.sigma / distance.length
    if target.covariance is None:
        return 0.0
    arm = (target.centers - target.centers.mean(0)).flatten()
    return float((arm @ target.covariance[:-1, :-1] @ arm).clamp_min(0).sqrt() / arm.square().sum())


def _scaled(calibration: Calibration, factor: float, row: Float[Tensor, " u"]) -> Calibration:
    """Places scaled about their middle, with the scale as one more unknown of the plate.

    What a deviation of the measured distance does is not in it: places and radii share that (`scale_sigma`).

    Args:
        row: how the relative change of scale follows the unknowns that there are.
    """
    plate, bundle = calibration.plate, calibration.bundle
    assert plate is not None  # what was measured
    layout = plate.at(bundle.plate)
    middle = layout.places.mean(0)
    arm = factor * (layout.places - middle)

    def about(places: Tensor) -> Tensor:
        return middle + factor * (places - middle)

    wider = replace(
        plate,
        nominal=about(plate.nominal),
        places=torch.cat([factor * plate.places, arm[..., None]], -1),
        gain=pad(plate.gain, (0, 1)),
        larger=plate.larger + math.log(factor),
        sizes=pad(plate.sizes, (0, 1), value=1.0),
        turns=pad(plate.turns, (0, 1)),
        known=pad(plate.known, (0, 1)),
    )
    to_scale = torch.cat([torch.eye(len(row)).to(row), row[None]])
    joint = to_scale @ calibration.joint @ to_scale.mT
    turned = bundle.R @ middle
    t = factor * bundle.t + (factor - 1) * turned
    units = torch.cat([torch.full((3,), factor), torch.ones(3)]).to(t)
    by_scale = pad(t + turned, (0, 3))[..., None]
    poses = replace(
        bundle,
        t=t,
        plate=pad(bundle.plate, (0, 1)),
        information=pad(bundle.information, (0, 1, 0, 1)),  # views tell nothing of it
        pose_covariance=units[:, None] * bundle.pose_covariance * units,
        gain=torch.cat([units[:, None] * bundle.gain, by_scale], -1),
    )
    return replace(calibration, plate=wider, bundle=poses, joint=joint)


def measured_target(calibration: Calibration, target: Target) -> tuple[Target, Camera]:
    """The target as measured, and the camera, each with its covariance; both know of their common adjustment.

    Args:
        calibration: with all markers of the target in its plate.
        target: that the rings were measured with: its radii and edge gain are what the calibration's count from.
    """
    plate, n = calibration.plate, len(calibration.covariance)
    assert plate is not None  # what was measured
    measured = measured_plate(plate, calibration.bundle.plate, calibration.joint[n:, n:], target)
    cross = _rows(plate, target) @ calibration.joint[n:, :n]
    name = name_of(calibration.joint, plate.at(calibration.bundle.plate).places)
    measured = replace(measured, adjustment=name, cross_covariance=cross)
    return measured, replace(calibration.camera, adjustment=name)


def measured_plate(plate: Plate, z: Tensor, covariance: Float[Tensor, "k k"], target: Target) -> Target:
    """The target with what was found of its plate, z (k,) with a covariance; arguments as of `measured_target`."""
    layout, order, rows = plate.at(z), plate.index(target.ids), _rows(plate, target)
    whole = rows @ covariance @ rows.mT
    # files hold the deviation of the gain, not what it shares with the places, which is next to nothing
    whole[-1, :-1] = whole[:-1, -1] = 0.0
    return replace(
        target,
        centers=layout.places[order],
        normals=(rotations.exp(layout.turns[order]) @ target.normals[..., None]).squeeze(-1),
        radii=target.radii * layout.sizes[order, None].exp(),
        edge_gain=target.edge_gain + float(layout.gain),
        covariance=0.5 * (whole + whole.mT),
        adjustment=None,
        cross_covariance=None,
    )


def _rows(plate: Plate, target: Target) -> Tensor:
    """How places, marker by marker, and the edge gain of a target follow the unknowns of its plate."""
    return torch.cat([plate.places[plate.index(target.ids)].flatten(0, 1), plate.gain[None]])


def check_seen(views: Views, target: Target) -> None:
    """Raises ConfigError where a marker is in too few views to have a place in three dimensions."""
    counts = (views.point[:, None] == target.ids).sum(0)
    if bool((counts < _LEAST_VIEWS).any()):
        few = ", ".join(map(str, target.ids[counts < _LEAST_VIEWS].tolist()))
        raise ConfigError(
            f"INPUT: marker {few} of target {target.name} is in fewer than {_LEAST_VIEWS} views; add views that show it"
        )


def of_seen(target: Target, views: Views) -> Target:
    """The board without the marks that are in too few views, in turn."""
    counts = (views.point[:, None] == target.ids).sum(0)
    kept = counts >= _LEAST_VIEWS
    return target if bool(kept.all()) else target.of_markers(kept)


def doubts(calibration: Calibration, target: Target) -> list[str]:
    """What makes a measured target doubtful, one sentence each."""
    plate, n = calibration.plate, len(calibration.covariance)
    assert plate is not None  # what was measured
    poor = poorly_known(plate, calibration.bundle.plate, calibration.joint[n:, n:], target)
    return [*poor, *(_left_out(calibration) or _moved(calibration) or _bent(calibration))]


def poorly_known(plate: Plate, z: Tensor, of_plate: Float[Tensor, "k k"], target: Target) -> list[str]:
    """Places that the views tell worse than they should; arguments as of `measured_plate`."""
    sigma = (plate.places @ of_plate * plate.places).sum(-1).clamp_min(0).sqrt()  # (M, 3)
    stated = torch.full_like(sigma, torch.inf)
    if target.covariance is not None:
        stated = target.covariance.diagonal()[:-1].sqrt().view(-1, 3)[target_order(plate, target)]
    places = plate.at(z).places
    extent = float((places - places.mean(0)).norm(dim=-1).max())
    worst, axis = divmod(int(sigma.argmax()), 3)
    found = []
    if float(sigma.max()) > _POOR * extent:
        found.append(
            f"marker {int(plate.ids[worst])} is known to {float(sigma.max()):.2g} mm along {'xyz'[axis]} only; the "
            "views are too alike: add views tilted by 20 to 45 degrees in different directions"
        )
    if bool((sigma > stated).all(-1).any()):
        found.append("the file states places better than these views tell them; take more views, or keep the file")
    return found


def target_order(plate: Plate, target: Target) -> Tensor:
    """Which of the target's markers each of the plate's points (M,) is."""
    return (plate.ids[:, None] == target.ids).long().argmax(1)


def _left_out(calibration: Calibration) -> list[str]:
    """Markers of which more points were left out than chance would, and views of which most were."""
    seen, used = calibration.seen, calibration.views
    if seen is None:
        return []
    dropped = torch.tensor([name not in used.names for name in seen.names]) & (seen.counts >= MIN_POINTS)
    odd = _odd_ones(seen.of_views(dropped), calibration)
    kept = {(used.names[v], p) for v, p in zip(used.view.tolist(), used.point.tolist(), strict=True)}
    every = [(seen.names[v], p) for v, p in zip(seen.view.tolist(), seen.point.tolist(), strict=True)]
    out = [one for one in every if one[0] in used.names and one not in kept] + odd
    found = []
    for marker in sorted({p for _, p in out}):
        frames = sorted(name for name, p in out if p == marker)
        if len(frames) >= max(_LEAST_VIEWS, _OFTEN * int((seen.point == marker).sum())):
            found.append(_elsewhere(marker, frames))
    rest = [name for name, out in zip(seen.names, dropped.tolist(), strict=True) if out]
    rest = [name for name in rest if name not in {name for name, _ in odd}]
    if rest:
        names = ", ".join(rest[:_SHOWN]) + (" and others" if len(rest) > _SHOWN else "")
        found.append(
            f"{len(rest)} views ({names}) contradict the places that the others tell: the plate had another shape"
        )
    return found


def _odd_ones(views: Views, calibration: Calibration) -> list[tuple[str, int]]:
    """Views that one marker alone keeps from having a pose, with this marker."""
    plate = calibration.plate
    assert plate is not None  # what was measured
    views = views.of_views(views.counts >= _FEWEST)
    if not len(views):
        return []
    places = plate.at(calibration.bundle.plate).places[plate.index(views.point)]
    points, pixels, mask = replace(views, points=places).padded()
    n, m = mask.shape
    ids = torch.zeros(n, m, dtype=torch.int64)
    ids[mask] = views.point[torch.argsort(views.view, stable=True)]
    # every row anew without each of its points, and last with all of them
    without = torch.cat([torch.eye(m, dtype=torch.bool), torch.zeros(1, m, dtype=torch.bool)])
    use = (mask[:, None] & ~without).flatten(0, 1)
    points, pixels = (x[:, None].expand(n, m + 1, m, -1).flatten(0, 1) for x in (points, pixels))
    pose = pnp.solve(points, pixels, calibration.camera, mask=use)
    error = pixels - calibration.camera.project(points @ pose.R.mT + pose.t[:, None])
    freedom = (2 * use.sum(-1) - 6).clamp_min(1)
    rms = (torch.where(use, error.square().sum(-1), 0.0).sum(-1) / freedom).sqrt().nan_to_num(nan=torch.inf)
    least, which = torch.where(mask, rms.view(n, m + 1)[:, :m], torch.inf).min(-1)
    odd = least < _ODD * rms.view(n, m + 1)[:, m]
    return [(views.names[k], int(ids[k, which[k]])) for k in odd.nonzero()[:, 0].tolist()]


def _elsewhere(marker: int, frames: list[str]) -> str:
    names = ", ".join(frames[:_SHOWN]) + (" and others" if len(frames) > _SHOWN else "")
    return f"marker {marker} is elsewhere in {len(frames)} views ({names}): it moved, or is damaged"


def _moved(calibration: Calibration) -> list[str]:
    """The marker without which the residuals are those of noise, where they are not with it."""
    plate, views, bundle = calibration.plate, calibration.views, calibration.bundle
    own = float(views.covariance.diagonal(dim1=-2, dim2=-1).mean().sqrt())
    assert plate is not None  # what was measured
    if calibration.common_sigma_px < own or not _FEWEST <= len(plate.ids) <= _MOST_TRIED:
        return []
    nominal = plate.at(bundle.plate).places
    for place, marker in enumerate(plate.ids.tolist()):
        others = replace(views, rims=None)[views.point != marker]
        enough = others.counts > _FEWEST - 2
        keep = torch.arange(len(plate.ids)) != place
        rest = others.of_views(enough)
        poses = bundle.R[enough], bundle.t[enough]
        fit = adjust(rest, calibration.camera, *poses, plate=free_plate(plate.ids[keep], nominal[keep]))
        if common_sigma(fit.residual, rest.covariance, redundancy(rest, fit)) < own:
            off = torch.where(views.point == marker, bundle.residual.norm(dim=-1), torch.nan)
            high = (off > _BENT * off.nanmedian()).nonzero()[:, 0]
            return [_elsewhere(marker, [views.names[v] for v in views.view[high].tolist()])]
    return []


def _bent(calibration: Calibration) -> list[str]:
    """Residuals beyond the noise of the frames although the places are free: the plate is not the same in all views."""
    own = float(calibration.views.covariance.diagonal(dim1=-2, dim2=-1).mean().sqrt())
    if calibration.common_sigma_px < own:
        return []
    rms = segment_mean(
        calibration.bundle.residual.square().sum(-1), calibration.views.view, len(calibration.views)
    ).sqrt()
    high = rms > _BENT * rms.median()
    names = [name for name, much in zip(calibration.views.names, high.tolist(), strict=True) if much]
    where = f", most in {', '.join(names[:_SHOWN])}" if names else ""
    return [
        f"residuals are {calibration.common_sigma_px:.2g} px beyond noise with all places free{where}: the plate "
        "changes its shape between views, or --model does not describe the lens"
    ]
