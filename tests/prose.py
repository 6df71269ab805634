"""Sentences of a Markdown page: its prose without code, tables, links' addresses and marks."""

import re

# a full stop ends a sentence where a capital follows; that of J., Eq. and Figs. does not
_END = re.compile(
    r"(?<=[.:?!])(?<!\b[A-Z]\.)(?<!Eq\.)(?<!Eqs\.)(?<!Figs\.)\**\s+(?=[A-Z*θδqρμτ\"✕µ]|code\b)"
)
_FIGURE = re.compile(r"<!-- (= [^>]*|/) -->")  # marks of a figure within a sentence
_FENCE = re.compile(r"^(```|:::).*?^\1[`:]*$", re.MULTILINE | re.DOTALL)


def sentences(text: str) -> list[str]:
    """Sentences of the paragraphs and list items of a page."""
    text = _FIGURE.sub("", _FENCE.sub("\n", text))
    text = re.sub(
        r"^\$\$.*?\$\$$|<!--.*?-->|!\[[^\]]*\]\([^)]*\)", "\n", text, flags=re.MULTILINE | re.DOTALL
    )
    blocks: list[str] = []
    for line in text.splitlines():
        is_item = re.match(r"\s*([*-]|\d+\.) ", line) is not None
        if line.startswith(("    ", "|", "#")) or not line.strip():
            blocks.append("")
        elif is_item or not blocks:
            blocks.append(re.sub(r"^\s*([*-]|\d+\.) ", "", line))
        else:
            blocks[-1] += f" {line}"
    found = []
    for block in blocks:
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", re.sub(r"`[^`]*`", "code", block))
        found += _END.split(plain)
    return [sentence.strip() for sentence in found if sentence.strip()]


def words(sentence: str) -> int:
    """Number of words; signs between them are none."""
    return len(re.findall(r"\w[\w'’.,/-]*", sentence))
