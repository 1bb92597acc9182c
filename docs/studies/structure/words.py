"""Print where the words stand that the reorganisation replaced, as a Markdown table.

    python docs/studies/structure/words.py [--lines] [WORD...]

Searches all text files that git tracks, except data of version 0.1.0, raw tables, the changelog and this
folder. ``--lines`` prints every hit below its row. A hit that stays is explained in :data:`REASONS`.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
LEFT_OUT = ("tests/data/", "docs/studies/structure/", "CHANGELOG.md", "LICENSE")

#: Old word -> expression that finds it, also as a part of a compound name (``keep_closed``).
#: Words that are ordinary English or a term in other places have an expression for the replaced meaning.
WORDS = {
    # The field's words.
    "doubt, doubtful": r"doubt\w*",
    "what it does not know": r"(it|he|they) do(es)? not know",
    "how the mirror sits": r"(mirror|sensor|lens\w*|pupil|it) sits?",
    "air (for turbulence)": r"(?<!open.)air",
    "planted": r"planted",
    "plant (for realisation)": r"plants?",
    "heat, heats": r"heats?",
    "finals": r"finals",
    "surprise (for innovation)": r"surpris\w+",
    "alike (actuators)": r"""["']alike["']|actuators (are )?alike""",
    "found (actuators)": r"""["']found["'](?!\])|found actuators""",
    "effects (solver)": r"""["']effects["']""",
    "light (solver)": r"""["']light["'](?!, ")|light fit""",
    "belief, believed": r"belie\w+",
    "what the model explains": r"model explains",
    "session (for acquisition)": r"poke.?session|session of (pokes|frames)",
    "tape": r"(loop)?.?tapes?",
    "keep (for checkpoint), keeper": r"keepers?|keep_closed|keep_trying",
    "desk": r"desk", "door": r"doors?", "letter": r"(?<!SMALL )(?<!CAPITAL )letters?",
    "shelf": r"shel(f|ves)",
    "pulse, beat (for publishing)": r"pulse\.beat|beat\(", "board": r"board", "offers": r"offers",
    "growing pause": r"growing.?pause", "bury, condemn": r"bur(y|ied|ies)|condemn\w*",
    "closing (control matrix in use)": r"closing(?==)|closing:|closing_",
    "trust (for outlier weights)": r"trust\w*", "parity (for orientation)": r"parity", "soiled": r"soiled",
    # Names.
    "Taps, harmless": r"taps?|harmless",
    "Measured (class)": r"class Measured\b|import Measured\b|api\w*\.Measured",
    "MirrorDepartures": r"MirrorDepartures|departures?",
    "DoubtfulModel, UnevenModel, SelectiveModel, MovablePupil":
        r"DoubtfulModel|UnevenModel|SelectiveModel|MovablePupil",
    "brief": r"brief", "Motion (class)": r"(class|import) Motion\b", "Looks": r"looks\b(?! (like|for))",
    "LightWatch": r"light.?watch", "PokeSession, StepwiseRun": r"poke.?session|stepwise.?run",
    "LoopOrders, LoopTape": r"loop.?orders|loop.?tape", "FadingSums, GainMeter": r"fading.?sums|gain.?meter",
    "close_first": r"close_first", "Answer (class)": r"class Answer|Answer\(", "worth": r"worth",
    "Problem (class)": r"class Problem\b", "efficient()": r"efficient\(", "Priors.shared": r"priors\.shared",
    "--also": r"--also|also=", "rehearse": r"rehears\w+", "hands.py": r"hands(\.py)?|import hands",
    # Prose.
    "mend": r"mend(s|ed|ing)?", "say hello": r"say hello", "told": r"told",
    "afar": r"afar", "by halves": r"by halves",
    "nobody, somebody, anybody": r"(some|any|no)body", "who/whoever (for programs)": r"whoever|whoso\w*",
    "bare participles as function names":
        r"def _?(made|told|found|shown|taken|refined|turned|whole|given|asked|kept)\b",
}  # fmt: skip

#: Why hits of a word stay.
_RENAMED = "tables of old names, and their tests"
REASONS = {
    "doubt, doubtful": _RENAMED,
    "air (for turbulence)": _RENAMED,
    "planted": _RENAMED,
    "plant (for realisation)": _RENAMED,
    "heat, heats": _RENAMED,
    "finals": _RENAMED,
    "surprise (for innovation)": "YAML's types are surprising",
    "alike (actuators)": _RENAMED,
    "found (actuators)": _RENAMED,
    "effects (solver)": _RENAMED,
    "light (solver)": f"palette of the window, AOT's light source; {_RENAMED}",
    "belief, believed": "a faulty mirror that tests describe",
    "what the model explains": "verb, of the variance",
    "letter": "letters of a text",
    "offers": "verb",
    "closing (control matrix in use)": f"closing of a device; {_RENAMED}",
    "trust (for outlier weights)": f"trusted keys; {_RENAMED}",
    "parity (for orientation)": "serial lines; even and odd functions",
    "Taps, harmless": f"taps of a filter; ordinary word; {_RENAMED}",
    "MirrorDepartures": f"departure of a curve from its trend; {_RENAMED}",
    "Looks": f"verb; {_RENAMED}",
    "worth": _RENAMED,
    "--also": _RENAMED,
    "rehearse": _RENAMED,
    "hands.py": "a lease that changes hands",
    "told": "local variables and names of tests",
    "nobody, somebody, anybody": "names of clients and files in tests, and of tests",
    "who/whoever (for programs)": "a person; a comment on the environment",
    "bare participles as function names": "fixtures and local functions of tests",
}


def area_of(path: str) -> str | None:
    """Column of the table for a file; ``None`` for files that are left out."""
    if path.startswith(LEFT_OUT) or path.endswith(".csv"):
        return None
    if path.startswith("tests/"):
        return "tests"
    return "pages" if path.endswith(".md") else "code"


def main(arguments: list[str]) -> None:
    """Print the table."""
    show_lines, chosen = "--lines" in arguments, [a for a in arguments if a != "--lines"]
    tracked = subprocess.check_output(["git", "ls-files"], cwd=ROOT, text=True).splitlines()
    texts: list[tuple[str, str, list[str]]] = []
    for path in tracked:
        if (area := area_of(path)) is None:
            continue
        try:
            texts.append((path, area, (ROOT / path).read_text(encoding="utf-8").splitlines()))
        except (UnicodeDecodeError, FileNotFoundError):
            continue
    print("| word | code | pages | tests | why hits stay |\n|---|---:|---:|---:|---|")
    for word, expression in WORDS.items():
        if chosen and not any(part in word for part in chosen):
            continue
        pattern = re.compile(rf"(?<![A-Za-z])(?:{expression})(?![A-Za-z])", re.IGNORECASE)
        counts, hits = {"code": 0, "pages": 0, "tests": 0}, []
        for path, area, lines in texts:
            for number, line in enumerate(lines, 1):
                if pattern.search(line):
                    counts[area] += 1
                    hits.append(f"    {path}:{number}: {line.strip()[:120]}")
        print(
            f"| {word} | {counts['code']} | {counts['pages']} | {counts['tests']} | {REASONS.get(word, '')} |"
        )
        if show_lines and hits:
            print("\n".join(hits))


if __name__ == "__main__":
    main(sys.argv[1:])
