"""YAML without its surprises, and names that stay names."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.config import MAX_YAML_BYTES, MAX_YAML_DEPTH, parse_yaml
from armctl.errors import ConfigError
from armctl.files import find_arm_file


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a: &x 1\nb: *x", "aliases are not allowed"),
        ("a: !!float ''", "line 1, column 4: tags are not allowed"),
        ("a: !!python/object:os.system 1", "tags are not allowed"),
        ("!mine {a: 1}", "tags are not allowed"),
        ("a: 1\na: 2", "stands twice"),
        ("? [1]\n: 2", "a key must be a plain word"),
        ("- 1", "holds a list"),
        ("a: [", "line 1"),
        ("a" * (MAX_YAML_BYTES + 1), f"larger than {MAX_YAML_BYTES} bytes"),
        ("[" * 60_000, f"nested more than {MAX_YAML_DEPTH} deep"),
        ("- " * 30_000, f"nested more than {MAX_YAML_DEPTH} deep"),
    ],
)
def test_what_yaml_allows_beyond_keys_and_values_is_refused(text: str, problem: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_yaml(text, "FILE")
    assert str(refused.value).startswith("FILE")
    assert problem in str(refused.value)


@given(st.integers(1, MAX_YAML_DEPTH + 4))
@settings(deadline=None)
def test_depth_is_bounded_just_there(depth: int) -> None:
    """The mapping, its value, and what is inside of it."""
    text = "a: " + "[" * (depth - 2) + "1" + "]" * (depth - 2)
    if depth <= MAX_YAML_DEPTH:
        assert parse_yaml(text, "FILE").keys() == {"a"}
    else:
        with pytest.raises(ConfigError, match="deep"):
            parse_yaml(text, "FILE")


@pytest.mark.parametrize(
    ("text", "value"),
    [("1:30", "1:30"), ("0o17", "0o17"), ("yes", "yes"), (".nan", ".nan"), ("1e3", 1000.0), ("true", True), ("", None)],
)
def test_only_what_looks_like_a_number_is_one(text: str, value: object) -> None:
    assert parse_yaml(f"a: {text}", "FILE") == {"a": value}


@given(st.text())
@settings(deadline=None)
def test_whatever_the_text_it_is_read_or_refused(text: str) -> None:
    told = "FILE"
    try:
        assert isinstance(parse_yaml(text, "FILE"), dict)
    except ConfigError as refused:
        told = str(refused)
    assert told.startswith("FILE")


@pytest.mark.parametrize("name", ["ax12-line\n", "..", "", "ax12 line"])
def test_a_name_of_an_arm_is_a_plain_name(name: str) -> None:
    with pytest.raises(ConfigError, match="no such arm"):
        find_arm_file(name)
