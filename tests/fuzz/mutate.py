"""Ways in which tables, texts and bytes go wrong, drawn by hypothesis so that a failure shrinks."""

from __future__ import annotations

from hypothesis import strategies as st

__all__ = ["TOKENS", "bytes_changes", "change_bytes", "change_table", "change_text", "table_changes", "text_changes"]

TOKENS = [
    *("", " ", "nan", "NaN", "inf", "-inf", "1e155", "-1e308", "1e-320", "1e999", "0", "-0.0", "1,5", "0x10", "1_000"),
    *(
        "=1+1",
        "+1",
        "@x",
        "\x1b[31m",
        "\x00",
        "\u202e",
        "é",
        "°",
        "#",
        "null",
        "true",
        "[]",
        "{}",
        "[1, 2]",
        "*a",
        "&a 1",
    ),
    *("!!python/object:os.system x", "9" * 400, "a" * 12_000, '"', "'", ";", "\t", "x[mm]", "q1[rad]", "q1[m]", "q1"),
    *("time[s]", "temperature[degC]", "A[deg]", "rx[rad]", "2026-11-23", "1e400", "-5", "1.5", "3", "\\", "%s", "{0}"),
]
_tokens = st.sampled_from(TOKENS)
_place = st.integers(0, 10_000)

table_changes = st.lists(
    st.tuples(
        st.sampled_from(
            ["cell", "header", "drop_column", "double_column", "swap", "still", "scale", "drop_rows", "line"]
        ),
        _place,
        _place,
        _tokens,
    ),
    max_size=4,
)
text_changes = st.lists(
    st.tuples(st.sampled_from(["insert", "replace", "delete", "repeat"]), _place, _tokens), max_size=4
)
bytes_changes = st.lists(st.tuples(st.sampled_from(["flip", "cut", "insert", "zero"]), _place, _place), max_size=4)


def change_table(cells: list[list[str]], changes: list[tuple[str, int, int, str]]) -> list[list[str]]:
    """Rows of cells, the header first, with what went wrong."""
    cells = [list(row) for row in cells]
    for kind, a, b, token in changes:
        row, column = 1 + a % max(1, len(cells) - 1), b % max(1, len(cells[0]))
        if kind == "line":
            cells.insert(row, [token])
        if kind == "drop_rows":
            cells = cells[: 1 + a % len(cells)]
        if row >= len(cells) or any(len(line) != len(cells[0]) for line in cells):
            continue
        if kind == "cell":
            cells[row][column] = token
        elif kind == "header":
            cells[0][column] = token
        elif kind == "drop_column":
            cells = [line[:column] + line[column + 1 :] for line in cells]
        elif kind == "double_column":
            cells = [[*line, line[column]] for line in cells]
        elif kind == "swap":
            other = a % len(cells[0])
            for line in cells[1:]:
                line[column], line[other] = line[other], line[column]
        elif kind in ("still", "scale"):
            for line in cells[1:]:
                line[column] = cells[1][column] if kind == "still" else f"{line[column]}e{a % 40 - 20}"
        if not cells or not cells[0]:
            return [[""]]
    return cells


def change_text(text: str, changes: list[tuple[str, int, str]]) -> str:
    """A text with words put in, lines replaced, cut or repeated."""
    for kind, place, token in changes:
        lines = text.split("\n")
        k = place % len(lines)
        if kind == "insert":
            at = place % (len(text) + 1)
            text = text[:at] + token + text[at:]
            continue
        key, colon, _ = lines[k].partition(":")
        if kind == "replace":
            lines[k] = f"{key}{colon} {token}"
        elif kind == "delete":
            del lines[k]
        else:
            lines[k:k] = [lines[k]] * 3
        text = "\n".join(lines)
    return text


def change_bytes(content: bytes, changes: list[tuple[str, int, int]]) -> bytes:
    """Bytes flipped, cut off, put in or set to zero."""
    for kind, a, b in changes:
        if not content:
            break
        at = (a * 10_007 + b) % len(content)
        if kind == "flip":
            content = content[:at] + bytes([content[at] ^ (1 << b % 8)]) + content[at + 1 :]
        elif kind == "cut":
            content = content[:at]
        elif kind == "insert":
            content = content[:at] + bytes([b % 256]) * (1 + a % 9) + content[at:]
        else:
            content = content[:at] + bytes(min(64, len(content) - at)) + content[at + 64 :]
    return content
