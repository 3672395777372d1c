"""Targets: the built-in ones, exact round trips, geometry, and one line for every mistake in a file."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.target import MIN_RATIO_GAP, Target

QUAD = """name: plate
units: mm
background: light
markers:
  - {id: 0, center: [-20.0, -20.0, 0.0], outer_radius: 5.0, inner_radius: 1.5}
  - {id: 1, center: [20.0, -20.0, 0.0], outer_radius: 5.0, inner_radius: 2.0}
  - {id: 2, center: [20.0, 20.0, 0.0], outer_radius: 5.0, inner_radius: 2.5}
  - {id: 3, center: [-20.0, 20.0, 0.0], outer_radius: 5.0, inner_radius: 3.0}
"""


def load(tmp_path: Path, text: str) -> Target:
    path = tmp_path / "target.yaml"
    path.write_text(text)
    return Target.load(path)


def test_reads_the_contract(tmp_path: Path) -> None:
    target = load(tmp_path, QUAD + "part_from_target: {rotation: [0, 0, 1.5], translation: [1, 2, 3]}\n")
    assert (target.name, target.background, len(target)) == ("plate", "light", 4)
    assert target.ids.tolist() == [0, 1, 2, 3]
    assert target.centers.dtype == torch.float64
    assert target.centers.tolist() == [[-20, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]]
    assert target.normals.tolist() == [[0, 0, 1]] * 4
    torch.testing.assert_close(target.codes, torch.tensor([0.09, 0.16, 0.25, 0.36], dtype=torch.float64))
    assert target.coplanar
    assert target.part_from_target is not None
    r, t = target.part_from_target
    expected = [[math.cos(1.5), -math.sin(1.5), 0], [math.sin(1.5), math.cos(1.5), 0], [0, 0, 1]]
    torch.testing.assert_close(r, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-15)
    assert t.tolist() == [1, 2, 3]


def test_short_forms(tmp_path: Path) -> None:
    """z may be left out, numbers may be integers or 1e-3, JSON is fine."""
    text = QUAD.replace(", 0.0]", "]").replace("5.0", "5").replace("1.5", "15e-1")
    assert torch.equal(load(tmp_path, text).radii, load(tmp_path, QUAD).radii)
    assert load(tmp_path, text).centers[:, 2].tolist() == [0, 0, 0, 0]
    assert load(tmp_path, text).part_from_target is None
    assert torch.equal(load(tmp_path, json.dumps(yaml.safe_load(QUAD))).centers, load(tmp_path, QUAD).centers)


@pytest.mark.parametrize("name", Target.builtin_names())
def test_builtin_targets_are_sound(name: str) -> None:
    target = Target.load(name)
    assert target.name == name
    assert target.coplanar
    ratio = target.codes.sqrt().sort().values
    assert ratio.diff().min() >= MIN_RATIO_GAP
    assert len(target) >= 4


def test_builtin_names() -> None:
    assert {"quad40", "quad40_dark", "quad8", "hexa50"} <= set(Target.builtin_names())
    sides = torch.cdist(Target.load("quad8").centers, Target.load("quad8").centers)
    assert sides[sides > 0].min() == 8


def test_a_file_goes_before_a_builtin_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert Target.load("quad40").name == "quad40"
    Path("quad40").write_text(QUAD)
    assert Target.load("quad40").name == "plate"


def test_unknown_name_lists_the_builtin_ones() -> None:
    with pytest.raises(ConfigError, match=r"^quad41: target: is neither a file nor built in; .*hexa50, quad40,"):
        Target.load("quad41")
    with pytest.raises(ConfigError, match=r"^parts/quad41.yaml: file: does not exist; "):
        Target.load("parts/quad41.yaml")


finite = st.floats(-1e3, 1e3)


@given(
    offset=st.lists(finite, min_size=3, max_size=3),
    turn=st.lists(st.floats(-2, 2), min_size=3, max_size=3),
    part=st.none() | st.tuples(*(st.lists(st.floats(-m, m), min_size=3, max_size=3) for m in (3.6, 1e3))),
    dark=st.booleans(),
)
@settings(deadline=None, max_examples=60)
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory,
    offset: list[float],
    turn: list[float],
    part: tuple[list[float], list[float]] | None,
    dark: bool,
) -> None:
    base = Target.load("hexa50")
    r = rotations.exp(torch.tensor(turn, dtype=torch.float64))
    target = Target(
        name="turned plate 7",
        background="dark" if dark else "light",
        ids=base.ids + 2**40,
        centers=base.centers @ r.T + torch.tensor(offset, dtype=torch.float64),
        normals=base.normals @ r.T,
        radii=base.radii / 3,
        part_rotation=None if part is None else torch.tensor(part[0], dtype=torch.float64),
        part_translation=None if part is None else torch.tensor(part[1], dtype=torch.float64),
    )
    assert target.coplanar
    path = tmp_path_factory.getbasetemp() / "round_trip.yaml"
    target.save(path)
    again = Target.load(path)
    assert (again.name, again.background) == (target.name, target.background)
    for field in ("ids", "centers", "radii"):
        assert torch.equal(getattr(again, field), getattr(target, field))
    torch.testing.assert_close(again.normals, target.normals, rtol=0, atol=1e-15)
    if part is None:
        assert again.part_from_target is None
    else:
        assert again.part_rotation is not None
        assert again.part_translation is not None
        assert (again.part_rotation.tolist(), again.part_translation.tolist()) == part


@pytest.mark.parametrize(
    "old",
    ["center: [-20.0, -20.0, 0.0]", "normal: [0.0, 0.0, 1.0]"],
)
def test_not_coplanar(tmp_path: Path, old: str) -> None:
    text = QUAD.replace("inner_radius: 1.5", "inner_radius: 1.5, normal: [0.0, 0.0, 1.0]")
    new = {"center": "center: [-20.0, -20.0, 0.01]", "normal": "normal: [0.1, 0.0, 2.0]"}[old.split(":")[0]]
    assert load(tmp_path, text).coplanar
    target = load(tmp_path, text.replace(old, new))
    assert not target.coplanar
    assert target.normals.norm(dim=-1).sub(1).abs().max() < 1e-15


def test_rings_on_two_faces_of_a_box_may_be_near(tmp_path: Path) -> None:
    text = QUAD.replace("[-20.0, -20.0, 0.0]", "[25.0, -20.0, 6.0]").replace("1.5}", "1.5, normal: [1, 0, 0]}")
    assert not load(tmp_path, text).coplanar


def test_to_keeps_the_ids() -> None:
    single = Target.load("quad40").to(torch.float32)
    assert single.centers.dtype == single.normals.dtype == single.radii.dtype == single.codes.dtype == torch.float32
    assert single.ids.dtype == torch.int64
    assert single.coplanar


def replaced(old: str, new: str) -> str:
    assert old in QUAD
    return QUAD.replace(old, new)


M = r"markers\[{}\]\."
TRAPS = {
    "empty": ("", "file: is empty; "),
    "not yaml": (QUAD + "  - {id: 4", "line .*: is not YAML "),
    "not a mapping": ("- 1", "file: holds a list, not a mapping; "),
    "nothing": ("---\n", "file: holds nothing, not a mapping; "),
    "duplicate key": (QUAD + "units: mm\n", r"units: given twice \(line 9\); keep one"),
    "duplicate nested key": (replaced("{id: 2,", "{id: 2, id: 4,"), r"id: given twice \(line 7\); keep one"),
    "unknown key": (replaced("background:", "backgruond:"), "backgruond: unknown key; did you mean background\\?"),
    "unknown nested key": (
        replaced("5.0, inner_radius: 2.0", "5.0, iner_radius: 2.0"),
        M.format(1) + "iner_radius: unknown key; did you mean inner_radius\\?",
    ),
    "unknown distant key": (
        QUAD + "zzz: 1\n",
        "zzz: unknown key; known are name, units, background, markers, part_from",
    ),
    "unknown pose key": (
        QUAD + "part_from_target: {rotation: [0, 0, 0], translatoin: [0, 0, 0]}\n",
        r"part_from_target\.translatoin: unknown key; did you mean translation\?",
    ),
    "part in degrees": (
        QUAD + "part_from_target: {rotation: [0, 0, 90], translation: [0, 0, 0]}\n",
        r"part_from_target\.rotation: turns by 90 rad, more than once around; write a rotation vector in rad",
    ),
    "no name": (replaced("name: plate\n", ""), "name: is missing; add it"),
    "no markers": (QUAD.split("markers")[0], "markers: is missing; add it"),
    "no radius": (replaced(", inner_radius: 2.0", ""), M.format(1) + "inner_radius: is missing; add it"),
    "name number": (replaced("plate", "40"), "name: is not text; put it in quotes"),
    "name empty": (replaced("plate", "''"), "name: is ''; give a word"),
    "name comma": (replaced("plate", "'a,b'"), "name: has the character ','; use letters"),
    "name slash": (replaced("plate", "a/b"), "name: has the character '/'; "),
    "name newline": (replaced("plate", '"a\\nb"'), r"name: has the character '\\n'; "),
    "name dots": (replaced("plate", '".."'), r"name: is '\.\.'; "),
    "units m": (replaced("units: mm", "units: m"), "units: is 'm'; convert all lengths to millimetres and write mm"),
    "no units": (replaced("units: mm\n", ""), "units: is missing; add it"),
    "background": (replaced("light", "white"), "background: is 'white'; write 'light' or 'dark'"),
    "id twice": (replaced("id: 3", "id: 1"), M.format(3) + "id: 1 is given twice; "),
    "id negative": (replaced("id: 3", "id: -3"), M.format(3) + "id: is -3; "),
    "id text": (replaced("id: 3", "id: a"), M.format(3) + "id: is not an integer; "),
    "id fraction": (replaced("id: 3", "id: 3.5"), M.format(3) + "id: is not an integer; "),
    "id huge": (
        replaced("id: 3", "id: 99999999999999999999"),
        r"line 8: 99999999999999999999\.\.\. is a number of 20 digits",
    ),
    "same code": (replaced("inner_radius: 2.0", "inner_radius: 1.7"), r"markers: ids 0 and 1 cannot be told apart \("),
    "inner outside": (replaced("2.5}", "5.5}"), M.format(2) + "inner_radius: 5.5 is not below the outer 5; "),
    "inner equal": (replaced("2.5}", "5.0}"), M.format(2) + "inner_radius: 5 is not below the outer 5; "),
    "inner zero": (replaced("2.5}", "0}"), M.format(2) + "inner_radius: is 0; give a positive length"),
    "outer negative": (
        replaced("5.0, inner_radius: 2.5", "-5.0, inner_radius: 2.5"),
        M.format(2) + "outer_radius: is -5; give a positive length",
    ),
    "hole unreadable": (replaced("1.5}", "0.5}"), M.format(0) + "inner_radius: inner/outer is 0.1; "),
    "ring unreadable": (replaced("3.0}", "4.8}"), M.format(3) + "inner_radius: inner/outer is 0.96; "),
    "radius nan": (replaced("2.5}", ".nan}"), M.format(2) + "inner_radius: is not finite; "),
    "center inf": (replaced("[20.0, 20.0, 0.0]", "[20.0, .inf, 0.0]"), M.format(2) + r"center\[1\]: is not finite; "),
    "center text": (replaced("[20.0, 20.0, 0.0]", "[a, 2, 0]"), M.format(2) + r"center\[0\]: is not a number; "),
    "center quoted": (replaced("[20.0, 20.0, 0.0]", "['1', 2, 0]"), M.format(2) + r"center\[0\]: is not a number; "),
    "center true": (replaced("[20.0, 20.0, 0.0]", "[true, 2, 0]"), M.format(2) + r"center\[0\]: is not a number; "),
    "center short": (replaced("[20.0, 20.0, 0.0]", "[20.0]"), M.format(2) + r"center: has 1 entries; give \[x, y, z\]"),
    "center scalar": (replaced("[20.0, 20.0, 0.0]", "20.0"), M.format(2) + r"center: is not a list; "),
    "two markers": ("\n".join(QUAD.splitlines()[:6]), "markers: 2 given; a pose needs at least 3"),
    "no marker": (QUAD.split("markers")[0] + "markers: []\n", "markers: 0 given; "),
    "markers mapping": (QUAD.split("markers")[0] + "markers: {id: 0}\n", "markers: is not a list; "),
    "marker scalar": (QUAD + "  - 5\n", M.format(4)[:-2] + ": is not a mapping; "),
    "overlap": (replaced("[20.0, 20.0, 0.0]", "[20.0, -10.1, 0.0]"), "markers: ids 1 and 2 overlap; "),
    "normal zero": (replaced("2.5}", "2.5, normal: [0, 0, 0]}"), M.format(2) + "normal: is zero; "),
    "normal short": (replaced("2.5}", "2.5, normal: [0, 1]}"), M.format(2) + "normal: has 2 entries; give 3"),
    "part short": (
        QUAD + "part_from_target: {rotation: [0, 0], translation: [0, 0, 0]}\n",
        r"part_from_target\.rotation: has 2 entries; give 3",
    ),
    "part half": (QUAD + "part_from_target: {rotation: [0, 0, 0]}\n", r"part_from_target\.translation: is missing; "),
    "sigma negative": (QUAD + "center_sigma: [0.1, -0.1, 0]\n", r"center_sigma\[1\]: .*is -0.1; give at least 0"),
    "sigma text": (QUAD + "center_sigma: much\n", "center_sigma: is not a list; "),
    "sigma huge": (QUAD + "center_sigma: 1.0e+100\n", r"center_sigma\[0\]: .*at most 1000"),
    "gain sigma huge": (QUAD + "edge_gain_sigma: 1.0e+200\n", "edge_gain_sigma: .*at most 1000"),
    "gain sigma nan": (QUAD + "edge_gain_sigma: .nan\n", "edge_gain_sigma: is not finite; "),
    "gain closes a hole": (QUAD + "edge_gain: 1.6\n", "edge_gain: 1.6 mm leaves a ring without width or hole; "),
    "covariance huge": (
        QUAD + f"centers_covariance: {{rows: 12, cols: 12, data: {[1e300 * (k % 13 == 0) for k in range(144)]}}}\n",
        r"centers_covariance\.data\[0\]: is 1e\+300; give at most",
    ),
    "covariance small": (
        QUAD + f"centers_covariance: {{rows: 9, cols: 9, data: {[0.0] * 81}}}\n",
        "centers_covariance: is 9 x 9 with 81 numbers; 4 markers have 12 x 12",
    ),
    "covariance twice": (
        QUAD + f"center_sigma: 0.1\ncenters_covariance: {{rows: 12, cols: 12, data: {[0.0] * 144}}}\n",
        "center_sigma: stands beside centers_covariance",
    ),
    "cross negative": (
        QUAD + f"adjustment: a\ncamera_cross_covariance: {{rows: -13, cols: -8, data: {[0.0] * 104}}}\n",
        "camera_cross_covariance: 104 numbers for -13 x -8; ",
    ),
    "several errors": (replaced("5.0", "x"), M.format(0) + r"outer_radius: is not a number; .* \(and 3 more\)$"),
}


@pytest.mark.parametrize("trap", TRAPS)
def test_traps_name_file_field_and_fix(tmp_path: Path, trap: str) -> None:
    text, message = TRAPS[trap]
    with pytest.raises(ConfigError, match=f"^{tmp_path / 'target.yaml'}: {message}") as caught:
        load(tmp_path, text)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(("aside", "collinear"), [(0.0, True), (0.05, True), (5.0, False)])
def test_collinear_centers(aside: float, collinear: bool, tmp_path: Path) -> None:
    data = yaml.safe_load(QUAD)
    for i, marker in enumerate(data["markers"]):
        marker["center"] = [30.0 * i, aside * (i % 2), 0.0]
    if collinear:
        with pytest.raises(ConfigError, match="markers: the centers lie on one line; "):
            load(tmp_path, yaml.safe_dump(data))
    else:
        assert len(load(tmp_path, yaml.safe_dump(data))) == 4


def test_code_gap_is_the_documented_one(tmp_path: Path) -> None:
    def with_second_ratio(ratio: float) -> str:
        return QUAD.replace("inner_radius: 2.0", f"inner_radius: {5 * ratio!r}")

    assert len(load(tmp_path, with_second_ratio(0.3 + MIN_RATIO_GAP))) == 4
    with pytest.raises(ConfigError, match="ids 0 and 1 cannot be told apart"):
        load(tmp_path, with_second_ratio(0.3 + MIN_RATIO_GAP - 0.001))


def test_checks_hold_without_a_file() -> None:
    quad = Target.load("quad40")
    with pytest.raises(ConfigError, match=r"^markers\[1\]\.id: 0 is given twice; "):
        Target("a", "light", torch.zeros(4, dtype=torch.int64), quad.centers, quad.normals, quad.radii)
    with pytest.raises(ConfigError, match=r"^centers: has shape \(3, 3\); give \(4, 3\)"):
        Target("a", "light", quad.ids, quad.centers[:3], quad.normals, quad.radii)
    with pytest.raises(ConfigError, match=r"^markers\[0\]\.normal: has length 2; give a unit vector"):
        Target("a", "light", quad.ids, quad.centers, 2 * quad.normals, quad.radii)
    with pytest.raises(ConfigError, match=r"^part_from_target: is half given; "):
        Target("a", "light", quad.ids, quad.centers, quad.normals, quad.radii, part_rotation=torch.zeros(3))


def test_what_a_target_shares_with_its_camera_round_trips(tmp_path: Path) -> None:
    target = Target.load("quad40")
    root = torch.randn(13, 13, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    covariance = 1e-6 * root @ root.mT
    covariance = 0.5 * (covariance + covariance.mT)
    covariance[-1, :-1] = covariance[:-1, -1] = 0.0
    cross = torch.randn(13, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    shared = replace(target, covariance=covariance, adjustment="ba-0123456789ab", cross_covariance=cross)
    path = tmp_path / "measured.yaml"
    shared.save(path)
    again = Target.load(path)
    assert again.adjustment == shared.adjustment
    assert again.cross_covariance is not None
    assert torch.equal(again.cross_covariance, cross)
    assert again.covariance is not None
    torch.testing.assert_close(again.covariance, covariance, rtol=1e-12, atol=0)
    with pytest.raises(ConfigError, match="camera_cross_covariance: stands without adjustment"):
        replace(shared, adjustment=None)
    with pytest.raises(ConfigError, match=r"camera_cross_covariance: has shape \(12, 8\); give 13 rows"):
        replace(shared, cross_covariance=cross[1:])
