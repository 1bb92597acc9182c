"""Lines of keys, whatever way TOML allows to write them."""

from escape_hw.config.toml_text import key_lines, line_of

TEXT = '''# comment with [brackets] and = signs
top = 1

[a]
b.c = 2 # dotted
"quoted key" = 3
long = [
  1, # x = 7
  2,
]
text = """
d = 4
[not.a.table]
"""
inline = { e = 5, f = [6] }

[a.g.h]   # nested
i = 7

[[list]]
j = 8
[[list]]
j = 9
[list.k]
l = 10
'''


def test_every_kind_of_key() -> None:
    lines = key_lines(TEXT)
    expected = {
        ("top",): 2,
        ("a",): 4,
        ("a", "b", "c"): 5,
        ("a", "quoted key"): 6,
        ("a", "long"): 7,
        ("a", "text"): 11,
        ("a", "inline"): 15,
        ("a", "inline", "e"): 15,
        ("a", "inline", "f", 0): 15,
        ("a", "g", "h"): 17,
        ("a", "g", "h", "i"): 18,
        ("list", 0, "j"): 21,
        ("list", 1): 22,
        ("list", 1, "j"): 23,
    }
    assert {path: lines.get(path) for path in expected} == expected
    assert ("d",) not in lines
    assert ("a", "d") not in lines


def test_table_inside_the_last_array_item() -> None:
    assert key_lines(TEXT)["list", 1, "k", "l"] == 25


def test_a_key_that_is_absent_is_blamed_on_its_table() -> None:
    lines = key_lines(TEXT)
    assert line_of(lines, ("a", "g", "h", "missing")) == 17
    assert line_of(lines, ("nowhere",)) is None
