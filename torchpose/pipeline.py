"""PoseEstimator: frames in, poses out. The only file that knows the order of the stages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, replace
from functools import partial
from itertools import combinations
from os import PathLike
from typing import Any, Literal, NamedTuple, get_args

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from torchpose.camera import LINEAR, Camera, CameraRig, Tone
from torchpose.camera.model import Model
from torchpose.camera.plausible import check_intrinsics
from torchpose.detect import (
    Candidates,
    Wanted,
    find_candidates,
    find_coarse,
    merge_duplicates,
    reduction_factor,
    same_ellipses,
)
from torchpose.errors import ArgumentError, ConfigError, FrameError
from torchpose.geometry import blur as blurs
from torchpose.geometry.arguments import own_calls
from torchpose.geometry.grey import FRAME_TYPES, as_frames
from torchpose.geometry.segments import marked
from torchpose.identify import (
    MIN_MARKERS,
    Identified,
    MarkerTable,
    Scene,
    Views,
    beside_another,
    by_codes,
    confirmed,
    find_near,
    identify,
    identify_boards,
    in_company,
    indistinguishable,
    look_again,
    named,
    outlines,
)
from torchpose.kernels import find_compiler
from torchpose.kernels.memory import keep_memory
from torchpose.moments import Moments, Start, View, begin, joined, refine_moments
from torchpose.moments.outcome import Alone
from torchpose.pose import (
    Found,
    Solutions,
    best_copies,
    crossed_out,
    gather_evidence,
    outcome,
    right_way_round,
    solve_poses,
    still_open,
)
from torchpose.refine import METHODS, Recipe, Sight
from torchpose.results import Poses, Reason, Status
from torchpose.rings import (
    LARGE,
    Circles,
    Rings,
    find_circles,
    ideal_pixels,
    mapped,
    measure_circles,
    measure_exactly,
    measure_predicted,
    rough_rings,
)
from torchpose.target import Target

_LEAST_CANDIDATE = (
    3.0  # px of semi-minor axis: rings below 4 are refused (`rings.measure`); candidates of covered ones err
)
_LEGIBLE = 1.8  # px, of blur, up to which the mean profile of a ring tells its code (measured: decisions/0059)
_LAYOUT = ("ids", "centers", "normals", "radii", "valid", "polarity")  # of the table: what makes a target
Method = Literal["photometric", "edges", "centers", "paper"]
Near = Poses | tuple[Tensor, Tensor]


class _Tried(NamedTuple):
    """Blurred rings (K,) that were measured before their frames were searched at all scales.

    outer: the circles that they were measured from. exact: whether by the exact model.
    """

    outer: Candidates
    rings: Rings
    exact: Tensor


class PoseEstimator(nn.Module):
    """Poses of one or more targets in batches of frames (paper, Algorithm 1).

    Args:
        camera: intrinsics and distortion; frames must have its size. With a `CameraRig` it is a `RigEstimator`: frames
            of all cameras in, poses in the first camera out.
        target: one target or several, as `Target`, name or path; each gets a row for every frame. A board of equal
            marks that looks the same after a turn is ambiguous, unless measured places tell or it is said to be upright
            (`Target.upright`).
        instances: most copies of a target that a frame is searched for. Every further copy that has a pose adds a row;
            without it the best-supported copy counts, and `Poses.copies` says how many were seen.
        method: "photometric" refines every pose on the grey values around its rings, "edges" on all their edge points;
            "centers" stops at the pose of the centres of their ellipses; "paper" is the paper's chain: Zernike edges as
            read, centres by eq. (7), PnP.
        float_range: grey value of white in floating-point frames: 1.0 or 255.0.
        srgb: the grey values are sRGB-encoded, whatever the camera says of its tone. Frames that are not linear are
            taken back to linear ones first: edges are half-way in linear grey, so encoded frames that are taken as
            linear ones shift them (docs/precision.md).
        compile: solve small problems in compiled loops (`torchpose.kernels`), on the CPU; the first call takes seconds.
            Of one frame that saves 2 %: it pays for many poses.

    Raises:
        ConfigError: intrinsics that no camera of such frames has; no target, two of one name, or two that cannot be
            told apart; ``instances`` below 1; an unknown method, or one that has no use for discs; ``compile`` without
            a C++ compiler.
    """

    made_for: Tensor

    def __new__(cls, camera: Any = None, target: Any = None, *args: Any, **options: Any) -> PoseEstimator:
        several = cls is PoseEstimator and isinstance(camera, CameraRig)
        return super().__new__(RigEstimator if several else cls)

    def __init__(
        self,
        camera: Camera | CameraRig,
        target: Target | str | PathLike[str] | Sequence[Target | str | PathLike[str]],
        *,
        instances: int = 1,
        method: Method = "photometric",
        float_range: float = 1.0,
        srgb: bool = False,
        compile: bool = False,
    ) -> None:
        super().__init__()
        keep_memory()
        if not isinstance(camera, Camera):
            raise ConfigError(f"camera: is of type {type(camera).__name__}; pass a Camera, such as Camera.load(path)")
        check_intrinsics(camera.matrix, camera.width, camera.height, camera.model)
        self.camera = camera
        self.targets = _targets(target)
        _check_targets(self.targets)
        if not isinstance(instances, int) or instances < 1:
            raise ConfigError(f"instances: {instances} given; give the most copies of a target in a frame, 1 or more")
        if not float_range > 0:
            raise ConfigError(f"float_range: {float_range} is not positive; use 1.0 or 255.0")
        if method not in get_args(Method):
            raise ConfigError(f"method: {method!r} is not known; choose one of {', '.join(get_args(Method))}")
        _check_boards(self.targets, method, instances)
        self.instances = instances
        self.method = method
        self.float_range = float_range
        self.tone = Tone("srgb") if srgb else camera.tone or LINEAR
        self.solves_compiled = compile
        if compile:
            find_compiler()
        self.table = MarkerTable.of(self.targets, self.camera)
        for owner in ("camera", "table"):
            for name, value in _tensors(getattr(self, owner)).items():
                self.register_buffer(f"{owner}_{name}", value.detach().clone())  # the caller's own stays the caller's
        self.register_buffer("made_for", self._of_camera())
        self._from_buffers()

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> PoseEstimator:
        """Moves to a device, as any module; geometry stays float64."""
        device = fn(self.camera.matrix[:0]).device
        super()._apply(lambda value: value.to(device), recurse)  # type: ignore[no-untyped-call]  # of torch
        self.camera, self.table = self.camera.to(device), self.table.to(device)
        return self

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *args: Any) -> None:
        """
        Raises:
            ConfigError: the state is of a camera of another size or lens model, or of another target.
        """
        # from what was given, not from the buffers: these may be on the device meta, without numbers
        made_for, table = self._of_camera(), MarkerTable.of(self.targets)
        given = state_dict.get(f"{prefix}made_for", made_for)
        if not torch.equal(given.to(made_for), made_for):
            raise ConfigError(
                "state_dict: made for a camera of another size or lens model; make the estimator for that one"
            )
        for name in _LAYOUT:
            own, other = getattr(table, name), state_dict.get(f"{prefix}table_{name}")
            if other is not None and not other.is_meta and not torch.equal(other.to(own), own):
                raise ConfigError("state_dict: made for another target; make the estimator for that one")
        super()._load_from_state_dict(state_dict, prefix, *args)
        self._from_buffers()

    def _of_camera(self) -> Tensor:
        """(3,) what a camera is beside its numbers."""
        return torch.tensor([self.camera.width, self.camera.height, get_args(Model).index(self.camera.model)])

    def _from_buffers(self) -> None:
        for owner in ("camera", "table"):
            old = getattr(self, owner)
            setattr(self, owner, replace(old, **{name: getattr(self, f"{owner}_{name}") for name in _tensors(old)}))

    @property
    def _recipe(self) -> Recipe:
        return METHODS[self.method]

    def extra_repr(self) -> str:
        names = ", ".join(t.name for t in self.targets)
        return f"camera={self.camera.width}x{self.camera.height}, targets=[{names}]"

    def forward(self, frames: Tensor | NDArray[Any], near: Near | None = None) -> Poses:
        """Poses of every target in every frame.

        Args:
            frames: (H, W), (B, H, W) or (B, 1, H, W) grey, or (B, 3, H, W) RGB, of which the luma counts; tensors or
                NumPy arrays of uint8, uint16, or floating point with white at ``float_range``.
            near: poses not long before, row by row of the frame of the batch that they are near to: of a sequence, what
                the last call gave (`tracking.Tracker`); or R (B, T, 3, 3) and t (B, T, 3), NaN where unknown. The rings
                are looked for where these put them, up to `identify.near.MOST_MOVE` px away, and all over the frame
                only where a target is not found whole there; so one that was lost is found again. The result is the
                same to a fraction of its deviation, but for `Poses.copies`, which then counts what is near. Boards, and
                several instances, are looked for everywhere.

        Returns:
            Rows sorted by frame, target and instance, on the device of the frames: B * T of them with
            ``instances=1``. With more, every frame and target has at least one row, and one for each copy with a pose.

        Raises:
            FrameError: wrong shape, size or dtype. ConfigError: ``near`` is of other targets.
        """
        with torch.inference_mode(), own_calls():
            frames = self._checked(frames)
            scene = Scene.of(frames, self.camera.to(frames.device), self.table.to(frames.device))
            scene, found, tried = self._found(scene, near)
            again = self._second_look(scene, found, tried)
            if len(again[0]) > len(found.rings):
                found = self._solved(scene, *again)
            poses = self._finished(scene, found)
        return _ordinary(poses)

    def _finished(self, scene: Scene, found: Found) -> Poses:
        """Rows of solutions, refined."""
        if found.solvable.numel():
            found = found._replace(solutions=self._refined(scene, found))
            found = found._replace(solutions=still_open(scene, found))
        return outcome(scene, found)

    def _checked(self, frames: Tensor | NDArray[Any]) -> Tensor:
        frames = as_frames(frames)
        if frames.dtype not in FRAME_TYPES:
            raise FrameError(f"frames: dtype {frames.dtype}; pass uint8, uint16 or floating point")
        size = (self.camera.height, self.camera.width)
        if tuple(frames.shape[1:]) != size:
            got, need = f"{frames.shape[2]} x {frames.shape[1]}", f"{size[1]} x {size[0]}"
            raise FrameError(f"frames: size {got}, but the camera has {need}; use the camera file of these frames")
        if self.tone != LINEAR:
            frames = self.tone.linear(frames, self.float_range)
        elif frames.is_floating_point():
            # the detector's least contrast counts in 1/255 of white
            frames = frames.float() * (255.0 / self.float_range)
        return frames.contiguous()

    def _found(self, scene: Scene, near: Near | None = None) -> tuple[Scene, Found, Rings]:
        """What is found in all frames: at the coarse scale alone where that shows every target whole.

        Also the rings that were measured for that.
        """
        frames, wanted = scene.frames, Wanted.of(scene.table.polarity, _LEAST_CANDIDATE)
        if not bool(scene.table.coded.all()):
            scene, found = self._found_with_boards(scene)
            return scene, found, found.rings
        if self.instances > 1:  # a copy may be too small for the coarse scale
            circles, others = self._useful(scene, find_candidates(frames, wanted=wanted, float_range=255.0))
            scene, found = self._read(scene, Rings.cat([self._measured(scene, circles), others]))
            return scene, found, found.rings
        there = None if near is None else find_near(scene, *_placed(scene, near))
        if there is not None:
            rings, of = measure_predicted(frames, *outlines(scene, there), scene.camera, correct=self._recipe.correct)
            first = self._named(scene, rings, confirmed(scene, there, rings, of), near=True)
            first = first or self._read(scene, rings)
            settled = self._settled(*first)
            if bool(settled.all()):
                return *first, rings
            return self._found_elsewhere(scene, first, settled, rings)
        coarse = find_coarse(frames, wanted=wanted, float_range=255.0)
        rings, copies, tried = self._likely(scene, coarse)
        table = scene.table
        # nothing else is to tell where the others begin
        planes = bool((table.coplanar & (table.valid.sum(1) > MIN_MARKERS)).all())
        first = self._named(scene, rings, by_codes(scene, rings), copies) if planes else None
        first = first or self._read(scene, rings, copies)
        settled = self._settled(*first)
        if bool(settled.all()):
            return *first, tried.rings
        rest, number = (~settled).nonzero()[:, 0], (~settled).cumsum(0) - 1
        known = coarse[~settled[coarse.frame]]
        known = replace(known, frame=number[known.frame])
        hopeful = partial(_hopeful, scene, len(rest))
        finer = find_candidates(frames[rest], wanted=wanted, coarse=known, hopeful=hopeful, float_range=255.0)
        circles, others = self._useful(scene, replace(finer, frame=rest[finer.frame]))
        every = Rings.cat([rings[settled[rings.frame]], self._measured(scene, circles, tried), others])
        return *self._read(scene, every, copies), Rings.cat([tried.rings, every])

    def _found_elsewhere(
        self, scene: Scene, near: tuple[Scene, Found], settled: Tensor, tried: Rings
    ) -> tuple[Scene, Found, Rings]:
        """The same where some frames are settled by what is near the last poses, and the others searched as ever."""
        rest, rows = (~settled).nonzero()[:, 0], len(scene.table)
        whole = near[1].rings
        other = Scene.of(scene.frames[rest], scene.camera, scene.table)
        _, found, searched = self._found(other)
        more = replace(found.rings, frame=rest[found.rings.frame])
        copies = torch.zeros(scene.groups, dtype=torch.int64, device=rest.device)
        for identified, frame in ((near[1].identified, None), (found.identified, rest)):
            group = identified.group
            group = group if frame is None else frame[group // rows] * rows + group % rows
            copies.scatter_reduce_(0, group, identified.copies, "amax")
        tried = Rings.cat([tried[settled[tried.frame]], replace(searched, frame=rest[searched.frame])])
        return *self._read(scene, Rings.cat([whole[settled[whole.frame]], more]), copies), tried

    def _found_with_boards(self, scene: Scene) -> tuple[Scene, Found]:
        """The same where there are boards among the targets: at finer and finer scales where they are not whole."""
        factor = reduction_factor(*scene.frames.shape[-2:])
        candidates = find_candidates(scene.frames, factor)
        while True:
            found = self._read(scene, self._measured(scene, self._circles(scene, candidates)), None, candidates)
            rest = (~self._settled(*found, whole=True)).nonzero()[:, 0]
            factor //= 2
            if factor < 1 or rest.numel() == 0:
                return found
            more = find_candidates(scene.frames[rest], factor)
            candidates = merge_duplicates(Candidates.cat([candidates, replace(more, frame=rest[more.frame])]))

    def _settled(self, scene: Scene, found: Found, *, whole: bool = False) -> Tensor:
        """Frames (B,) bool in which every target has a pose that its markers agree on, with ``whole`` all of them.

        Rings that are missing are looked for where the pose puts them: a search of the whole frame finds no more.
        """
        good = marked(found.solvable[found.solutions.status == Status.OK], len(scene.frame))
        if whole:  # marks of boards are not looked for again
            good &= ~(scene.table.valid[scene.target] & (found.identified.ring < 0)).any(1)
        return marked(scene.group[good], scene.groups).view(len(scene.frames), len(scene.table)).all(1)

    def _circles(self, scene: Scene, candidates: Candidates) -> Circles:
        candidates = candidates[torch.isin(candidates.polarity, scene.table.polarity)]
        return find_circles(scene.frames, candidates, scene.camera)

    def _useful(self, scene: Scene, candidates: Candidates) -> tuple[Circles, Rings]:
        """The circles that may be of a pose, and rough rings that only tell by their codes that a target is there."""
        circles = self._circles(scene, candidates)
        if len(circles) == 0:
            return circles, rough_rings(circles, scene.camera)
        rough, at = rough_rings(circles, scene.camera), (scene.table, scene.camera.matrix)
        beside = in_company(rough, *at)
        alone = rough[~beside & _legible(rough.blur)]
        return circles[beside], alone[named(alone, *at)]

    def _rings(self, scene: Scene, circles: Circles, *, hopeful: bool = False) -> tuple[Rings, Tensor]:
        return measure_circles(scene.frames, circles, scene.camera, correct=self._recipe.correct, hopeful=hopeful)

    def _measured(self, scene: Scene, circles: Circles, tried: _Tried | None = None) -> Rings:
        """The rings of all circles; those that were tried before are not measured from the start again."""
        if len(circles) == 0:
            return self._rings(scene, circles)[0]
        fresh = torch.ones_like(circles.outer.frame, dtype=torch.bool)
        parts = []
        if tried is not None:
            now, before = same_ellipses(circles.outer, tried.outer)
            equal = (circles.outer.ellipse[now] == tried.outer.ellipse[before]).all(1)
            fresh[now[equal]] = False
            old = marked(before[equal], len(tried.rings))
            parts = [tried.rings[old & tried.exact], tried.rings[old & ~tried.exact]]
        every = Rings.cat([*parts, self._rings(scene, circles[fresh], hopeful=True)[0]])
        # a blurred ring that is alone now is none that could be named
        kept = in_company(every, scene.table, scene.camera.matrix) | _legible(every.blur)
        done = len(parts[0]) if parts else 0
        again, _ = measure_exactly(scene.frames, every[done:][kept[done:]], scene.camera)
        return Rings.cat([every[:done], again])

    def _likely(self, scene: Scene, candidates: Candidates) -> tuple[Rings, Tensor, _Tried]:
        """The rings that the best copy of every target has by its circles' rough places and codes, measured.

        Also how many copies (B T,) were seen, and what was measured for that.
        """
        circles, count, least = self._circles(scene, candidates), len(scene.frames), int(scene.table.valid.sum())
        # frames with fewer circles than markers are searched at all scales anyway; up to twice as many are measured
        # sooner than they are chosen from
        if self._recipe.on_rims and _few(circles, 2 * least, count):
            circles = circles[_full(circles.outer.frame, count, least)[circles.outer.frame]]
            rings, of = self._rings(scene, circles)  # when they are measured they tell which of them are markers
            return rings, of.new_zeros(scene.groups), _Tried(circles.outer[of[:0]], rings[:0], rings.clipped[:0])
        rough = rough_rings(circles, scene.camera)
        some = in_company(rough, scene.table, scene.camera.matrix)
        some &= _full(rough.frame[some], count, least)[rough.frame]
        # the code of a much blurred ring is not to be read off its profile
        clear = _legible(rough.blur)
        sharp, blurred, rough = circles[some & clear], circles[some & ~clear], rough[some & clear]
        known, of = self._rings(scene, blurred)
        likely = identify(Rings.cat([rough, known]), scene.table, scene.camera, count, instances=1)
        # of a blurred ring the quicker model reads most codes; the dearer one reads those that are missing
        full = _full(torch.cat([rough.frame, known.frame]), count, least)
        exact = ((_lacking(scene, likely) & full) | (not self._recipe.on_rims))[known.frame]
        if bool(exact.any()):
            again, which = measure_exactly(scene.frames, known[exact], scene.camera)
            of = torch.cat([of[~exact], of[exact][which]])
            known = Rings.cat([known[~exact], again])
            exact = torch.arange(len(known), device=of.device) >= len(known) - len(again)
            likely = identify(Rings.cat([rough, known]), scene.table, scene.camera, count, instances=1)
        chosen = marked(likely.ring[likely.ring >= 0], len(rough) + len(known))
        others, _ = self._rings(scene, sharp[chosen[: len(rough)]])
        if not self._recipe.on_rims:
            others, _ = measure_exactly(scene.frames, others, scene.camera)
        tried = _Tried(blurred.outer[of], known, exact)
        return Rings.cat([others, known[chosen[len(rough) :]]]), likely.copies, tried

    def _named(
        self,
        scene: Scene,
        rings: Rings,
        identified: Identified | None,
        copies: Tensor | None = None,
        *,
        near: bool = False,
    ) -> tuple[Scene, Found] | None:
        """As `_read`, of rings that are named without a question, where all of them then agree on poses."""
        if identified is None:
            return None
        if copies is not None:
            identified = replace(identified, copies=identified.copies.maximum(copies))
        found = self._solved(scene, rings, identified, near=near)
        return (scene, found) if bool(self._settled(scene, found, whole=True).all()) else None

    def _read(
        self, scene: Scene, rings: Rings, copies: Tensor | None = None, marks: Candidates | None = None
    ) -> tuple[Scene, Found]:
        """Rows of the rings of all frames, identified and solved; at least so many ``copies`` (B T,) were seen.

        ``marks``: what those of boards are among.
        """
        identified = identify(rings, scene.table, scene.camera, len(scene.frames))
        if marks is not None:
            rings, identified = identify_boards(scene, rings, identified, marks)
        if copies is not None:
            identified = replace(identified, copies=identified.copies.maximum(copies[identified.group]))
        scene = scene.of_rows(identified.group)
        found = self._solved(scene, rings, identified)
        if marks is not None:

            def solve(row: Tensor, ring: Tensor) -> Found:
                return self._solved(scene.of_rows(scene.group[row]), rings, replace(identified[row], ring=ring))

            found = right_way_round(scene, found, solve)
        return best_copies(scene, found, self.instances)

    def _solved(self, scene: Scene, rings: Rings, identified: Identified, *, near: bool = False) -> Found:
        """The evidence of every row, and the solutions of those rows that have enough of it.

        ``near``: the rows' poses are those of frames not long before.
        """
        gain = scene.stated_gain(identified.gain)
        markers = replace(scene.table[scene.target], radii=scene.printed_radii(gain))
        evidence = gather_evidence(rings, identified.ring, markers, scene.camera, self._recipe.locate)
        evidence = replace(evidence, gain=gain)
        solvable = (evidence.mask.sum(-1) >= MIN_MARKERS).nonzero()[:, 0]
        rough = identified.R[solvable], identified.t[solvable]
        solutions = solve_poses(evidence[solvable], rough, near=near, compile=self.solves_compiled)
        return Found(rings, identified, evidence, solvable, solutions)

    def _second_look(self, scene: Scene, found: Found, tried: Rings) -> tuple[Rings, Identified]:
        """Looks for missing markers where the solutions put them, or the rough pose where there is none."""
        seen = found.evidence.mask | ~scene.table.valid[scene.target]
        if bool(seen.all()) and bool(found.solutions.mask.sum() == found.evidence.mask.sum()):
            return found.rings, found.identified
        known = found.rings, found.identified, _views(found), _much_blurred(tried)
        return look_again(scene, *known, correct=self._recipe.correct)

    def _refined(self, scene: Scene, found: Found) -> Solutions:
        """The solutions after the steps of the method."""
        evidence, solutions = found.evidence[found.solvable], _doubted(scene, found)
        sight = Sight.of_scene(scene, found, found.solvable)
        for step in self._recipe.steps:
            solutions = step(solutions, evidence, sight)
        return solutions


def _hopeful(scene: Scene, frames: int, found: Candidates) -> Tensor:
    """Frames (B,) bool in which two of these rings may be markers of one target."""
    if len(found) == 0:  # frames without any cost nothing here
        return found.frame.new_zeros(frames, dtype=torch.bool)
    ideal = mapped(found.ellipse, lambda points: ideal_pixels(scene.camera, points))
    together = beside_another((found.frame, found.polarity, ideal), scene.table, scene.camera.matrix)
    return marked(found.frame[together], frames)


def _placed(scene: Scene, near: Near) -> tuple[Tensor, Tensor]:
    """The poses as those of the rows (N, 3, 3), (N, 3) of a scene with one for every frame and target; NaN elsewhere.

    Raises:
        ConfigError: they are of other targets. ArgumentError: they are tensors of another shape.
    """
    if isinstance(near, tuple):
        R, t = near
        each = (len(scene.frames), len(scene.table))
        if R.shape != (*each, 3, 3) or t.shape != (*each, 3):
            shapes = f"{tuple(R.shape)} and {tuple(t.shape)}"
            raise ArgumentError(f"near: has shapes {shapes}; give R {(*each, 3, 3)} and t {(*each, 3)}")
        return R.flatten(0, 1), t.flatten(0, 1)
    if not isinstance(near, Poses):
        raise ArgumentError(f"near: is {type(near).__name__}; give Poses, or tensors R and t")
    if len(near) and int(near.target.max()) >= len(scene.table):
        raise ConfigError(f"near: poses of {int(near.target.max()) + 1} targets, but there are {len(scene.table)}")
    some = near[(near.instance == 0) & (near.frame < len(scene.frames))]
    group = some.frame * len(scene.table) + some.target
    R, t = (
        torch.full((scene.groups, *shape), torch.nan, dtype=torch.float64, device=group.device)
        for shape in ((3, 3), (3,))
    )
    return R.index_copy(0, group, some.R.to(R)), t.index_copy(0, group, some.t.to(t))


class RigEstimator(PoseEstimator):
    """Poses of targets that several cameras see at one moment; arguments as of `PoseEstimator`, with a `CameraRig`.

    Every camera's pictures go through the stages of one camera's up to what each of them solves. From there on there
    are moments: a common start, a second look in every camera that found too little where the others put the markers,
    one refinement on the pictures of all. Rows that one camera has alone are that camera's.
    """

    def __init__(
        self,
        camera: Camera | CameraRig,
        target: Target | str | PathLike[str] | Sequence[Target | str | PathLike[str]],
        *,
        instances: int = 1,
        **options: Any,
    ) -> None:
        nn.Module.__init__(self)
        if not isinstance(camera, CameraRig):
            raise ConfigError(f"camera: is of type {type(camera).__name__}; pass a CameraRig")
        if instances != 1:
            raise ConfigError(f"instances: {instances} given; several cameras look for one copy, leave it out")
        self.rig, self.targets = camera, _targets(target)
        self.views = nn.ModuleList([PoseEstimator(one, self.targets, **options) for one in camera.cameras])
        self.instances, self.method = instances, self._of(0).method
        if self.method == "paper":
            raise ConfigError("method: 'paper' is of one camera; use photometric, edges or centers with several")

    def _of(self, camera: int) -> PoseEstimator:
        view = self.views[camera]
        assert isinstance(view, PoseEstimator)
        return view

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> PoseEstimator:
        nn.Module._apply(self, fn, recurse)
        return self

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *args: Any) -> None:
        nn.Module._load_from_state_dict(self, state_dict, prefix, *args)

    def extra_repr(self) -> str:
        return f"cameras={', '.join(self.rig.names)}, targets=[{', '.join(t.name for t in self.targets)}]"

    def forward(self, frames: Sequence[Tensor | NDArray[Any]], seen: Tensor | None = None) -> Poses:  # type: ignore[override]
        """Poses of every target at every moment, in the axes of the first camera.

        Args:
            frames: of each camera its B frames, as `PoseEstimator` takes them, moment by moment.
            seen: (C, B) bool, False where a camera has no picture of a moment; what its frame holds is not looked at.

        Returns:
            B * T rows, sorted by moment and target, with `Poses.share`, `Poses.consistency` and `Poses.odd`.

        Raises:
            FrameError: wrong shape, size or dtype, or not one tensor for each camera.
        """
        with torch.inference_mode(), own_calls():
            poses = self._of_moments(frames, seen)
        return _ordinary(poses)

    def _of_moments(self, frames: Sequence[Tensor | NDArray[Any]], seen: Tensor | None) -> Poses:
        """`forward`, arguments as they come."""
        if isinstance(frames, Tensor) or len(frames) != len(self.rig):
            raise FrameError(f"frames: give a sequence of {len(self.rig)} tensors, one for each camera")
        every = [self._of(k)._checked(of_camera) for k, of_camera in enumerate(frames)]
        sizes = {len(of_camera) for of_camera in every}
        if len(sizes) > 1:
            raise FrameError(
                f"frames: the cameras have {', '.join(map(str, sorted(sizes)))} frames; give as many of each"
            )
        count, device = sizes.pop(), every[0].device
        if seen is None:
            seen = torch.ones(len(every), count, dtype=torch.bool, device=device)
        if seen.shape != (len(every), count) or seen.dtype != torch.bool:
            raise FrameError(f"seen: has shape {tuple(seen.shape)} and {seen.dtype}; give ({len(every)}, {count}) bool")
        # a moment that no camera has is an empty picture of the first
        seen = seen.clone()
        seen[0] |= ~seen.any(0)
        kept = [of_camera if bool(own.all()) else of_camera[own] for of_camera, own in zip(every, seen, strict=True)]
        views = [self._view(k, own, seen[k]) for k, own in enumerate(kept) if len(own)]
        return self._joined(Moments(self.rig.to(device), views, count, len(self.targets)))

    def _view(self, camera: int, frames: Tensor, seen: Tensor) -> View:
        """What one camera's pictures show, as far as it goes alone."""
        one, targets = self._of(camera), len(self.targets)
        scene = Scene.of(frames, one.camera.to(frames.device), one.table.to(frames.device))
        scene, found, tried = one._found(scene)
        again = one._second_look(scene, found, tried)
        if len(again[0]) > len(found.rings):
            found = one._solved(scene, *again)
        moment = seen.nonzero()[:, 0]
        number = torch.full_like(seen, -1, dtype=torch.int64).index_copy(
            0, moment, torch.arange(len(moment), device=moment.device)
        )
        every = torch.arange(len(seen) * targets, device=moment.device)
        row = torch.where(number[every // targets] >= 0, number[every // targets] * targets + every % targets, -1)
        return View(camera, scene, found, row, moment)

    def _joined(self, moments: Moments) -> Poses:
        every = torch.arange(moments.rows, device=moments.views[0].row.device)
        seen = moments.seen(every)
        rows = (seen.any(1).sum(-1) >= MIN_MARKERS).nonzero()[:, 0]
        if len(moments.views) == 1:
            rows = rows[:0]
        start = None
        if rows.numel():
            start = begin(moments, rows)
            moments, start = self._looked_again(moments, rows, start)
            several = start.known & ((start.mask.any(-1) | start.against).sum(1) > 1)
            rows, start = rows[several], start[several]
        fused = None
        if start is not None and rows.numel():
            refine = self._of(0)._recipe.refine
            fused = refine_moments(moments, rows, start, refine)
        return joined(moments, rows, fused, self._alone(moments, every[~marked(rows, moments.rows)]))

    def _looked_again(self, moments: Moments, rows: Tensor, start: Start) -> tuple[Moments, Start]:
        """With what cameras that have no pose of their own show where the others put the markers."""
        views, changed = [], torch.zeros_like(start.known)
        for k, view in enumerate(moments.views):
            own, place, solutions = view.row[rows], view.place(rows), view.found.solutions
            solved = (place >= 0) & (solutions.solved[place.clamp_min(0)] if len(solutions) else place >= 0)
            some = (start.known & (own >= 0) & ~solved & ~start.against.any(1)).nonzero()[:, 0]
            again = view if some.numel() == 0 else self._found_there(moments, view, own[some], start[some], k)
            if len(again.found.rings) > len(view.found.rings):
                changed[some] = True
            views.append(again)
        moments = moments.of_views(views)
        some = changed.nonzero()[:, 0]
        if some.numel() == 0:
            return moments, start
        return moments, start.replaced(some, begin(moments, rows[some], (start.R[some], start.t[some])))

    def _found_there(self, moments: Moments, view: View, own: Tensor, start: Start, number: int) -> View:
        """A view with the rings that lie where poses of its rows ``own`` put them."""
        one, identified = self._of(view.camera), view.found.identified
        R, t = moments.in_view(view, start.R, start.t)
        nowhere = torch.full_like(identified.R, torch.nan), torch.full_like(identified.t, torch.nan)
        R, t = nowhere[0].index_copy(0, own, R), nowhere[1].index_copy(0, own, t)
        # rings that do not agree with the others are not those markers
        kept = start.mask[:, number]
        ring = identified.ring.index_copy(0, own, torch.where(kept, identified.ring[own], -1))
        identified = replace(identified, ring=ring)
        rings, there = view.found.rings, Views(ring >= 0, R[:, None], t[:, None], 0)
        again = look_again(view.scene, rings, identified, there, rings[:0], correct=one._recipe.correct)
        return view._replace(found=one._solved(view.scene, *again))

    def _alone(self, moments: Moments, rows: Tensor) -> list[Alone]:
        """Rows that one camera has alone, by the camera that has most of it."""
        if rows.numel() == 0:
            return []
        most = moments.seen(rows).sum(-1)
        there = torch.stack([view.row[rows] >= 0 for view in moments.views], 1)
        best = torch.where(there, most, -1).argmax(1)
        parts = []
        for k, view in enumerate(moments.views):
            own = rows[best == k]
            if own.numel() == 0:
                continue
            found = view.found
            mine = marked(view.row[own], len(found.evidence))[found.solvable].nonzero()[:, 0]
            found = found._replace(solvable=found.solvable[mine], solutions=found.solutions[mine])
            parts.append(Alone(own, k, self._of(view.camera)._finished(view.scene, found)))
        return parts


def _ordinary(poses: Poses) -> Poses:
    """Poses made in inference mode, which saves a sixth of a frame's CPU, as tensors that autograd may save."""
    return poses if torch.is_inference_mode_enabled() else poses.clone()


def _legible(blur: Tensor) -> Tensor:
    """Rings (K,) bool of these blurs (K, 3) whose profile tells their code."""
    return blurs.axes(blur)[1] <= _LEGIBLE**2


def _full(frame: Tensor, frames: int, least: int) -> Tensor:
    """Frames (B,) bool that have at least so many of the items of frames (K,)."""
    return torch.bincount(frame, minlength=frames) >= least


def _few(circles: Circles, most: int, frames: int) -> bool:
    """Whether circles are legible, and no frame has so many of them that choosing costs less than measuring all.

    The profile of a small ring hides a blur of its size, and its code may be another than it seems: a choice tells.
    """
    few = bool((torch.bincount(circles.outer.frame, minlength=frames) <= most).all())
    return few and bool((_legible(circles.inside.blur) & (circles.outer.ellipse[:, 3] >= LARGE)).all())


def _lacking(scene: Scene, identified: Identified) -> Tensor:
    """Frames (B,) bool in which a target has a row that lacks a marker."""
    lacks = (scene.table.valid[identified.group % len(scene.table)] & (identified.ring < 0)).any(1)
    return marked(identified.group[lacks] // len(scene.table), len(scene.frames))


def _much_blurred(rings: Rings) -> Rings:
    """Those whose blur hides no more of them at a coarse scale than at a fine one."""
    return rings[~_legible(rings.blur)]


def _views(found: Found) -> Views:
    """The poses that rows may have: both where they are ambiguous, the rough one where there is no solution."""
    identified, some = found.identified, found.solutions[found.solutions.solved]
    index = found.solvable[found.solutions.solved]
    seen = (identified.ring >= 0).index_copy(0, index, some.mask)
    nowhere = torch.full_like(identified.R, torch.nan), torch.full_like(identified.t, torch.nan)
    R, t = (torch.stack(v, 1) for v in zip((identified.R, identified.t), nowhere, strict=True))
    twofold = (some.status == Status.AMBIGUOUS)[:, None, None]
    R = R.index_copy(0, index, torch.stack([some.R, torch.where(twofold, some.R_alt, torch.nan)], 1))
    t = t.index_copy(0, index, torch.stack([some.t, some.t_alt], 1))
    return Views(seen, R, t)


def _targets(given: Any) -> tuple[Target, ...]:
    """Targets given as such, by their names or by the paths of their files, one or several."""
    several = [given] if isinstance(given, Target | str | PathLike) or not isinstance(given, Iterable) else given
    loaded = tuple(Target.load(each) if isinstance(each, str | PathLike) else each for each in several)
    for each in loaded:
        if not isinstance(each, Target):
            raise ConfigError(f"target: is of type {type(each).__name__}; pass a Target, or its name or path")
    return loaded


def _check_targets(targets: Sequence[Target]) -> None:
    if not targets:
        raise ConfigError("target: none given; pass at least one Target")
    names = [t.name for t in targets]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ConfigError(f"target: name {twice[0]!r} given twice; rename one, rows are told apart by it")
    for one, other in combinations(targets, 2):
        if indistinguishable(one, other):
            raise ConfigError(
                f"target: {one.name!r} and {other.name!r} cannot be told apart, their codes and layout agree; give one "
                "of them and instances (--instances) for its copies, or change the ratios or places of its rings"
            )


def _check_boards(targets: Sequence[Target], method: str, instances: int) -> None:
    boards = [target.name for target in targets if target.grid is not None]
    if boards and instances > 1:
        raise ConfigError(f"instances: board {boards[0]!r} is looked for once in a frame; leave instances out")
    discs = [target.name for target in targets if target.discs]
    if discs and method not in ("photometric", "centers"):
        raise ConfigError(
            f"method: {method!r} takes both circles of rings, and {discs[0]!r} has discs; use photometric"
        )


def _doubted(scene: Scene, found: Found) -> Solutions:
    """Rejects poses from three markers that put a fourth across a ring."""
    solutions, row = found.solutions, found.solvable
    three = (solutions.mask.sum(-1) == MIN_MARKERS) & solutions.solved
    if not bool(three.any()):
        return solutions
    markers, matrix = scene.table[scene.target[row]], scene.camera.matrix
    across = crossed_out(found.rings, scene.frame[row], solutions.R, solutions.t, markers, solutions.mask, matrix)
    return solutions.marked(across & three, Status.REJECTED, Reason.RESIDUAL)


def _tensors(owner: Camera | MarkerTable) -> dict[str, Tensor]:
    """The tensors of a dataclass by name."""
    values = {f.name: getattr(owner, f.name) for f in fields(owner)}
    return {name: value for name, value in values.items() if isinstance(value, Tensor)}
