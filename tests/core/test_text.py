"""Names that may stand in files, and text that does no harm where it goes."""

from __future__ import annotations

import re
import time

import pytest
from hypothesis import given, strategies as st

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.core.text import (
    c_comment,
    c_identifiers,
    check_name,
    check_unit,
    figure,
    listed,
    markdown,
    markdown_code,
    visible,
)

names = st.text(st.sampled_from("abgφö²ß_.-^*/()%°µ·[], 019Ω日"), min_size=1, max_size=12).filter(str.strip)


@pytest.mark.parametrize("name", ["m", "k-1", "stage_cost.W", "m²", "φ", "Länge 2", "N·m/(rad·s)", "W[0,1]", "日本"])
def test_names_of_the_alphabet(name: str) -> None:
    assert check_name("name", name) == name
    assert check_unit("unit", name) == name


@pytest.mark.parametrize("unit", ["", "kg", "rad/s", "N m", "kg·m²", "m^2", "s⁻¹", "%", "°", "µs", "Ω"])
def test_units(unit: str) -> None:
    assert check_unit("unit", unit) == unit


@pytest.mark.parametrize(
    "name",
    [
        "",
        " ",
        "a\n",
        "a\x00",
        "\x1b[2J",
        'a"',
        "a'",
        "a\\",
        "a?",
        "a<b",
        "#a",
        "a;b",
        "\u202ea",
        "\u3164",
        "a" * 101,
        5,
        None,
    ],
)
def test_other_names_are_refused_by_name(name: object) -> None:
    with pytest.raises(InvalidArgumentError, match="thing: expected") as caught:
        check_name("thing", name)
    assert str(caught.value).isprintable()
    with pytest.raises(FileFormatError):
        check_name("thing", name, error=FileFormatError)


@given(st.lists(names, unique=True, max_size=8))
def test_identifiers_are_of_c_and_differ(given: list[str]) -> None:
    found = c_identifiers(given)
    assert sorted(found) == sorted(given)
    assert len(set(found.values())) == len(given)
    assert all(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name, flags=re.ASCII) for name in found.values())
    assert not any("__" in name for name in found.values())


def test_identifiers_keep_what_they_can() -> None:
    found = c_identifiers(["model.k-1", "model.k_1", "model.m", "model.m²", "model.φ", "int", "co_await", "2x"])
    assert found["model.k_1"] == "model_k_1"  # the name that is one goes first
    assert found["model.k-1"] == "model_k_1_2"
    assert (found["model.m"], found["model.m²"], found["model.φ"]) == ("model_m", "model_m2", "model_u03c6")
    assert (found["int"], found["co_await"], found["2x"]) == ("p_int", "p_co_await", "p_2x")


@given(st.text())
def test_a_comment_of_c_goes_on_to_its_end(text: str) -> None:
    comment = c_comment(text)
    assert not re.search(r"\*/|/\*|\\|\?\?|[\n\r]", comment)


@given(st.text())
def test_nothing_steers_a_terminal(text: str) -> None:
    shown = visible(text)
    assert all(c == "\n" or c.isprintable() for c in shown)
    assert visible(shown) == shown


def test_escapes_are_shown_by_their_number() -> None:
    assert visible("a\x1b[2J\x9b\u202e\n") == "a\\x1b[2J\\x9b\\u202e\n"
    assert str(InvalidArgumentError("x", expected="y", actual="\x1b]0;title\x07")).isprintable()


def test_markdown_stays_text() -> None:
    assert markdown("a_b _c_ <b> [x](y) | `z`\n# t") == r"a_b \_c\_ \<b\> \[x\](y) \| \`z\` \# t"
    assert markdown_code("a`b|c") == r"`a'b\|c`"


def test_thousands_of_names_that_look_alike_take_no_time() -> None:
    start = time.process_time()
    found = c_identifiers("+" * (k // 10 % 99 + 1) + "-" * (k % 10) + "/" * (k // 990) for k in range(9_900))
    assert len(set(found.values())) == 9_900
    assert time.process_time() - start < 2.0


def test_of_many_names_some_are_told() -> None:
    assert listed(()) == ""
    assert listed(["a", "b"]) == "a, b"
    assert listed([f"p{i}" for i in range(40)], 3, joint=", nor ") == "p0, nor p1, nor p2 and 37 more"


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (1058.3, "1060"),
        (-1.7e6, "-1700000"),
        (0.06294, "0.0629"),
        (3e-9, "3e-09"),
        (2e9, "2e+09"),
        (0.0, "0"),
        (12, "12"),
    ],
)
def test_figures_have_an_exponent_only_where_they_need_one(value: float, said: str) -> None:
    assert figure(value) == said
    assert figure(value, sign=True) == (said if value < 0.0 else f"+{said}")


@given(st.floats(-1e12, 1e12))
def test_figures_are_the_numbers(value: float) -> None:
    assert float(figure(value, 15)) == pytest.approx(value, rel=1e-14)
