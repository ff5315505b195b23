"""Notes on standard error: what is said of all photos together first, then what is said of many single ones, kind by kind."""

import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from omnilines.records import Detail

SHOWN_NAMES = 3
"""Of the photos of which the same is said; up to so many have a line each."""
SHOWN_LETTERS = 60
"""Of a name."""
SHOWN_ROWS = 20
"""Of a table with a row for each photo."""
LONGEST_WORD = 300
"""Letters; of a longer one the beginning and the end are told."""
LONGEST_SENTENCE = 1400
_FILE = re.compile(r"\S*\.(jpe?g|png|tiff?|bmp|webp|pgm)\b", re.IGNORECASE)
_FIGURE = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_JOINT = re.compile(r"^(: | is | has )(skipped: )?")


def printable(text: str) -> str:
    """A text in one line, without what a terminal would obey and words without end: names and cells may hold anything."""
    text = re.sub(
        rf"\S{{{LONGEST_WORD},}}", lambda word: f"{word[0][: LONGEST_WORD // 2]}...{word[0][-LONGEST_WORD // 4 :]}", text
    )
    return "".join(letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in text)


def bounded(sentence: str) -> str:
    """A sentence without its middle where it is endless: values may have any length."""
    half = LONGEST_SENTENCE // 2
    return sentence if len(sentence) <= LONGEST_SENTENCE else f"{sentence[:half]} ... {sentence[-half:]}"


def told(details: "Sequence[Detail]", given: int | None, whole: str) -> Iterator[str]:
    """A sentence for each kind of detail, of which the largest figure stands for the worst; `given`: how many photos there are;
    `whole` says what lists all."""
    kinds: dict[str, list[Detail]] = {}
    for one in details:
        kinds.setdefault(_kind(one), []).append(one)
    for alike in sorted(kinds.values(), key=len, reverse=True):
        if len(alike) <= SHOWN_NAMES:
            yield from (one.text.replace(one.photo, shortened(one.photo)) for one in alike)
            continue
        alike.sort(key=_badness, reverse=True)
        names = ", ".join(shortened(one.photo) for one in alike[:SHOWN_NAMES])
        of_all = f" of {given}" if given else ""
        same = len({_reason(one) for one in alike}) == 1
        yield (
            f"{len(alike)}{of_all} photos ({names} and {len(alike) - SHOWN_NAMES} more; {whole} lists all)"
            f"{': ' if same else ', the first: '}{_reason(alike[0])}"
        )


def shortened(name: str) -> str:
    """Its beginning and its end where it is long."""
    half = SHOWN_LETTERS // 2
    return name if len(name) <= SHOWN_LETTERS else f"{name[:half]}...{name[-half:]}"


def rows_shown(rows: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """The first of many rows, and how many more there are."""
    more = len(rows) - SHOWN_ROWS
    return [*rows[:SHOWN_ROWS], ("...", f"{more} more; --json lists all")] if more > 1 else list(rows)


def _reason(one: "Detail") -> str:
    """What is said behind the name."""
    behind = one.text.removeprefix(one.photo)
    return one.text if behind == one.text else _JOINT.sub("", behind)


def _kind(one: "Detail") -> str:
    """The sentence without names and figures."""
    return _FIGURE.sub("0", _FILE.sub("", _reason(one).replace(one.photo, "")))


def _badness(one: "Detail") -> float:
    figure = _FIGURE.search(_FILE.sub("", _reason(one).replace(one.photo, "")))
    return float(figure[0]) if figure else 0.0
