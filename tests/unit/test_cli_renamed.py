"""Commands and options of version 0.1.0 are accepted with a line on standard error."""

from __future__ import annotations

import pytest

from escape_hw.cli.renamed import current_words


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("sweep x --heats 2 --finals=6", "sweep x --replicates 2 --final-replicates=6"),
        ("sweep x --drop 0:4", "sweep x --dropped-modes 0:4"),
        ("reproduce sky-time --plants 4", "reproduce sky-time --realisations 4"),
        ("import pyrtc a.yaml x --legacy yx", "import pyrtc a.yaml x --frame-order yx"),
        ("rehearse x -- escape rehearse x --plants", "with-stand-ins x -- escape rehearse x --plants"),
    ],
)  # fmt: skip
def test_old_words_are_replaced_and_named(old, new, capsys):
    assert current_words(old.split()) == new.split()
    out, err = capsys.readouterr()
    assert out == ""
    for word in ("--heats", "--finals", "--drop", "--plants", "--legacy", "rehearse"):
        renamed = word in {one.partition("=")[0] for one in old.partition(" -- ")[0].split()}
        assert (f"{word} is called" in err) == renamed


def test_words_of_today_pass_unchanged(capsys):
    words = ["loop", "x", "--drop", "3"]
    assert current_words(words) == words
    assert current_words([]) == []
    assert capsys.readouterr().err == ""


def test_an_old_option_reaches_its_command(document):
    code, found, err = document("sweep", "razor-shwfs", "--frames", 10, "--heats", 2)
    assert (code, found["error"]["type"]) == (2, "ConfigError")
    assert "--heats is called --replicates" in err
