"""YAML and JSON: the same values as PyYAML's own loader gives, and nothing that grows beyond what it is written in."""

import json
import math
import os
import re
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from torchpose.config import parse_json, parse_mapping, read_text, read_yaml
from torchpose.config.documents import MOST_DEPTH, MOST_VALUES
from torchpose.errors import ConfigError, TorchposeError

# 1e3 and -.5 are numbers here, as in YAML 1.2; PyYAML takes them for text and writes them without quotes
TEXTS = st.text(max_size=20).filter(
    lambda text: not re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+|[-+]\.\d+", text)
)
LEAVES = st.one_of(st.none(), st.booleans(), st.integers(-(2**62), 2**62), st.floats(allow_nan=False), TEXTS)


def _nested(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)


VALUES = st.recursive(LEAVES, _nested, max_leaves=20)
MAPPINGS = st.dictionaries(st.text(max_size=8), VALUES, max_size=5)


@given(MAPPINGS, st.booleans())
def test_what_pyyaml_writes_reads_back(data: dict[str, Any], flow: bool) -> None:
    assert parse_mapping(yaml.safe_dump(data, default_flow_style=flow)) == data
    assert parse_mapping(json.dumps(data)) == data
    assert parse_json(json.dumps(data).encode()) == data


SAME = [
    "a: [1, 0, 0x1F, 1_000, +3, -0.5, .5, 1e3, 1.5e-3, .inf, -.INF, yes, Off, null, ~, '1', \"2\", x]",
    "a: &x {b: 1, c: [2, *y]}\n".replace("*y", "3") + "d: *x\ne: {<<: *x, b: 5}\n",
    "base: &a {x: 1}\nmore: &b {x: 2, y: 3}\nboth: {<<: [*a, *b], z: 4}\n",
    "text: |\n  two\n  lines\nfolded: >\n  one\n  line\n",
    "? a\n: b\n? c\n",
    "a: !!float 3\nb: !!str 4\nc: ! 5\nd: !!int '6'\n",
    "- &k a\n- {*k : 1}\n".replace("- &k a\n- ", "u: &k a\nv: "),
]


@pytest.mark.parametrize("text", SAME)
def test_yaml_means_what_pyyaml_takes_it_for(text: str) -> None:
    found, wanted = parse_mapping(text), yaml.safe_load(text)
    if "a" in wanted and isinstance(wanted["a"], list):  # PyYAML takes 1e3 for text
        wanted["a"] = [float(v) if v == "1e3" else v for v in wanted["a"]]
    assert found == wanted


def test_what_pyyaml_has_no_word_for() -> None:
    found = parse_mapping("%YAML:1.0\n---\nm: !!opencv-matrix\n   rows: 1\n   data: [ 1e-3, .Nan ]\nd: 2024-01-02\n")
    assert found["m"]["data"][0] == 1e-3
    assert math.isnan(found["m"]["data"][1])
    assert found["d"] == "2024-01-02"
    assert parse_mapping("a: [-.11, +.5, -.5e1]") == {"a": [-0.11, 0.5, -5.0]}


def test_numbers_that_other_readers_take_for_others_are_text() -> None:
    """YAML 1.1 has 010 = 8, 12:30 = 750 and 1:30.5 = 90.5; who wrote them, and YAML 1.2, meant something else."""
    assert parse_mapping("a: [010, 007, -012, 12:30, 1:30.5]") == {"a": ["010", "007", "-012", "12:30", "1:30.5"]}


NINE = ", ".join(["*a{0}"] * 9)
BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(f"a{i + 1}: &a{i + 1} [{NINE.format(i)}]\n" for i in range(8))
MERGES = "a0: &a0 {x0: 1}\n" + "".join(
    f"a{i + 1}: &a{i + 1} {{<<: [{NINE.format(i)}], x{i + 1}: 1}}\n" for i in range(8)
)
REFUSED = {
    "aliases": (BOMB, f"line 6: more than {MOST_VALUES} values"),
    "merge keys": (MERGES, f"more than {MOST_VALUES} values"),
    "itself": ("a: &a [*a]", r"\*a stands for what is not ended"),
    "itself merged": ("a: &a {<<: *a}", r"\*a stands for what is not ended"),
    "deep": ("a: " + "[" * 100_000, f"more than {MOST_DEPTH} deep"),
    "deep blocks": ("\n".join(" " * i + "a:" for i in range(900)), f"more than {MOST_DEPTH} deep"),
    "deep JSON": ('{"a": ' + "[" * 100_000 + "]" * 100_000 + "}", f"more than {MOST_DEPTH} deep"),
    "digits": ("a: " + "9" * 400, r"99999\.\.\. is a number of 400 digits"),
    "digits of JSON": ('{"a": ' + "9" * 5000 + "}", r"99999\.\.\. is a number of 5000 digits"),
    "beyond 64 bits": ("a: 99999999999999999999", "is a number of 20 digits"),
    "list as key": ("{[1, 2]: 3}", "stands where a key should"),
    "merge of a number": ("<<: 3", "<< merges mappings"),
    "twice": ("a: 1\nb: 2\na: 3", r"a: given twice \(line 3\)"),
    "twice in JSON": ('{"a": 1, "a": 2}', "a: given twice"),
    "half a pair": ("a: '\ud800'", "is not YAML"),
    "NUL": ("a: \0", "is not YAML"),
    "documents": ("a: 1\n---\nb: 2\n", "holds 2 YAML documents"),
    "python": ("!!python/object/apply:os.system ['true']", "holds a list"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_too_much_or_no_yaml_is_one_line_at_once(case: str) -> None:
    text, message = REFUSED[case]
    begin = time.process_time()
    with pytest.raises(ConfigError, match=message) as caught:
        parse_mapping(text)
    assert time.process_time() - begin < 1
    assert str(caught.value).isprintable()


def test_a_measured_target_of_a_hundred_markers_is_within_the_bounds() -> None:
    row = "[" + ", ".join(["1.2345678901234567e-05"] * 300) + "]"
    assert len(parse_mapping("data:\n" + f"  - {row}\n" * 300)["data"]) == 300


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs POSIX")
def test_what_has_no_end_or_no_beginning_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "loop.yaml").symlink_to("loop.yaml")
    with (tmp_path / "large.yaml").open("wb") as file:
        file.truncate(10**10)
    places: dict[str | Path, str] = {
        "/dev/zero": "is a device or pipe",
        tmp_path / "pipe.yaml": "is a device or pipe",
        tmp_path / "loop.yaml": "cannot be read",
        tmp_path / "large.yaml": "has 10000 MB; at most 4 MB are read",
        "a\0b": "cannot be read",
        "a\ud800b": "cannot be read|does not exist",
        "x" * 300: "cannot be read",
    }
    for place, problem in places.items():
        with pytest.raises(ConfigError, match=problem) as caught:
            read_yaml(place)
        assert str(caught.value).isprintable()
    with pytest.raises(ConfigError, match="is a folder"):
        read_text(tmp_path)


def test_messages_are_one_line_of_bounded_length() -> None:
    message = str(TorchposeError("\x1b[2J" + "a" * 10**6 + "\n\ud800; write less"))
    assert message.isprintable()
    assert message.startswith(r"\x1b[2J")
    assert message.endswith(r"\n\ud800; write less")
    assert len(message) < 1010
